/** Wheel, drag, pinch and keys on the image, as zooms about a point and pans, in canvas pixels. */

import type { Anchor } from "./view.ts";

const WHEEL_RATE = 0.002; // logarithm of the zoom per pixel that a wheel scrolls
const PINCH_WHEEL_RATE = 0.01; // the same of a pinch on a trackpad
const LINE_HEIGHT = 16; // pixels of a wheel that scrolls lines
const KEY_FACTOR = Math.SQRT2; // zoom of a key
const KEY_PAN = 0.12; // of the canvas's shorter side
const GLIDE_MS = 55; // time in which a glide covers 63 % of its zoom

export interface Viewport {
  anchorAt(x: number, y: number): Anchor;
  zoom(factor: number, anchor: Anchor): void;
  pan(dx: number, dy: number): void;
  fit(): void;
  native(): void;
}

export type Locate = (event: { clientX: number; clientY: number }) => [x: number, y: number];

/** Spreads a step of zoom over a few frames; zooms at once where the user prefers reduced motion. */
export class Glide {
  private remaining = 0;
  private anchor: Anchor | null = null;
  private time = 0;
  private running = false;

  constructor(private readonly viewport: Viewport) {}

  add(factor: number, x: number, y: number): void {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.viewport.zoom(factor, this.viewport.anchorAt(x, y));
      return;
    }
    this.remaining += Math.log(factor);
    // While the scene is smaller than the canvas it stays in the middle and leaves its anchor: the zoom keeps its first
    // anchor, to return to it.
    const sameAnchor = this.running && this.anchor?.canvas[0] === x && this.anchor.canvas[1] === y;
    if (!sameAnchor) this.anchor = this.viewport.anchorAt(x, y);
    if (this.running) return;
    this.running = true;
    this.time = performance.now();
    requestAnimationFrame((now) => this.step(now));
  }

  private step(now: number): void {
    const share = 1 - Math.exp(-Math.max(now - this.time, 4) / GLIDE_MS);
    this.time = now;
    const part = Math.abs(this.remaining) < 0.01 ? this.remaining : this.remaining * share;
    this.remaining -= part;
    this.viewport.zoom(Math.exp(part), this.anchor!);
    this.running = this.remaining !== 0;
    if (this.running) requestAnimationFrame((next) => this.step(next));
  }
}

/** Where gestures are made, and what they move. */
interface Surface {
  readonly canvas: HTMLCanvasElement;
  readonly locate: Locate;
  readonly viewport: Viewport;
  readonly glide: Glide;
  readonly options: AddEventListenerOptions;
}

/** Listen until the signal: for keys where `keyboard` has the focus; `wheelNeedsCtrl`: a wheel alone scrolls the page. */
export function listen(
  canvas: HTMLCanvasElement,
  locate: Locate,
  viewport: Viewport,
  { keyboard, wheelNeedsCtrl, signal }: { keyboard: EventTarget; wheelNeedsCtrl: boolean; signal: AbortSignal },
): Glide {
  const surface = { canvas, locate, viewport, glide: new Glide(viewport), options: { signal } };
  listenToWheel(surface, wheelNeedsCtrl);
  listenToPointers(surface);
  listenToKeys(surface, keyboard);
  return surface.glide;
}

function listenToWheel({ canvas, locate, viewport, glide, options }: Surface, needsCtrl: boolean): void {
  const turn = (event: WheelEvent): void => {
    if (needsCtrl && !event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    const delta = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? event.deltaY * LINE_HEIGHT : event.deltaY;
    const [x, y] = locate(event);
    // Browsers report a pinch on a trackpad as a wheel with Ctrl dragged: already smooth, in small steps.
    if (event.ctrlKey) viewport.zoom(Math.exp(-delta * PINCH_WHEEL_RATE), viewport.anchorAt(x, y));
    else glide.add(Math.exp(-delta * WHEEL_RATE), x, y);
  };
  canvas.addEventListener("wheel", turn, { passive: false, ...options });
}

function listenToPointers({ canvas, locate, viewport, glide, options }: Surface): void {
  const pointers = new Map<number, [x: number, y: number]>();
  const press = (event: PointerEvent): void => {
    if (event.button !== 0) return;
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, locate(event));
    canvas.classList.add("dragged");
  };
  const drag = (event: PointerEvent): void => {
    const before = pointers.get(event.pointerId);
    if (before === undefined) return;
    const now = locate(event);
    pointers.set(event.pointerId, now);
    const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other === undefined) {
      viewport.pan(now[0] - before[0], now[1] - before[1]);
      return;
    }
    const spread = (point: [number, number]): number => Math.hypot(point[0] - other[0], point[1] - other[1]);
    viewport.pan((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
    const middle = viewport.anchorAt((now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    viewport.zoom(spread(now) / Math.max(spread(before), 1), middle);
  };
  const release = (event: PointerEvent): void => {
    pointers.delete(event.pointerId);
    canvas.classList.toggle("dragged", pointers.size > 0);
  };
  canvas.addEventListener("pointerdown", press, options);
  canvas.addEventListener("pointermove", drag, options);
  canvas.addEventListener("pointerup", release, options);
  canvas.addEventListener("pointercancel", release, options);
  canvas.addEventListener("dblclick", (event) => glide.add(event.shiftKey ? 0.5 : 2, ...locate(event)), options);
}

const PANS: Record<string, [number, number]> = {
  ArrowLeft: [1, 0],
  ArrowRight: [-1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

function listenToKeys({ canvas, viewport, glide, options }: Surface, keyboard: EventTarget): void {
  const press = (event: KeyboardEvent): void => {
    if (event.target !== keyboard || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = KEY_PAN * Math.min(canvas.width, canvas.height);
    const pan = PANS[event.key];
    if (pan !== undefined) viewport.pan(pan[0] * step, pan[1] * step);
    else if (event.key === "+" || event.key === "=") zoomAtMiddle(canvas, glide, KEY_FACTOR);
    else if (event.key === "-") zoomAtMiddle(canvas, glide, 1 / KEY_FACTOR);
    else if (event.key === "0") viewport.fit();
    else if (event.key === "1") viewport.native();
    else return;
    event.preventDefault();
  };
  keyboard.addEventListener("keydown", press as EventListener, options);
}

export function zoomAtMiddle(canvas: HTMLCanvasElement, glide: Glide, factor: number): void {
  glide.add(factor, canvas.width / 2, canvas.height / 2);
}
