/**
 * Changes of regions, which are positions among the map's ids: each takes a scene and gives another, as `kcgs.editing`
 * does, without its filling of holes.
 */

import type { ContourWidth, RegionMap, Scene } from "../decoder/scene.ts";

export type Edit = (scene: Scene) => Scene;

const FLAT = 1e3; // standard deviation of a flat Gaussian, in sides of the image
const FAR = 1e20;

/** Colours times `gain`, a number or one for each channel, plus `bias`, exactly so in the image. */
export function recolour(regions: ReadonlySet<number>, gain: Channels, bias: Channels | null): Edit {
  return (scene) => {
    const { channels, count, positions } = scene;
    const factors = spread("gain", gain, channels);
    const colors = scene.colors.slice();
    for (let i = 0; i < count; i++) {
      if (positions !== null && !regions.has(positions[i]!)) continue;
      for (let c = 0; c < channels; c++) colors[i * channels + c]! *= factors[c]!;
    }
    const changed = { ...scene, colors };
    return bias === null ? changed : withFlat(changed, [...regions], spread("bias", bias, channels));
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
  const sigma = FLAT * Math.max(scene.width, scene.height);
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
export function move(moved: ReadonlySet<number>, dx: number, dy: number): Edit {
  return (scene) => {
    const { regions, positions } = scene;
    if (regions === null || positions === null) throw new RangeError("a scene without regions has none to move");
    if (moved.size === regions.ids.length) throw new RangeError("ids must leave a region that does not move");
    if (!Number.isInteger(dx) || !Number.isInteger(dy)) {
      throw new RangeError(`dx and dy must be whole; got ${dx}, ${dy}`);
    }
    const labels = movedLabels(regions.labels, scene.width, moved, dx, dy);
    const means = scene.means.map((value, i) => (moved.has(positions[i >> 1]!) ? value + (i % 2 ? dy : dx) : value));
    return { ...scene, means, regions: { ...regions, labels, pairs: movedPairs(regions, scene.width, moved) } };
  };
}

function movedLabels(
  labels: Int32Array,
  width: number,
  moved: ReadonlySet<number>,
  dx: number,
  dy: number,
): Int32Array {
  const height = labels.length / width;
  const result = nearestOthers(labels, width, height, moved);
  labels.forEach((label, i) => {
    if (!moved.has(label)) return;
    const [x, y] = [(i % width) + dx, Math.floor(i / width) + dy];
    if (x >= 0 && y >= 0 && x < width && y < height) result[y * width + x] = label;
  });
  return result;
}

/** Give each label of a hole the nearest other one, of several the lowest: along columns, then along rows. */
function nearestOthers(labels: Int32Array, width: number, height: number, hole: ReadonlySet<number>): Int32Array {
  const rows = nearestInColumns(labels, width, height, hole);
  const result = labels.slice();
  const square = (x: number, y: number): number => (rows[y * width + x]! < 0 ? FAR : (rows[y * width + x]! - y) ** 2);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      if (!hole.has(labels[y * width + x]!)) continue;
      let [best, label] = [FAR, 0];
      for (let step = 0; step * step <= best && step < width; step++) {
        for (const other of [x - step, x + step]) {
          if (other < 0 || other >= width) continue;
          const distance = step * step + square(other, y);
          if (distance > best || distance >= FAR) continue;
          const found = labels[rows[y * width + other]! * width + other]!;
          if (distance < best || found < label) [best, label] = [distance, found];
        }
      }
      result[y * width + x] = label;
    }
  }
  return result;
}

/** The nearest row of each column that is not in the hole; -1 where there is none. */
function nearestInColumns(labels: Int32Array, width: number, height: number, hole: ReadonlySet<number>): Int32Array {
  const rows = new Int32Array(labels.length).fill(-1);
  for (let x = 0; x < width; x++) {
    for (let y = 0, last = -1; y < height; y++) {
      if (!hole.has(labels[y * width + x]!)) last = y;
      rows[y * width + x] = last;
    }
    for (let y = height - 1, next = -1; y >= 0; y--) {
      if (!hole.has(labels[y * width + x]!)) next = y;
      const last = rows[y * width + x]!;
      const lower = (): boolean => labels[next * width + x]! < labels[last * width + x]!;
      const nearer = next - y - (y - last);
      if (next >= 0 && (last < 0 || nearer < 0 || (nearer === 0 && lower()))) rows[y * width + x] = next;
    }
  }
  return rows;
}

/** A moved region and one that it did not touch before have the mean width of the contours that it had. */
function movedPairs(map: RegionMap, width: number, moved: ReadonlySet<number>): ContourWidth[] {
  if (map.softness !== null) return map.pairs;
  const widths = new Map(map.pairs.map(({ a, b, width }) => [`${a} ${b}`, width]));
  const key = (a: number, b: number): string => `${Math.min(a, b)} ${Math.max(a, b)}`;
  const touching = touchingRegions(map.labels, width, moved);
  for (const region of moved) {
    const others = touching.get(region) ?? new Set<number>();
    const sum = [...others].reduce((total, other) => total + (widths.get(key(region, other)) ?? 0), 0);
    for (const other of map.ids.keys()) {
      if (other === region || others.has(other) || moved.has(other)) continue;
      widths.set(key(region, other), sum / Math.max(1, others.size));
    }
  }
  return [...widths].map(([pair, width]) => {
    const [a, b] = pair.split(" ").map(Number) as [number, number];
    return { a, b, width };
  });
}

function touchingRegions(labels: Int32Array, width: number, wanted: ReadonlySet<number>): Map<number, Set<number>> {
  const found = new Map([...wanted].map((region) => [region, new Set<number>()]));
  const note = (a: number, b: number): void => {
    if (a === b) return;
    found.get(a)?.add(b);
    found.get(b)?.add(a);
  };
  for (let i = 0; i < labels.length; i++) {
    if ((i + 1) % width !== 0) note(labels[i]!, labels[i + 1]!);
    if (i + width < labels.length) note(labels[i]!, labels[i + width]!);
  }
  return found;
}
