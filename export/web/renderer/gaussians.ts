/** The Gaussians of a scene as renderers take them: sorted by region, with how far each is seen. */

import type { Scene } from "../decoder/scene.ts";

/** Weights below it are skipped in Python; weights that add less colour than it are skipped here. */
const CUTOFF = 1e-4;
const MAX_CUTOFF = 0.5;

export interface Gaussians {
  readonly count: number;
  readonly channels: number;
  readonly means: Float32Array;
  readonly cholesky: Float32Array;
  readonly colors: Float32Array;
  readonly regions: Uint32Array; // positions among the map's ids
  readonly radii: Float32Array; // standard deviations
  readonly starts: Uint32Array; // the first Gaussian of each region, and their number
}

export function gaussiansOf(scene: Scene): Gaussians {
  const { count, channels } = scene;
  const places = scene.positions ?? new Int32Array(count);
  const numRegions = scene.regions?.ids.length ?? 1;
  const starts = new Uint32Array(numRegions + 1);
  const radii = Float32Array.from({ length: count }, (_, i) => radius(scene.colors, i * channels, channels));
  for (let i = 0; i < count; i++) if (radii[i]! > 0) starts[places[i]! + 1]!++;
  for (let r = 0; r < numRegions; r++) starts[r + 1]! += starts[r]!;
  const next = starts.slice();
  const order = new Uint32Array(starts[numRegions]!);
  for (let i = 0; i < count; i++) if (radii[i]! > 0) order[next[places[i]!]!++] = i;
  return {
    count: order.length,
    channels,
    means: pick(scene.means, order, 2),
    cholesky: pick(scene.cholesky, order, 3),
    colors: pick(scene.colors, order, channels),
    regions: Uint32Array.from(order, (i) => places[i]!),
    radii: pick(radii, order, 1),
    starts,
  };
}

function radius(colors: Float32Array, from: number, channels: number): number {
  let largest = 0;
  for (let c = 0; c < channels; c++) largest = Math.max(largest, Math.abs(colors[from + c]!));
  if (largest <= CUTOFF) return 0;
  return Math.sqrt(-2 * Math.log(Math.min(Math.max(CUTOFF / largest, CUTOFF), MAX_CUTOFF)));
}

function pick(numbers: Float32Array, order: Uint32Array, width: number): Float32Array {
  const picked = new Float32Array(order.length * width);
  for (let i = 0; i < order.length; i++) {
    for (let j = 0; j < width; j++) picked[i * width + j] = numbers[order[i]! * width + j]!;
  }
  return picked;
}
