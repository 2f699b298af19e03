/** Sums Gaussians on the CPU, row by row, where their region has pixels. */

import type { Runs } from "./contours.ts";
import type { Gaussians } from "./gaussians.ts";
import type { FineAxis } from "./sampling.ts";

/** Sum the Gaussians of all regions: (height, width, channels), not clipped. */
export function sumGaussians(gaussians: Gaussians, runs: Runs, across: FineAxis, down: FineAxis): Float32Array {
  const image = new Float32Array(across.count * down.count * gaussians.channels);
  const rowStarts = new Int32Array(down.count + 1);
  const add = gaussians.channels === 3 ? addColors : addAny;
  for (let region = 0; region < gaussians.starts.length - 1; region++) {
    const [first, end] = [runs.starts[region]!, runs.starts[region + 1]!];
    const [begin, stop] = [gaussians.starts[region]!, gaussians.starts[region + 1]!];
    if (first === end || begin === stop) continue;
    const [top, bottom] = [runs.rows[first]!, runs.rows[end - 1]! + 1];
    for (let row = top, run = first; row <= bottom; row++) {
      while (run < end && runs.rows[run]! < row) run++;
      rowStarts[row] = run;
    }
    for (let i = begin; i < stop; i++) {
      addGaussian(image, gaussians, i, runs, rowStarts, top, bottom, across, down, add);
    }
  }
  return image;
}

/** A row of a Gaussian: its weight at the first column, and what the weights of columns are multiplied by. */
interface Row {
  weight: number;
  ratio: number; // of the second weight to the first
  bend: number; // of each ratio to the one before
}

const row: Row = { weight: 0, ratio: 0, bend: 0 };

type Add = (
  image: Float32Array,
  offset: number,
  count: number,
  colors: Float32Array,
  color: number,
  channels: number,
  shares: Float32Array | null,
  share: number,
) => void;

/**
 * Along a row the exponent is a parabola: each weight is the one before times a ratio, and each ratio the one before
 * times a constant. In float64 that is off by count^2 rounding errors.
 */
function addGaussian(
  image: Float32Array,
  gaussians: Gaussians,
  i: number,
  runs: Runs,
  rowStarts: Int32Array,
  top: number,
  bottom: number,
  across: FineAxis,
  down: FineAxis,
  add: Add,
): void {
  const { means, cholesky, colors, radii, channels } = gaussians;
  const [x, y] = [
    (means[2 * i]! - across.start) / across.step - 0.5,
    (means[2 * i + 1]! - down.start) / down.step - 0.5,
  ];
  const l11 = cholesky[3 * i]! / across.step;
  const [l21, l22] = [cholesky[3 * i + 1]! / down.step, cholesky[3 * i + 2]! / down.step];
  const square = radii[i]! * radii[i]!;
  const variance = l21 * l21 + l22 * l22; // along y
  const reach = radii[i]! * Math.sqrt(variance);
  const slope = (l21 * l11) / variance;
  const narrow = (l11 * l11 * l22 * l22) / variance; // of a row
  row.bend = Math.exp(-1 / narrow);
  const last = Math.min(bottom - 1, Math.floor(y + reach));
  for (let line = Math.max(top, Math.ceil(y - reach)); line <= last; line++) {
    const run = rowStarts[line]!;
    const stop = rowStarts[line + 1]!;
    if (run === stop) continue;
    const dy = line - y;
    const nearest = (dy * dy) / variance;
    const middle = x + dy * slope;
    const half = Math.sqrt(Math.max(0, square - nearest) * narrow);
    const begin = Math.max(Math.ceil(middle - half), 0);
    const end = Math.min(Math.floor(middle + half) + 1, across.count);
    for (let r = run; r < stop; r++) {
      const from = Math.max(begin, runs.from[r]!);
      const to = Math.min(end, runs.to[r]!);
      if (from >= to) continue;
      const t = from - middle;
      row.weight = Math.exp(-0.5 * (nearest + (t * t) / narrow));
      row.ratio = Math.exp((-0.5 * (2 * t + 1)) / narrow);
      const place = runs.weights[r]!;
      const shares = place < 0 ? null : runs.shares;
      add(
        image,
        (line * across.count + from) * channels,
        to - from,
        colors,
        i * channels,
        channels,
        shares,
        place + from - runs.from[r]!,
      );
    }
  }
}

function addColors(
  image: Float32Array,
  offset: number,
  count: number,
  colors: Float32Array,
  color: number,
  _: number,
  shares: Float32Array | null,
  share: number,
): void {
  const [red, green, blue] = [colors[color]!, colors[color + 1]!, colors[color + 2]!];
  let { weight, ratio } = row;
  const bend = row.bend;
  const end = offset + 3 * count;
  if (shares === null) {
    for (; offset < end; offset += 3) {
      image[offset] = image[offset]! + weight * red;
      image[offset + 1] = image[offset + 1]! + weight * green;
      image[offset + 2] = image[offset + 2]! + weight * blue;
      weight *= ratio;
      ratio *= bend;
    }
    return;
  }
  for (; offset < end; offset += 3) {
    const part = weight * shares[share++]!;
    image[offset] = image[offset]! + part * red;
    image[offset + 1] = image[offset + 1]! + part * green;
    image[offset + 2] = image[offset + 2]! + part * blue;
    weight *= ratio;
    ratio *= bend;
  }
}

function addAny(
  image: Float32Array,
  offset: number,
  count: number,
  colors: Float32Array,
  color: number,
  channels: number,
  shares: Float32Array | null,
  share: number,
): void {
  let { weight, ratio } = row;
  for (let i = 0; i < count; i++) {
    const part = shares === null ? weight : weight * shares[share + i]!;
    for (let c = 0; c < channels; c++) image[offset + i * channels + c]! += part * colors[color + c]!;
    weight *= ratio;
    ratio *= row.bend;
  }
}
