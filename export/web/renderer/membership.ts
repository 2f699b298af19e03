/**
 * Which regions each cell of a label map belongs to, and how much: what renderers interpolate. Cells are the
 * scene's pixels. See docs/concepts.md.
 */

import type { RegionMap } from "../decoder/scene.ts";
import { antialias } from "./antialias.ts";
import { Blur } from "./blur.ts";
import type { Shares } from "./blur.ts";
import { contourLevels } from "./levels.ts";

/** Set in the head of a cell that several regions share; the rest is the place of its list. */
export const SHARED = 0x80000000;
/** A list entry is region << 16 | weight, where `WHOLE` stands for 1; a 0 ends the list. */
export const WHOLE = 0x7fff; // weights of lines one pixel wide pass 1
const MAX_WEIGHT = 0xffff;
const MAX_REGIONS = 0xfffe;
export const LEAST_BLUR = 0.7; // pixels of the scene
export const PIXEL = 1 / 4; // squared width of a pixel

export interface Membership {
  readonly width: number; // cells
  readonly height: number;
  readonly heads: Uint32Array<ArrayBuffer>; // a region, or SHARED + place in `lists`
  readonly lists: Uint32Array<ArrayBuffer>;
  readonly variances: Float32Array<ArrayBuffer> | null; // squared widths of cells; null: `variance` is that of all
  readonly variance: number;
  /** Whether weights are of antialiased labels, to be interpolated and raised to a power. */
  readonly smooth: boolean;
}

/** No map: one region everywhere. */
export function uniform(): Membership {
  const [heads, lists] = [new Uint32Array(1), new Uint32Array(1)];
  return { width: 1, height: 1, heads, lists, variances: null, variance: 0, smooth: false };
}

/** Make the tables of a map whose scene has this width in pixels: `smooth` ones for sizes other than the scene's. */
export function membershipOf(map: RegionMap, width: number, smooth: boolean): Membership {
  const regions = map.ids.length;
  if (regions > MAX_REGIONS) throw new Error(`a map may have ${MAX_REGIONS} regions to be shown; it has ${regions}.`);
  const height = map.labels.length / width;
  const { widths, of } = contourLevels(map, width, height);
  const variances = of && Float32Array.from(of, (level) => widths[level]! ** 2);
  const variance = widths[0]! ** 2;
  const blurs = smooth ? widths.map((softness) => Math.max(softness, LEAST_BLUR)) : widths;
  const isSharp = (pixel: number): boolean => (variances?.[pixel] ?? variance) < LEAST_BLUR ** 2;
  const labels = smooth ? antialias(map.labels, width, height, isSharp) : null;
  const blur = new Blur(map.labels, width, height, regions, { widths: blurs, of }, labels);
  const heads = new Uint32Array(width * height);
  const lists = new Lists();
  for (let y = 0, pixel = 0; y < height; y++) {
    for (let x = 0; x < width; x++, pixel++) {
      heads[pixel] = blur.alone(x, y) ? map.labels[pixel]! : lists.add(blur.weigh(x, y));
    }
  }
  return { width, height, heads, lists: lists.finish(), variances, variance, smooth };
}

/** Lists of weights, one after the other. */
class Lists {
  private entries = new Uint32Array(1 << 12);
  private length = 0;

  add({ regions, weights }: Shares): number {
    const start = this.length;
    if (regions.length === 1) return regions[0]!;
    for (let i = 0; i < regions.length; i++) {
      const weight = Math.min(Math.round(weights[i]! * WHOLE), MAX_WEIGHT);
      if (weight > 0) this.push(((regions[i]! << 16) | weight) >>> 0);
    }
    this.push(0);
    return (SHARED | start) >>> 0;
  }

  finish(): Uint32Array<ArrayBuffer> {
    return this.entries.slice(0, Math.max(1, this.length));
  }

  private push(entry: number): void {
    if (this.length === this.entries.length) {
      const larger = new Uint32Array(2 * this.length);
      larger.set(this.entries);
      this.entries = larger;
    }
    this.entries[this.length++] = entry;
  }
}

/** What weights between cells are raised to, where a cell has `ratio` pixels of the output. */
export function sharpness(variance: number, ratio: number): number {
  const blurred = Math.max(variance, LEAST_BLUR ** 2) + PIXEL;
  return Math.sqrt((blurred * ratio) / (Math.max(variance - PIXEL, 0) * ratio + PIXEL));
}
