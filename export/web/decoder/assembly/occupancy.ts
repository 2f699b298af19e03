// The number of Gaussians in each cell (docs/format.md, "Occupancy"); most cells are empty, and there are many.

import { allot, fail, MANY_GAUSSIANS } from "./memory";
import { bit } from "./range_decoder";

const BANDS: u32 = 8;
const TOGETHER: u32 = 1 << 16; // cells of a band, about
const REACH: i32 = 4; // cells
const PARTS: f64 = 64; // of a weight
const MASS: f64 = 625; // of a Gaussian, over all cells

let most: u32 = 0;
let found: u32 = 0;
/** The cell of each Gaussian, u32, in no order. */
export let cells: usize = 0;
let chances: usize = 0; // i32: that its cell holds another one

let earlier: usize = 0; // i32 [2]: row, column
let rowsNear: usize = 0; // u32 [rows of a band, REACH + columns + REACH]

// what each of the lists has: i32 [4, 2] bytes, where
const rooms = allot(32);
const CELLS = 0;
const CHANCES = 1;
const EARLIER = 2;
const ROWS = 3;

/** Room of at least so many bytes for a list. */
function room(list: usize, bytes: usize): usize {
  const at = rooms + 8 * list;
  if (bytes > load<u32>(at)) {
    store<u32>(at, 2 * bytes);
    store<u32>(at, allot(2 * bytes), 4);
  }
  return load<u32>(at, 4);
}

function begin(count: u32): void {
  most = count;
  found = 0;
  cells = room(CELLS, 4 * count);
  chances = room(CHANCES, 4 * count);
}

function add(cell: u32, chance: i32): void {
  if (found === most) fail(MANY_GAUSSIANS);
  store<u32>(cells + 4 * found, cell);
  store<i32>(chances + 4 * found, chance);
  found++;
}

/** Room for the row and the column of so many Gaussians, for `readNear`. */
export function openEarlier(count: u32): usize {
  earlier = room(EARLIER, 8 * count);
  return earlier;
}

/**
 * Read which cell each of so many Gaussians lies in: of the weight `least`, and more where earlier ones are near. Return
 * how many there are.
 */
export function readNear(rows: u32, columns: u32, least: u32, near: u32, count: u32): u32 {
  begin(count);
  const all = rows * columns;
  let total = <f64>least * all + PARTS * MASS * near;
  const bands = max(BANDS, (all + TOGETHER - 1) / TOGETHER);
  let at: usize = 0;
  for (let band: u32 = 0; band < bands && found < count; band++) {
    const first = <u32>((<u64>rows * band) / bands);
    const last = <u32>((<u64>rows * (band + 1)) / bands);
    // all bands at once, where they are small
    if (near && (bands > BANDS || band === 0)) {
      spread(rows, columns, near, first, bands > BANDS ? last : rows);
      at = rowsNear;
    }
    const left = <f64>(count - found);
    let before = found;
    let sum: f64 = 0;
    let cell = first * columns;
    for (let row = first; row < last; row++, at += 8 * REACH)
      for (const end = cell + columns; cell < end; cell++, at += 4) {
        const weight = near ? least + PARTS * window(at) : <f64>least;
        sum += weight;
        const rate = left * weight;
        const chance = <i32>min(max(floor((65536 * rate) / (rate + total)), 16), 65520);
        if (bit(chance)) add(cell, chance);
      }
    // cells that hold one may hold another
    for (; before < found; before++) {
      const chance = load<i32>(chances + 4 * before);
      if (bit(chance)) add(load<u32>(cells + 4 * before), chance);
    }
    total -= sum;
  }
  return found;
}

/** Spread Gaussians over those rows from `first` to `last` that are near theirs, and mirror these rows at their ends. */
function spread(rows: i32, columns: i32, near: u32, first: i32, last: i32): void {
  const stride = columns + 2 * REACH;
  const bytes: usize = 4 * (last - first) * stride;
  rowsNear = room(ROWS, bytes);
  memory.fill(rowsNear, 0, bytes);
  for (let i: u32 = 0; i < near; i++) {
    const row = load<i32>(earlier + 8 * i);
    if (row < first - REACH || row >= last + REACH) continue;
    const column = load<i32>(earlier + 8 * i + 4);
    for (let off = -REACH; off <= REACH; off++) {
      let at = row + off;
      if (<u32>at >= <u32>rows) at = mirror(at, rows);
      if (at < first || at >= last) continue;
      const sum = rowsNear + 4 * <usize>((at - first) * stride + REACH + column);
      store<u32>(sum, load<u32>(sum) + REACH + 1 - abs(off));
    }
  }
  for (let row = rowsNear + 4 * REACH; row < rowsNear + bytes; row += 4 * stride)
    for (let off = -REACH; off < REACH; off++) {
      const column = off < 0 ? off : columns + off;
      store<u32>(row + 4 * column, load<u32>(row + 4 * mirror(column, columns)));
    }
}

function mirror(place: i32, count: i32): i32 {
  let at = place;
  while (at < 0 || at >= count) at = at < 0 ? -1 - at : 2 * count - 1 - at;
  return at;
}

/** Sum up what is spread over nine columns. */
// @ts-ignore: decorator
@inline
function window(at: usize): f64 {
  return (
    load<u32>(at) +
    load<u32>(at, 32) +
    2 * (load<u32>(at, 4) + load<u32>(at, 28)) +
    3 * (load<u32>(at, 8) + load<u32>(at, 24)) +
    4 * (load<u32>(at, 12) + load<u32>(at, 20)) +
    5 * load<u32>(at, 16)
  );
}
