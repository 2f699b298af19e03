/** Which of the contour widths of a map each label has: that of the contour it is nearest to. */

import type { RegionMap } from "../decoder/scene.ts";

const SEARCH_SIGMAS = 4 * Math.SQRT2;

export interface Levels {
  readonly widths: readonly number[]; // pixels
  readonly of: Uint16Array | null; // position in `widths` of each label; null: all have the first
}

export function contourLevels(map: RegionMap, width: number, height: number): Levels {
  if (map.softness !== null) return { widths: [map.softness], of: null };
  const regions = map.ids.length;
  const widthOf = new Map(map.pairs.map(({ a, b, width }) => [a * regions + b, width]));
  const levelOfWidth = new Map<number, number>();
  const touching = touchingLevels(map.labels, width, height, (a, b) => {
    const sigma = widthOf.get(Math.min(a, b) * regions + Math.max(a, b)) ?? 0;
    if (!levelOfWidth.has(sigma)) levelOfWidth.set(sigma, levelOfWidth.size);
    return levelOfWidth.get(sigma)!;
  });
  const widths = [...levelOfWidth.keys()];
  if (widths.length < 2) return { widths: [widths[0] ?? 0], of: null };
  // farther labels are of one region alone, and so are those beside them
  const search = Math.ceil(SEARCH_SIGMAS * Math.max(...widths)) + 2;
  return { widths, of: nearest(touching, width, height, search) };
}

/** Give each label that touches a contour the level of that, and -1 to others: above, left, right, below, the first. */
function touchingLevels(
  labels: Int32Array,
  width: number,
  height: number,
  levelOf: (a: number, b: number) => number,
): Int32Array {
  const levels = new Int32Array(labels.length).fill(-1);
  for (let y = 0, pixel = 0; y < height; y++) {
    for (let x = 0; x < width; x++, pixel++) {
      const label = labels[pixel]!;
      let other = label;
      if (y > 0 && labels[pixel - width] !== label) other = labels[pixel - width]!;
      else if (x > 0 && labels[pixel - 1] !== label) other = labels[pixel - 1]!;
      else if (x < width - 1 && labels[pixel + 1] !== label) other = labels[pixel + 1]!;
      else if (y < height - 1 && labels[pixel + width] !== label) other = labels[pixel + width]!;
      if (other !== label) levels[pixel] = levelOf(label, other);
    }
  }
  return levels;
}

/** Give each place the level, not -1, of the nearest that has one; of several the leftmost, then the topmost. */
export function nearest(levels: Int32Array, width: number, height: number, search: number): Uint16Array {
  const rows = nearestRows(levels, width, height);
  const result = new Uint16Array(levels.length);
  for (let y = 0; y < height; y++) {
    const line = y * width;
    const distance = (x: number): number => {
      const row = rows[line + x]!;
      return row < 0 ? Infinity : (row - y) ** 2;
    };
    for (let x = 0; x < width; x++) {
      let [best, column] = [distance(x), x];
      for (let step = 1; step <= search && step * step <= best; step++) {
        const square = step * step;
        if (x - step >= 0 && square + distance(x - step) <= best) {
          best = square + distance(x - step);
          column = x - step;
        }
        if (x + step < width && square + distance(x + step) < best) {
          best = square + distance(x + step);
          column = x + step;
        }
      }
      if (best < Infinity) result[line + x] = levels[rows[line + column]! * width + column]!;
    }
  }
  return result;
}

/** The nearest row of each column that has a level, the upper one of two; -1 where there is none. */
function nearestRows(levels: Int32Array, width: number, height: number): Int32Array {
  const rows = new Int32Array(levels.length);
  for (let x = 0; x < width; x++) {
    for (let y = 0, last = -1; y < height; y++) {
      const pixel = y * width + x;
      if (levels[pixel]! >= 0) last = y;
      rows[pixel] = last;
    }
    for (let y = height - 1, next = -1; y >= 0; y--) {
      const pixel = y * width + x;
      if (levels[pixel]! >= 0) next = y;
      if (next >= 0 && (rows[pixel]! < 0 || next - y < y - rows[pixel]!)) rows[pixel] = next;
    }
  }
  return rows;
}
