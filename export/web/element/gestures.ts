/** Wheel, drag, pinch and keys on the image, as zooms about a point and pans, in canvas pixels. */

import type { Anchor } from "./view.ts";

const WHEEL_RATE = 0.002;
const PINCH_WHEEL_RATE = 0.01;
const LINE_HEIGHT = 16;
const KEY_FACTOR = Math.SQRT2;
const KEY_PAN = 0.12;
const GLIDE_MS = 55;

export interface Hands {
  anchorAt(x: number, y: number): Anchor;
  zoom(factor: number, anchor: Anchor): void;
  pan(dx: number, dy: number): void;
  fit(): void;
  native(): void;
}

type Place = (event: { clientX: number; clientY: number }) => [x: number, y: number];

/** Spreads a step of zoom over a few frames; at once where less motion is wanted. */
export class Glide {
  private rest = 0;
  private anchor: Anchor | null = null;
  private time = 0;
  private running = false;

  constructor(private readonly hands: Hands) {}

  add(factor: number, x: number, y: number): void {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.hands.zoom(factor, this.hands.anchorAt(x, y));
      return;
    }
    this.rest += Math.log(factor);
    // While the scene is smaller than the canvas it stays in the middle and leaves its anchor: one that is kept
    // until the zoom ends is found again.
    const kept = this.running && this.anchor?.canvas[0] === x && this.anchor.canvas[1] === y;
    if (!kept) this.anchor = this.hands.anchorAt(x, y);
    if (this.running) return;
    this.running = true;
    this.time = performance.now();
    requestAnimationFrame((now) => this.step(now));
  }

  private step(now: number): void {
    const share = 1 - Math.exp(-Math.max(now - this.time, 4) / GLIDE_MS);
    this.time = now;
    const part = Math.abs(this.rest) < 0.01 ? this.rest : this.rest * share;
    this.rest -= part;
    this.hands.zoom(Math.exp(part), this.anchor!);
    this.running = this.rest !== 0;
    if (this.running) requestAnimationFrame((next) => this.step(next));
  }
}

/** Where gestures are made, and what they move. */
interface Surface {
  readonly canvas: HTMLCanvasElement;
  readonly place: Place;
  readonly hands: Hands;
  readonly glide: Glide;
  readonly until: AddEventListenerOptions;
}

/** Listen until the signal: for keys where `keyboard` has the focus; `wheelNeedsCtrl`: a wheel alone scrolls the page. */
export function listen(
  canvas: HTMLCanvasElement,
  place: Place,
  hands: Hands,
  { keyboard, wheelNeedsCtrl, signal }: { keyboard: EventTarget; wheelNeedsCtrl: boolean; signal: AbortSignal },
): Glide {
  const surface = { canvas, place, hands, glide: new Glide(hands), until: { signal } };
  listenToWheel(surface, wheelNeedsCtrl);
  listenToPointers(surface);
  listenToKeys(surface, keyboard);
  return surface.glide;
}

function listenToWheel({ canvas, place, hands, glide, until }: Surface, needsCtrl: boolean): void {
  const turn = (event: WheelEvent): void => {
    if (needsCtrl && !event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    const delta = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? event.deltaY * LINE_HEIGHT : event.deltaY;
    const [x, y] = place(event);
    // Browsers report a pinch on a trackpad as a wheel with Ctrl held: already smooth, in small steps.
    if (event.ctrlKey) hands.zoom(Math.exp(-delta * PINCH_WHEEL_RATE), hands.anchorAt(x, y));
    else glide.add(Math.exp(-delta * WHEEL_RATE), x, y);
  };
  canvas.addEventListener("wheel", turn, { passive: false, ...until });
}

function listenToPointers({ canvas, place, hands, glide, until }: Surface): void {
  const pointers = new Map<number, [x: number, y: number]>();
  const press = (event: PointerEvent): void => {
    if (event.button !== 0) return;
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, place(event));
    canvas.classList.add("held");
  };
  const drag = (event: PointerEvent): void => {
    const before = pointers.get(event.pointerId);
    if (before === undefined) return;
    const now = place(event);
    pointers.set(event.pointerId, now);
    const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other === undefined) {
      hands.pan(now[0] - before[0], now[1] - before[1]);
      return;
    }
    const spread = (point: [number, number]): number => Math.hypot(point[0] - other[0], point[1] - other[1]);
    hands.pan((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
    const middle = hands.anchorAt((now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    hands.zoom(spread(now) / Math.max(spread(before), 1), middle);
  };
  const lift = (event: PointerEvent): void => {
    pointers.delete(event.pointerId);
    canvas.classList.toggle("held", pointers.size > 0);
  };
  canvas.addEventListener("pointerdown", press, until);
  canvas.addEventListener("pointermove", drag, until);
  canvas.addEventListener("pointerup", lift, until);
  canvas.addEventListener("pointercancel", lift, until);
  canvas.addEventListener("dblclick", (event) => glide.add(event.shiftKey ? 0.5 : 2, ...place(event)), until);
}

const PANS: Record<string, [number, number]> = {
  ArrowLeft: [1, 0],
  ArrowRight: [-1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

function listenToKeys({ canvas, hands, glide, until }: Surface, keyboard: EventTarget): void {
  const press = (event: KeyboardEvent): void => {
    if (event.target !== keyboard || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = KEY_PAN * Math.min(canvas.width, canvas.height);
    const pan = PANS[event.key];
    if (pan !== undefined) hands.pan(pan[0] * step, pan[1] * step);
    else if (event.key === "+" || event.key === "=") zoomAtMiddle(canvas, glide, KEY_FACTOR);
    else if (event.key === "-") zoomAtMiddle(canvas, glide, 1 / KEY_FACTOR);
    else if (event.key === "0") hands.fit();
    else if (event.key === "1") hands.native();
    else return;
    event.preventDefault();
  };
  keyboard.addEventListener("keydown", press as EventListener, until);
}

export function zoomAtMiddle(canvas: HTMLCanvasElement, glide: Glide, factor: number): void {
  glide.add(factor, canvas.width / 2, canvas.height / 2);
}
