/** Affine motions of regions, and what they do to Gaussians (docs/format.md, "Motions"); operations in its order. */

import { AdaptiveNumber } from "../models/adaptive_number.ts";
import { AdaptiveSymbol } from "../models/adaptive_symbol.ts";
import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";

const UNIT = 2 ** 16; // a pixel, and a factor of 1
const FACTOR = 4;
const SHIFT = 4096;
const MOST_FACTOR = 2 ** 16;
const MOST_SHIFT = 2 ** 24;
const AREAS = [1 / 64, 64] as const; // by which an area may shrink
const SIZES = [2, ...Array<number>(6).fill(2), ...Array<number>(18).fill(0.3)];
const isShift = (place: number): boolean => place % 3 === 2;

/** Centres, factors and colours in one order, of N Gaussians. */
export interface Numbers<T> {
  readonly means: T; // N x 2
  readonly cholesky: T; // N x 3
  readonly colors: T; // N x channels
}

export class MotionDecoder {
  private readonly last: Int32Array; // six numbers of each region
  private readonly changes = new AdaptiveSymbol([2, 1]);
  private readonly factors = new AdaptiveNumber(SIZES);
  private readonly shifts = new AdaptiveNumber(SIZES);

  constructor(
    private readonly regions: number,
    private readonly height: number,
    private readonly width: number,
  ) {
    this.last = new Int32Array(6 * regions);
  }

  /** Read the motions of all regions, a to f of each, whole numbers in 1/65536. */
  read(decoder: RangeDecoder): Float64Array {
    const motions = new Float64Array(this.last.length);
    this.changes.read(decoder, this.regions).forEach((changed, region) => {
      if (changed) for (let place = 0; place < 6; place++) this.change(decoder, 6 * region + place);
    });
    for (let at = 0; at < motions.length; at += 6) this.expand(at, motions);
    return motions;
  }

  private change(decoder: RangeDecoder, at: number): void {
    const shift = isShift(at % 6);
    const size = (shift ? this.shifts : this.factors).read(decoder);
    const number = this.last[at]! + (size && decoder.fair() ? -size : size);
    const most = shift ? MOST_SHIFT : MOST_FACTOR;
    if (Math.abs(number) > most) throw new DecodeError(`a number of a motion must be within ${most}; got ${number}`);
    this.last[at] = number;
  }

  private expand(at: number, motions: Float64Array): void {
    for (let place = 0; place < 6; place += 3) {
      const across = FACTOR * this.last[at + place]!;
      const down = FACTOR * this.last[at + place + 1]!;
      motions[at + place] = across + (place ? 0 : UNIT);
      motions[at + place + 1] = down + (place ? UNIT : 0);
      motions[at + place + 2] =
        SHIFT * this.last[at + place + 2]! - Math.floor((across * this.width + down * this.height) / 2);
    }
    const [a, b, , d, e] = motions.subarray(at, at + 6).map((number) => number / UNIT) as unknown as number[];
    const area = a! * e! - b! * d!;
    if (!(area > AREAS[0] && area < AREAS[1]))
      throw new DecodeError(`a motion must scale areas by ${AREAS[0]} to ${AREAS[1]}; got ${area}`);
  }
}

/** Move Gaussians with their regions, in float64. */
export function moveGaussians(
  { means, cholesky, colors }: Numbers<Float32Array>,
  regions: Int32Array,
  motions: Float64Array,
): Numbers<Float64Array> {
  const found = {
    means: new Float64Array(means.length),
    cholesky: new Float64Array(cholesky.length),
    colors: Float64Array.from(colors),
  };
  for (let n = 0; n < regions.length; n++) {
    const at = 6 * regions[n]!;
    const a = motions[at]! / UNIT;
    const b = motions[at + 1]! / UNIT;
    const d = motions[at + 3]! / UNIT;
    const e = motions[at + 4]! / UNIT;
    const area = a * e - b * d;
    const dx = means[2 * n]! - motions[at + 2]! / UNIT;
    const dy = means[2 * n + 1]! - motions[at + 5]! / UNIT;
    found.means[2 * n] = (e * dx - b * dy) / area;
    found.means[2 * n + 1] = (a * dy - d * dx) / area;
    const l11 = cholesky[3 * n]!;
    const l21 = cholesky[3 * n + 1]!;
    const l22 = cholesky[3 * n + 2]!;
    // the inverse matrix times the factor, made lower triangular again by a rotation
    const x1 = (e * l11 - b * l21) / area;
    const x2 = (-b * l22) / area;
    const y1 = (a * l21 - d * l11) / area;
    const y2 = (a * l22) / area;
    const first = Math.sqrt(x1 * x1 + x2 * x2);
    found.cholesky[3 * n] = first;
    found.cholesky[3 * n + 1] = (x1 * y1 + x2 * y2) / first;
    found.cholesky[3 * n + 2] = (x1 * y2 - x2 * y1) / first;
  }
  return found;
}
