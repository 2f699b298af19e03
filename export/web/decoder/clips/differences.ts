/** How Gaussians differ from the moved ones of the frame before (docs/format.md, "Differences"). */

import { exp2 } from "../exact.ts";
import { restoreColor } from "../gaussians/quantizer.ts";
import { AdaptiveSymbols } from "../models/adaptive_symbols.ts";
import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import type { Numbers } from "./motions.ts";

const CURVATURE = [0.5, 0.5, 0.75, 0.25, 0.75];
const LEAST_PRODUCT = 0.1;
const LEAST_ENERGY = 8;
const LOG2_E = 1.4426950408889634;
const MOST_CHANGE = 1024;
const MOST_DOUBLINGS = 40;
const MOST_BEYOND = 2n ** 24n;
const TOGETHER = 128; // Gaussians that are coded before their models learn
const STRENGTHS = 6;
const SUMS = 5;
const ESCAPE = 15;
const CALM_SUM = 3;
// what a Gaussian did in the last frame
const CALM = 1;
const BUSY = 2;
export const NEW = 3;
// the numbers of a Gaussian in the order of the stream: its place among them, and its kind
const ORDER = [[5, 0], [0, 1], [1, 1], [2, 2], [4, 2], [3, 3]] as const;
const KINDS = 5;
const HUE = 4;
const CHANGED = [[6, 1], [3, 2], [2, 3], [2, 2]].flatMap((weights) => Array<number[]>(STRENGTHS).fill(weights));
const sizesOf = (sum: number): number[] => Array.from({ length: ESCAPE + 1 }, (_, i) => 0.3 + 4 * exp2(-i / (sum + 1)));

/** The steps of Gaussians that differ from given ones. */
export class Differences {
  readonly strengths: Uint8Array; // classes of how many steps a Gaussian has
  private readonly steps: Float64Array; // N x (5 + channels)

  constructor(
    private readonly base: Numbers<Float64Array>,
    private readonly channels: number,
    distortion: number,
    pixels: number,
  ) {
    const { cholesky, colors } = base;
    const count = cholesky.length / 3;
    this.strengths = new Uint8Array(count);
    this.steps = new Float64Array(count * (5 + channels));
    for (let n = 0; n < count; n++) {
      const area = Math.min(Math.PI * Math.max(cholesky[3 * n]! * cholesky[3 * n + 2]!, LEAST_PRODUCT), pixels);
      let sum = 0;
      for (let i = n * channels; i < (n + 1) * channels; i++) sum += colors[i]! * colors[i]!;
      const energy = (sum * area) / distortion;
      const inner = Math.max(energy, LEAST_ENERGY);
      const at = n * (5 + channels);
      CURVATURE.forEach((c, i) => (this.steps[at + i] = Math.min(Math.sqrt(12 / (c * inner)), 1)));
      this.steps.fill(Math.sqrt((12 * distortion) / area), at + 5, at + 5 + channels);
      for (let least = 32; energy >= least && this.strengths[n]! < STRENGTHS - 1; least *= 4) this.strengths[n]! += 1;
    }
  }

  /** Return the Gaussians that whole numbers say, N x (5 + channels). */
  restore(codes: Int32Array): Numbers<Float32Array> {
    const { base, channels, steps } = this;
    const count = this.strengths.length;
    const found = {
      means: new Float32Array(2 * count),
      cholesky: new Float32Array(3 * count),
      colors: new Float32Array(channels * count),
    };
    const color = new Float64Array(channels);
    for (let n = 0; n < count; n++) {
      const at = n * (5 + channels);
      const change = (place: number, most: number): number => {
        const moved = codes[at + place]! * steps[at + place]!;
        if (Math.abs(moved) > most) throw new DecodeError(`a difference must be within ${most}; got ${moved}`);
        return moved;
      };
      const d1 = change(0, MOST_CHANGE);
      const d2 = change(1, MOST_CHANGE);
      const slant = change(3, MOST_CHANGE);
      const e1 = exp2(change(2, MOST_DOUBLINGS) * LOG2_E);
      const e2 = exp2(change(4, MOST_DOUBLINGS) * LOG2_E);
      const l11 = base.cholesky[3 * n]!;
      const l21 = base.cholesky[3 * n + 1]!;
      const l22 = base.cholesky[3 * n + 2]!;
      found.means[2 * n] = base.means[2 * n]! + l11 * d1;
      found.means[2 * n + 1] = base.means[2 * n + 1]! + (l21 * d1 + l22 * d2);
      found.cholesky[3 * n] = l11 * e1;
      found.cholesky[3 * n + 1] = l21 * e1 + l22 * slant;
      found.cholesky[3 * n + 2] = l22 * e2;
      restoreColor(codes.subarray(at + 5, at + 5 + channels), channels, steps[at + 5]!, color, 0);
      for (let i = 0; i < channels; i++) found.colors[n * channels + i] = base.colors[n * channels + i]! + color[i]!;
    }
    return found;
  }
}

/** Reads whole numbers; what was learned in one frame helps the next. */
export class DifferenceDecoder {
  private readonly changed = new AdaptiveSymbols(CHANGED, 300);
  private readonly sizes: readonly AdaptiveSymbols[];
  private readonly order: readonly (readonly [number, number])[];

  constructor(private readonly channels: number) {
    const tables = Array.from({ length: SUMS }, (_, sum) => sizesOf(sum));
    this.sizes = Array.from({ length: KINDS }, () => new AdaptiveSymbols(tables, 600));
    this.order = [...ORDER, ...Array.from({ length: channels - 1 }, (_, i) => [6 + i, HUE] as const)];
  }

  /** Read N x (5 + channels) numbers, by the strength of each Gaussian and what it did last. */
  read(decoder: RangeDecoder, strengths: Uint8Array, activity: Uint8Array): Int32Array {
    const count = strengths.length;
    const found = new Int32Array(count * (5 + this.channels));
    const contexts = strengths.map((strength, n) => activity[n]! * STRENGTHS + strength);
    for (let start = 0; start < count; start += TOGETHER) {
      const rows: number[] = [];
      this.changed.read(decoder, contexts.subarray(start, start + TOGETHER)).forEach((changed, n) => {
        if (changed) rows.push(start + n);
      });
      this.readRows(decoder, rows, found);
    }
    return found;
  }

  private readRows(decoder: RangeDecoder, rows: readonly number[], found: Int32Array): void {
    const sums = new Float64Array(rows.length);
    const contexts = new Uint8Array(rows.length);
    for (const [place, kind] of this.order) {
      sums.forEach((sum, n) => (contexts[n] = Math.min(sum, SUMS - 1)));
      const sizes = Int32Array.from(this.sizes[kind]!.read(decoder, contexts));
      for (let n = 0; n < sizes.length; n++) {
        if (sizes[n] !== ESCAPE) continue;
        const beyond = decoder.unbounded();
        if (beyond > MOST_BEYOND) throw new DecodeError(`a difference must be at most ${MOST_BEYOND} steps; got ${beyond}`);
        sizes[n]! += Number(beyond);
      }
      rows.forEach((row, n) => {
        const size = sizes[n]!;
        found[row * (5 + this.channels) + place] = size && decoder.uniform(2) ? -size : size;
        sums[n]! += size;
      });
    }
  }
}

/** What Gaussians did in a frame, by their whole numbers. */
export function activityOf(codes: Int32Array, each: number): Uint8Array {
  return new Uint8Array(codes.length / each).map((_, n) => {
    const sum = codes.subarray(each * n, each * (n + 1)).reduce((total, code) => total + Math.abs(code), 0);
    return sum === 0 ? 0 : sum <= CALM_SUM ? CALM : BUSY;
  });
}
