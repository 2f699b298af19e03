/**
 * Which regions each cell of a label map belongs to, and how much: what renderers interpolate. Cells are the
 * scene's pixels. See docs/concepts.md.
 */

import type { RegionMap } from "../decoder/scene.ts";
import { Blur } from "./blur.ts";
import type { Shares } from "./blur.ts";
import { contourLevels } from "./levels.ts";
import type { Levels } from "./levels.ts";

export type Contours = "scaled" | "crisp";

/** Set in the head of a cell that several regions share; the rest is the place of its list. */
export const SHARED = 0x80000000;
/** A list entry is region << 16 | weight, where `whole` stands for 1; a 0 ends the list. */
const WHOLE = 0xffff;
// crisp weights pass 1
const CRISP_WHOLE = 0x7fff;
const MAX_REGIONS = 0xfffe;
const CRISP_MARGIN = 0.25;
const CRISP_WIDTH = 1; // pixels of the scene
const CRISPNESS = 2; // the exponent at the scene's own size
const MIN_VARIANCE = 1e-6;

export interface Membership {
  readonly width: number; // cells
  readonly height: number;
  readonly hard: boolean;
  readonly heads: Uint32Array<ArrayBuffer>; // a region, or SHARED + place in `lists`
  readonly lists: Uint32Array<ArrayBuffer>;
  readonly whole: number;
  readonly variances: Float32Array<ArrayBuffer> | null; // squared widths of cells; null: `variance` is that of all
  readonly variance: number;
  /** The exponent that is the same everywhere, of contours that are crisp; null: it follows from the variance. */
  readonly crisp: number | null;
}

/** No map: one region everywhere. */
export function uniform(): Membership {
  return hardMembership(new Uint32Array(1), 1, 1);
}

/** Make the tables of a map whose scene has this width in pixels. */
export function membershipOf(map: RegionMap, width: number, contours: Contours): Membership {
  const regions = map.ids.length;
  if (regions > MAX_REGIONS) throw new Error(`a map may have ${MAX_REGIONS} regions to be shown; it has ${regions}.`);
  const height = map.labels.length / width;
  if (contours === "crisp" && regions > 1) {
    const tables = blurred(map, width, height, { widths: [CRISP_WIDTH], of: null }, CRISP_WHOLE);
    return { ...tables, hard: false, variances: null, variance: 0, crisp: CRISPNESS };
  }
  if (map.softness === 0 || regions === 1) return hardMembership(Uint32Array.from(map.labels), width, height);
  const levels = contourLevels(map, width, height);
  const variances = levels.of && Float32Array.from(levels.of, (level) => levels.widths[level]! ** 2);
  const tables = blurred(map, width, height, levels, WHOLE);
  return { ...tables, hard: false, variances, variance: levels.widths[0]! ** 2, crisp: null };
}

function hardMembership(heads: Uint32Array<ArrayBuffer>, width: number, height: number): Membership {
  const lists = new Uint32Array(1);
  return { width, height, hard: true, heads, lists, whole: WHOLE, variances: null, variance: 0, crisp: null };
}

type Tables = Pick<Membership, "width" | "height" | "heads" | "lists" | "whole">;

/** Blur the labels to weights; crisp ones keep the centre of each pixel with its own label. */
function blurred(map: RegionMap, width: number, height: number, levels: Levels, whole: number): Tables {
  const blur = new Blur(map.labels, width, height, map.ids.length, levels);
  const heads = new Uint32Array(width * height);
  const lists = new Lists();
  for (let y = 0, pixel = 0; y < height; y++) {
    for (let x = 0; x < width; x++, pixel++) {
      if (blur.alone(x, y)) {
        heads[pixel] = map.labels[pixel]!;
        continue;
      }
      const shares = blur.weigh(x, y);
      if (whole === CRISP_WHOLE) keepOwn(shares, map.labels[pixel]!);
      heads[pixel] = lists.add(shares, whole);
    }
  }
  return { width, height, heads, lists: lists.finish(), whole };
}

function keepOwn({ regions, weights }: Shares, label: number): void {
  const largest = Math.max(...weights);
  const place = regions.indexOf(label);
  if (weights[place]! < largest) weights[place] = largest + CRISP_MARGIN;
}

/** Lists of weights, one after the other. */
class Lists {
  private entries = new Uint32Array(1 << 12);
  private length = 0;

  add({ regions, weights }: Shares, whole: number): number {
    const start = this.length;
    for (let i = 0; i < regions.length; i++) {
      const weight = Math.round(weights[i]! * whole);
      if (weight === WHOLE) {
        this.length = start;
        return regions[i]!;
      }
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

/** What weights between cells are raised to; `lost` is 1 - cells / pixels of the output, and 1 changes nothing. */
export function sharpness(variance: number, lost: number): number {
  const bounded = Math.max(variance, MIN_VARIANCE);
  return Math.sqrt((bounded + lost / 6) / Math.max(bounded - lost / 12, lost / 24));
}

/** The exponent of crisp contours where a pixel of the scene has so many pixels of the output. */
export function crispness(crisp: number, ratio: number): number {
  return Math.max(1, crisp * Math.sqrt(ratio));
}
