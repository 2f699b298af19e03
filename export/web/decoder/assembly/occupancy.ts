// The number of Gaussians in each cell (docs/format.md, "Occupancy"); most cells are empty, and there are many.

import { allot, fail, MANY_GAUSSIANS } from "./memory";
import { bit } from "./range_decoder";

const BANDS: u32 = 8;
const TOGETHER: u32 = 1 << 16; // cells of a band, about
const REACH: i32 = 4; // cells
const PARTS: f64 = 64; // of a weight
const MASS: f64 = 625; // of a Gaussian, over all cells

let capacity: u32 = 0;
let size: u32 = 0;
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
  const address = rooms + 8 * list;
  if (bytes > load<u32>(address)) {
    store<u32>(address, 2 * bytes);
    store<u32>(address, allot(2 * bytes), 4);
  }
  return load<u32>(address, 4);
}

function begin(count: u32): void {
  capacity = count;
  size = 0;
  cells = room(CELLS, 4 * count);
  chances = room(CHANCES, 4 * count);
}

function add(cell: u32, chance: i32): void {
  if (size === capacity) fail(MANY_GAUSSIANS);
  store<u32>(cells + 4 * size, cell);
  store<i32>(chances + 4 * size, chance);
  size++;
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
export function readNear(rows: u32, columns: u32, base: u32, near: u32, count: u32): u32 {
  begin(count);
  const all = rows * columns;
  let total = <f64>base * all + PARTS * MASS * near;
  const bands = max(BANDS, (all + TOGETHER - 1) / TOGETHER);
  let address: usize = 0;
  for (let band: u32 = 0; band < bands && size < count; band++) {
    const first = <u32>((<u64>rows * band) / bands);
    const last = <u32>((<u64>rows * (band + 1)) / bands);
    // all bands at once, where they are small
    if (near && (bands > BANDS || band === 0)) {
      spread(rows, columns, near, first, bands > BANDS ? last : rows);
      address = rowsNear;
    }
    const remaining = <f64>(count - size);
    let before = size;
    let sum: f64 = 0;
    let cell = first * columns;
    for (let row = first; row < last; row++, address += 8 * REACH)
      for (const end = cell + columns; cell < end; cell++, address += 4) {
        const weight = near ? base + PARTS * window(address) : <f64>base;
        sum += weight;
        const rate = remaining * weight;
        const chance = <i32>min(max(floor((65536 * rate) / (rate + total)), 16), 65520);
        if (bit(chance)) add(cell, chance);
      }
    // cells that hold one may hold another
    for (; before < size; before++) {
      const chance = load<i32>(chances + 4 * before);
      if (bit(chance)) add(load<u32>(cells + 4 * before), chance);
    }
    total -= sum;
  }
  return size;
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
      let address = row + off;
      if (<u32>address >= <u32>rows) address = mirror(address, rows);
      if (address < first || address >= last) continue;
      const sum = rowsNear + 4 * <usize>((address - first) * stride + REACH + column);
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
  let address = place;
  while (address < 0 || address >= count) address = address < 0 ? -1 - address : 2 * count - 1 - address;
  return address;
}

/** Sum up what is spread over nine columns. */
// @ts-ignore: decorator
@inline
function window(address: usize): f64 {
  return (
    load<u32>(address) +
    load<u32>(address, 32) +
    2 * (load<u32>(address, 4) + load<u32>(address, 28)) +
    3 * (load<u32>(address, 8) + load<u32>(address, 24)) +
    4 * (load<u32>(address, 12) + load<u32>(address, 20)) +
    5 * load<u32>(address, 16)
  );
}
