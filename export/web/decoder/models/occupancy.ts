/** The number of Gaussians in each cell of a grid over the image (docs/format.md, "Occupancy"). */

import { beginnings, type RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import { AdaptiveNumber } from "./adaptive_number.ts";

const MOST_MARGIN = 255;
const FULL = 7; // a cell with this many has another symbol

/** For each Gaussian of a class the column and the row of its cell; in order, row by row. */
export interface Cells {
  readonly side: number; // pixels
  readonly column: Int32Array;
  readonly row: Int32Array;
}

/** Reads the cells of one class after another; what was learned in one helps the next. */
export class Occupancy {
  private readonly margin = new AdaptiveNumber([3, 1, 1, 1, 1, 0.3, 0.3, 0.3, 0.3]);
  private outside = 0.5;
  private all = 20;

  constructor(
    private readonly height: number,
    private readonly width: number,
  ) {}

  /** Read the cells of `count` Gaussians. */
  read(decoder: RangeDecoder, count: number): Cells {
    const side = cellSide(this.height, this.width, count);
    const rows = Math.ceil(this.height / side);
    const columns = Math.ceil(this.width / side);
    const margin = this.margin.read(decoder);
    const most = mostMargin(rows, columns);
    if (margin > most) throw new DecodeError(`a margin must be at most ${most} cells; got ${margin}`);
    const share = margin ? this.outside / this.all : 0;
    const wide = columns + 2 * margin;
    const cells = rows * columns;
    const ring = (rows + 2 * margin) * wide - cells;
    const inside = readCounts(decoder, Math.max(count * (1 - share), 0.01) / cells, cells, count);
    const left = count - inside.length;
    const outside = readCounts(decoder, Math.max(count * share, 0.01) / Math.max(ring, 1), ring, left);
    if (outside.length < left)
      throw new DecodeError(`cells must hold ${count} Gaussians; got ${inside.length + outside.length}`);
    if (margin) {
      this.outside += outside.length;
      this.all += count;
    }
    const place = new Float64Array(count);
    inside.forEach((cell, i) => {
      place[i] = (Math.floor(cell / columns) + margin) * wide + (cell % columns) + margin;
    });
    outside.forEach((cell, i) => (place[inside.length + i] = placeOutside(cell, rows, columns, margin)));
    if (margin) place.sort();
    return {
      side,
      column: Int32Array.from(place, (at) => (at % wide) - margin),
      row: Int32Array.from(place, (at) => Math.floor(at / wide) - margin),
    };
  }
}

/** The side of the cells of so many Gaussians, a power of two. */
function cellSide(height: number, width: number, count: number): number {
  const q = Math.floor((height * width) / (16 * count));
  let side = 1;
  while (4 * side * side <= q) side *= 2;
  return side;
}

/** The most cells on each side, such that all are at most 2**17 plus 16 times those inside. */
function mostMargin(rows: number, columns: number): number {
  const most = 2 ** 17 + 16 * rows * columns;
  let margin = 0;
  while (margin < MOST_MARGIN && (rows + 2 * margin + 2) * (columns + 2 * margin + 2) <= most) margin++;
  return margin;
}

/** Where a cell outside is among all cells, row by row, given where it is among those outside. */
function placeOutside(cell: number, rows: number, columns: number, margin: number): number {
  const top = margin * (columns + 2 * margin);
  if (cell < top) return cell;
  const row = Math.floor((cell - top) / (2 * margin));
  if (row >= rows) return cell + rows * columns;
  const beside = (cell - top) % (2 * margin);
  return cell + (row + (beside < margin ? 0 : 1)) * columns;
}

/** Read which of the cells each Gaussian lies in, in order; there are at most so many. */
function readCounts(decoder: RangeDecoder, rate: number, cells: number, most: number): Float64Array {
  const p = rate / (1 + rate);
  const weights = [1 - p];
  for (let i = 0; i < FULL; i++) weights.push(weights[i]! * p);
  weights[FULL]! /= 1 - p;
  const begins = beginnings(weights);
  const occupied: number[] = [];
  const counts: number[] = [];
  let left = most;
  const add = (count: number): number => {
    left -= count;
    if (left < 0) throw new DecodeError(`cells must hold ${most} Gaussians; got more`);
    return count;
  };
  for (let cell = 0; cell < cells; cell++) {
    const count = decoder.categorical(begins);
    if (count === 0) continue;
    occupied.push(cell);
    counts.push(add(count));
  }
  let full = counts.flatMap((count, i) => (count === FULL ? [i] : []));
  while (full.length)
    full = full.filter((i) => {
      const more = add(decoder.categorical(begins));
      counts[i]! += more;
      return more === FULL;
    });
  const found = new Float64Array(most - left);
  let start = 0;
  counts.forEach((count, i) => found.fill(occupied[i]!, start, (start += count)));
  return found;
}
