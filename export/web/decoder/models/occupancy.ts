/** The number of Gaussians in each cell of a grid over the image (docs/format.md, "Occupancy"). */

import { MARGINS, OUTSIDE } from "../gaussians/weights.ts";
import type { Program } from "../program.ts";
import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import { AdaptiveNumber } from "./adaptive_number.ts";

const MAX_MARGIN = 255;
const NEAR = 2; // classes of size
const EVERYWHERE = 480000; // weight that all cells share before any Gaussian: 64 * 625 * 12
// of a file: classes of size, cells outside, and those for each Gaussian
const MAX_CLASSES = 4096;
const MAX_OUTSIDE = 2 ** 26;
const EACH_OUTSIDE = 1024;

/** For each Gaussian of a class the column and the row of its cell; in order, row by row. */
export interface Cells {
  readonly side: number; // pixels
  readonly column: Int32Array;
  readonly row: Int32Array;
}

/** The cells of an image, and how many more the margin has. */
interface Grid {
  readonly rows: number;
  readonly columns: number;
  readonly side: number;
  readonly ring: number;
}

/** Where Gaussians are among the cells inside and outside. */
type Places = readonly [Uint32Array, Uint32Array];

/** Reads the cells of one class after another; what was learned in one helps the next. */
export class Occupancy {
  private readonly margin = new AdaptiveNumber(MARGINS);
  private readonly outside = new AdaptiveNumber(OUTSIDE);
  private readonly earlier = new Map<number, Cells[]>(); // by class of size
  private classes = 0;
  private gaussians = 0; // so far
  private outsideCells = 0; // so far

  constructor(
    private readonly height: number,
    private readonly width: number,
  ) {}

  /** Read the cells of `count` Gaussians of a class of size. */
  read(decoder: RangeDecoder, size: number, count: number): Cells {
    const side = cellSide(this.height, this.width, count);
    const rows = Math.ceil(this.height / side);
    const columns = Math.ceil(this.width / side);
    const margin = this.margin.read(decoder);
    const limit = mostMargin(rows, columns);
    if (margin > limit) throw new DecodeError(`a margin must be at most ${limit} cells; got ${margin}`);
    const wide = columns + 2 * margin;
    const grid = { rows, columns, side, ring: (rows + 2 * margin) * wide - rows * columns };
    const [inside, outside] = this.readNear(decoder, grid, size, count);
    if (inside.length + outside.length < count)
      throw new DecodeError(`cells must hold ${count} Gaussians; got ${inside.length + outside.length}`);
    const column = new Int32Array(count);
    const row = new Int32Array(count);
    const place = merge(inside, outside, rows, columns, margin);
    for (let i = 0; i < count; i++) {
      row[i] = Math.floor(place[i]! / wide) - margin;
      column[i] = (place[i]! % wide) - margin;
    }
    const coarser = { side, column, row };
    this.earlier.set(size, [...(this.earlier.get(size) ?? []), coarser]);
    return coarser;
  }

  /** Read cells that are the more likely, the more earlier Gaussians of about this size are near. */
  private readNear(decoder: RangeDecoder, { rows, columns, side, ring }: Grid, size: number, count: number): Places {
    const { program } = decoder;
    const outside = ring ? this.outside.read(decoder) : 0;
    if (outside > count) throw new DecodeError(`at most ${count} Gaussians may lie outside; got ${outside}`);
    this.gaussians += count;
    if (outside) this.outsideCells += ring;
    if (this.classes++ === MAX_CLASSES || this.outsideCells > MAX_OUTSIDE + EACH_OUTSIDE * this.gaussians)
      throw new DecodeError("a file must have fewer grids of cells");
    const near: number[] = [];
    const shift = 32 - Math.clz32(side); // of half pixels
    for (let other = size; other <= size + NEAR; other++)
      for (const cells of this.earlier.get(other) ?? [])
        cells.row.forEach((each, n) => {
          const row = ((2 * each + 1) * cells.side) >> shift;
          const column = ((2 * cells.column[n]! + 1) * cells.side) >> shift;
          if (row >= 0 && row < rows && column >= 0 && column < columns) near.push(row, column);
        });
    const address = program.openEarlier(near.length / 2);
    new Int32Array(program.memory.buffer, address, near.length).set(near);
    const base = Math.max(Math.floor(EVERYWHERE / (rows * columns)), 1);
    const inside = listed(program, program.readNear(rows, columns, base, near.length / 2, count - outside));
    return [inside, listed(program, program.readNear(ring, 1, 1, 0, outside))];
  }
}

/** Where cells inside and outside are among all cells, row by row. */
function merge(
  inside: Uint32Array,
  outside: Uint32Array,
  rows: number,
  columns: number,
  margin: number,
): Float64Array {
  const place = new Float64Array(inside.length + outside.length);
  for (let i = 0; i < inside.length; i++) {
    const cell = inside[i]!;
    place[i] = cell + margin * (columns + 2 * margin) + (2 * Math.floor(cell / columns) + 1) * margin;
  }
  for (let i = 0; i < outside.length; i++)
    place[inside.length + i] = placeOutside(outside[i]!, rows, columns, margin);
  return place.sort();
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
  const limit = 2 ** 17 + 16 * rows * columns;
  let margin = 0;
  while (margin < MAX_MARGIN && (rows + 2 * margin + 2) * (columns + 2 * margin + 2) <= limit) margin++;
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

/** The cells that the program has found, in no order. */
const listed = ({ memory, cells }: Program, count: number): Uint32Array =>
  new Uint32Array(memory.buffer, cells.value, count).slice();
