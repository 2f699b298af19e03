/** The canvas: lays the frames that there are, and the original, where the current view wants them. */

import { origin, visiblePart } from "./view.ts";
import type { Rect, Size, Transform } from "./view.ts";

/** From this scale on the original shows its pixels as squares: what it holds, not what a filter makes of it. */
const SQUARES_FROM = 3;

export interface Frame {
  bitmap: ImageBitmap;
  rect: Rect;
}

export interface Scenery {
  scene: Size;
  transform: Transform;
  /** The whole scene, small: shown where no frame has been drawn yet. */
  backdrop: Frame | null;
  frame: Frame | null;
  original: ImageBitmap | null;
  /** Fraction of the canvas, from the left, that shows the original; null shows none of it. */
  divider: number | null;
}

export class Stage {
  private readonly context: CanvasRenderingContext2D;
  private scheduled = false;

  constructor(
    readonly canvas: HTMLCanvasElement,
    private readonly scenery: () => Scenery | null,
    resized: () => void,
  ) {
    this.context = canvas.getContext("2d")!;
    new ResizeObserver(() => {
      if (!this.measure()) return;
      resized();
      // A canvas is emptied when it is resized; painting within the same frame avoids a flash.
      this.paintNow();
    }).observe(canvas);
    this.measure();
  }

  get size(): Size {
    return { width: this.canvas.width, height: this.canvas.height };
  }

  /** Canvas position of a pointer. */
  at(event: { clientX: number; clientY: number }): [x: number, y: number] {
    const box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left) * this.ratio, (event.clientY - box.top) * this.ratio];
  }

  /** Canvas pixels to a CSS pixel. */
  get ratio(): number {
    return this.canvas.width / Math.max(1, this.canvas.clientWidth);
  }

  paint(): void {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame(() => {
      this.scheduled = false;
      this.paintNow();
    });
  }

  private measure(): boolean {
    const width = Math.max(1, Math.round(this.canvas.clientWidth * devicePixelRatio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * devicePixelRatio));
    if (width === this.canvas.width && height === this.canvas.height) return false;
    this.canvas.width = width;
    this.canvas.height = height;
    return true;
  }

  paintNow(): void {
    const { context, size } = this;
    context.clearRect(0, 0, size.width, size.height);
    const scenery = this.scenery();
    if (scenery === null) return;
    const { scene, transform, backdrop, frame, original, divider } = scenery;
    for (const layer of [backdrop, frame]) {
      if (layer !== null) this.place(layer.bitmap, layer.rect, transform, scene, true);
    }
    if (original === null || divider === null) return;
    context.save();
    context.beginPath();
    context.rect(0, 0, Math.round(divider * size.width), size.height);
    context.clip();
    const smooth = transform.scale < SQUARES_FROM;
    this.place(original, [0, 0, scene.width, scene.height], transform, scene, smooth);
    context.restore();
  }

  /** Draw what is visible of an image that shows `rect` of the scene. */
  private place(image: ImageBitmap, rect: Rect, transform: Transform, scene: Size, smooth: boolean): void {
    const { context } = this;
    const { scale } = transform;
    const [ox, oy] = origin(transform, this.size);
    const part = visiblePart(transform, scene, this.size);
    const across = cut(image.width, rect[0], rect[2], part.rect[0], part.rect[2], ox, scale);
    const down = cut(image.height, rect[1], rect[3], part.rect[1], part.rect[3], oy, scale);
    if (across === null || down === null) return;
    context.imageSmoothingEnabled = smooth && !(across.exact && down.exact);
    context.imageSmoothingQuality = "high";
    // Transparent pictures must not shine through onto the layer below.
    context.clearRect(across.to, down.to, across.span, down.span);
    context.drawImage(
      image,
      ...([across.from, down.from, across.count, down.count] as const),
      ...([across.to, down.to, across.span, down.span] as const),
    );
  }
}

interface Cut {
  from: number;
  count: number;
  to: number;
  span: number;
  exact: boolean;
}

/**
 * Along one axis: the pixels of an image that are visible, one more on either side for the filter, and where they go.
 * Cutting first keeps a picture that is enlarged 200 times within what canvases draw precisely.
 */
function cut(
  pixels: number,
  low: number,
  high: number,
  visibleLow: number,
  visibleHigh: number,
  start: number,
  scale: number,
): Cut | null {
  const perScene = pixels / (high - low);
  const from = Math.max(0, Math.floor((visibleLow - low) * perScene) - 1);
  const until = Math.min(pixels, Math.ceil((visibleHigh - low) * perScene) + 1);
  if (until <= from) return null;
  const position = (pixel: number): number => {
    const place = start + (low + pixel / perScene) * scale;
    // The rounding of these few operations must not cost a one-to-one frame its exactness.
    return Math.abs(place - Math.round(place)) < 1e-3 ? Math.round(place) : place;
  };
  const to = position(from);
  const span = position(until) - to;
  return { from, count: until - from, to, span, exact: span === until - from && Number.isInteger(to) };
}
