/** From whole numbers to Gaussians (docs/format.md); every operation in the order of the format. */

import { cosine, exp2, sine } from "../exact.ts";

const LN2 = 0.6931471805599453;
export const OCTAVES = 0.75; // that a class of size spans
const MAX_RATIO = 12;
const MAX_LEVELS = 2 ** 20;
// grey, red against blue, green against both: how much of each of the three a channel has
const OPPONENT = [
  [0.5773502691896258, 0.7071067811865476, -0.408248290463863],
  [0.5773502691896258, 0, 0.816496580927726],
  [0.5773502691896258, -0.7071067811865476, -0.408248290463863],
] as const;

export const MIN_SIZE = -8;
export const MAX_SIZE = 28;

const clip = (value: number, lowest: number): number => Math.min(Math.max(value, lowest), MAX_LEVELS);

/** The steps of a layer, whose Gaussians have one class of energy. */
export interface Steps {
  readonly unit: number; // u of the format
  readonly scales: number; // in a class of size
  readonly ratio: number; // in log2
  readonly mostRatio: number;
  readonly loud: number; // the amplitude, in steps of colour
}

export class Quantizer {
  private readonly distortion: number;
  private readonly pixels: number;

  constructor(parameter: number, height: number, width: number) {
    this.distortion = exp2(-parameter / 32);
    this.pixels = height * width;
  }

  steps(energy: number): Steps {
    const unit = Math.sqrt(((12 * this.distortion) / Math.PI) * exp2(-2 * energy - 1));
    const ratio = Math.max(unit * (1 / LN2), MAX_RATIO / MAX_LEVELS);
    return {
      unit,
      scales: clip(Math.floor(OCTAVES / (unit * (Math.sqrt(0.5) / LN2)) + 0.5), 1),
      ratio,
      mostRatio: Math.floor(MAX_RATIO / ratio + 0.5),
      loud: Math.sqrt(Math.PI / (12 * this.distortion)) * exp2(energy),
    };
  }

  /** The step of colours of a class of size. */
  colorStep(size: number): number {
    const area = Math.min(Math.PI * exp2(2 * OCTAVES * (size + 0.5)), this.pixels);
    return Math.sqrt((12 * this.distortion) / area);
  }
}

/** How many angles there are at a ratio. */
export function angles(steps: Steps, ratio: number): number {
  if (ratio === 0) return 1;
  const log = 2 * ratio * steps.ratio;
  const stretch = 0.5 * (exp2(log) - exp2(-log));
  return clip(Math.floor((Math.PI * stretch) / steps.unit + 0.5), 2);
}

/** Write l11, l21, l22 of a Gaussian to `into`, from `at` on; `share` is its angle by how many there are. */
export function restoreShape(
  steps: Steps,
  size: number,
  scale: number,
  ratio: number,
  share: number,
  into: Float64Array,
  offset: number,
): void {
  const middle = OCTAVES * (size + (scale + 0.5) / steps.scales);
  const stretch = ratio * steps.ratio;
  const major = exp2(middle + stretch);
  const minor = exp2(middle - stretch);
  const cos = cosine(share);
  const sin = sine(share);
  const along = major * cos;
  const across = minor * sin;
  const l11 = Math.sqrt(along * along + across * across);
  into[offset] = l11;
  into[offset + 1] = ((major * major - minor * minor) * cos * sin) / l11;
  into[offset + 2] = (major * minor) / l11;
}

/** How many places there are along the side of a cell, for a Gaussian whose l11, or l22, is `length`. */
export function places(steps: Steps, side: number, length: number): number {
  return clip(Math.ceil(side / (steps.unit * Math.SQRT2 * length)), 1);
}

/** Write a colour of whole numbers `codes` to `into`, both from `at` on. */
export function restoreColor(
  codes: Int32Array,
  channels: number,
  step: number,
  into: Float32Array,
  offset: number,
): void {
  if (channels !== 3) {
    for (let i = offset; i < offset + channels; i++) into[i] = codes[i]! * step;
    return;
  }
  const grey = codes[offset]! * step;
  const hue = codes[offset + 1]! * step;
  const hue2 = codes[offset + 2]! * step;
  OPPONENT.forEach(([a, b, c], i) => (into[offset + i] = grey * a + hue * b + hue2 * c));
}
