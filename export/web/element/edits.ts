/**
 * Changes of regions, which are positions among the map's ids: each takes a scene and gives another, as `kcgs.editing`
 * does, without its filling of holes.
 */

import { touchingPairs } from "../decoder/pairs.ts";
import type { ContourWidth, RegionMap, Scene } from "../decoder/scene.ts";
import { nearest } from "../renderer/levels.ts";

export type Edit = (scene: Scene) => Scene;

const FLAT_SIGMA = 1e3; // standard deviation of a flat Gaussian, in sides of the image

/** Colours times `gain`, a number or one for each channel, plus `bias`, exactly so in the image. */
export function recolor(regions: ReadonlySet<number>, gain: Channels, bias: Channels | null): Edit {
  return (scene) => {
    const { channels, count, positions } = scene;
    const factors = spread("gain", gain, channels);
    const colors = scene.colors.slice();
    for (let i = 0; i < count; i++) {
      if (positions !== null && !regions.has(positions[i]!)) continue;
      for (let c = 0; c < channels; c++) colors[i * channels + c]! *= factors[c]!;
    }
    const recoloured = { ...scene, colors };
    return bias === null ? recoloured : withFlat(recoloured, [...regions], spread("bias", bias, channels));
  };
}

export type Channels = number | readonly number[];

function spread(name: string, value: Channels, channels: number): readonly number[] {
  const numbers = typeof value === "number" ? Array<number>(channels).fill(value) : value;
  if (numbers.length !== channels || !numbers.every(Number.isFinite)) {
    throw new RangeError(`${name} must be a number or ${channels} of them; got ${String(value)}`);
  }
  return numbers;
}

/** Add a colour to regions: one Gaussian for each, flat over the whole image. */
function withFlat(scene: Scene, regions: readonly number[], color: readonly number[]): Scene {
  const sigma = FLAT_SIGMA * Math.max(scene.width, scene.height);
  const add = (numbers: Float32Array, row: readonly number[]): Float32Array =>
    Float32Array.from([...numbers, ...regions.flatMap(() => row)]);
  return {
    ...scene,
    count: scene.count + regions.length,
    means: add(scene.means, [scene.width / 2, scene.height / 2]),
    cholesky: add(scene.cholesky, [sigma, 0, sigma]),
    colors: add(scene.colors, color),
    positions: scene.positions === null ? null : Int32Array.from([...scene.positions, ...regions]),
  };
}

/** Move regions over whatever lies there; what they leave falls to the nearest other region. */
export function move(selection: ReadonlySet<number>, dx: number, dy: number): Edit {
  return (scene) => {
    const { regions, positions } = scene;
    if (regions === null || positions === null) throw new RangeError("a scene without regions has none to move");
    if (selection.size === regions.ids.length) throw new RangeError("ids must leave a region that does not move");
    if (!Number.isInteger(dx) || !Number.isInteger(dy)) {
      throw new RangeError(`dx and dy must be whole; got ${dx}, ${dy}`);
    }
    const labels = movedLabels(regions.labels, scene.width, selection, dx, dy);
    const means = scene.means.map((value, i) => (selection.has(positions[i >> 1]!) ? value + (i % 2 ? dy : dx) : value));
    return { ...scene, means, regions: { ...regions, labels, pairs: pairsOf(regions, labels, scene.width) } };
  };
}

function movedLabels(
  labels: Int32Array,
  width: number,
  selection: ReadonlySet<number>,
  dx: number,
  dy: number,
): Int32Array {
  const height = labels.length / width;
  const others = labels.map((label) => (selection.has(label) ? -1 : label));
  const result = Int32Array.from(nearest(others, width, height, Math.max(width, height)));
  labels.forEach((label, i) => {
    if (!selection.has(label)) return;
    const [x, y] = [(i % width) + dx, Math.floor(i / width) + dy];
    if (x >= 0 && y >= 0 && x < width && y < height) result[y * width + x] = label;
  });
  return result;
}

/** Contour widths of the new labels: pairs that did not touch before have the mean of all. */
function pairsOf(map: RegionMap, labels: Int32Array, width: number): ContourWidth[] {
  if (map.softness !== null) return map.pairs;
  const regions = map.ids.length;
  const mean = map.pairs.reduce((total, pair) => total + pair.width, 0) / map.pairs.length;
  const previous = new Set([
    ...touchingPairs(map.labels, width, regions),
    ...map.pairs.map(({ a, b }) => a * regions + b),
  ]);
  const added = Array.from(touchingPairs(labels, width, regions)).filter((pair) => !previous.has(pair));
  return [...map.pairs, ...added.map((pair) => ({ a: Math.floor(pair / regions), b: pair % regions, width: mean }))];
}
