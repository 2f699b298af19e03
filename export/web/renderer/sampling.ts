/** Where the pixels of an output lie: between which cells of a label map, and over which pixels of a finer render. */

/** (left, top, right, bottom) in pixels of the scene. */
export type Rect = [left: number, top: number, right: number, bottom: number];

/** A part of the scene, in its pixels, and the size in pixels to render it at. */
export interface View {
  readonly rect: Rect;
  readonly width: number;
  readonly height: number;
  /** Look at one point for each pixel where the scene shrinks: quicker than area means, for what moves. */
  readonly draft?: boolean;
}

/** Points of one axis: the cells before and after each, and the share of the one after. */
export interface Axis {
  readonly low: Int32Array;
  readonly high: Int32Array;
  readonly share: Float32Array<ArrayBuffer>;
}

// rounding errors of positions in float64
const NOISE = 1e-9;

/** Place the centres of a render's pixels between `cells` cells. */
export function placed({ start, step, count }: FineAxis, cells: number): Axis {
  const [low, high, share] = [new Int32Array(count), new Int32Array(count), new Float32Array(count)];
  for (let i = 0; i < count; i++) {
    const position = start + (i + 0.5) * step - 0.5;
    const first = Math.floor(position + NOISE);
    low[i] = Math.min(Math.max(first, 0), cells - 1);
    high[i] = Math.min(Math.max(first + 1, 0), cells - 1);
    share[i] = Math.max(0, position - first);
  }
  return { low, high, share };
}

/** One axis of a render that is at least as fine as the scene, and how its pixels join to those of the output. */
export interface FineAxis {
  readonly start: number; // scene pixels
  readonly step: number;
  readonly count: number;
  /** Each pixel of the output is the mean from `from + i * span` on over `span` fine ones; null: each is one. */
  readonly mean: { from: number; span: number } | null;
}

/** Whether the pixels of a render are those of the scene, or every so many of them. */
export function isNative({ rect: [left, top, right, bottom], width, height }: View): boolean {
  return [
    [left, (right - left) / width],
    [top, (bottom - top) / height],
  ].every(([start, step]) => step! > 1 + NOISE || (step! > 1 - NOISE && Math.abs(start! - Math.round(start!)) < NOISE));
}

/** A scene that shrinks is rendered at its own size, of which area means are taken. */
export function fineAxis(start: number, end: number, count: number, length: number, draft = false): FineAxis {
  const step = (end - start) / count;
  if (step <= 1 + NOISE || draft) return { start, step, count, mean: null };
  const first = Math.min(Math.max(Math.floor(start + NOISE), 0), length - 1);
  const last = Math.max(first + 1, Math.min(Math.ceil(end - NOISE), length));
  return { start: first, step: 1, count: last - first, mean: { from: start - first, span: step } };
}
