// The number of Gaussians in each cell (docs/format.md, "Occupancy"); most cells are empty, and there are many.

import { allot, fail, MANY_GAUSSIANS } from "./memory";
import { bit, categorical } from "./range_decoder";

const BANDS: u32 = 8;
const TOGETHER: u32 = 1 << 16; // cells of a band, about
const REACH: i32 = 4; // cells
const PARTS: f64 = 64; // of a weight
const MASS: f64 = 625; // of a Gaussian, over all cells
const FULL: u32 = 7; // of versions 1 and 2: a cell with this many has another symbol
const VALUES: u32 = 8;

let capacity: u32 = 0;
let occupied: usize = 0; // u32: cells that hold any
let counts: usize = 0; // u32: how many
let chances: usize = 0; // i32: of one more
let going: usize = 0; // u32: places in these lists that may hold more
/** The cell of each Gaussian, u32. */
export let cells: usize = 0;

let listed: u32 = 0; // occupied cells
let found: u32 = 0; // Gaussians in `cells`
let left: u32 = 0;
let total: f64 = 0; // weight of the cells that may hold them

let earlierRoom: u32 = 0;
let earlier: usize = 0; // i32 [2]: row, column
let rowsRoom: usize = 0;
let rowsNear: usize = 0; // u32 [rows of a band, REACH + columns + REACH]

function begin(most: u32): void {
  left = most;
  listed = found = 0;
  if (most <= capacity) return;
  capacity = max(most, 2 * capacity);
  occupied = allot(4 * capacity);
  counts = allot(4 * capacity);
  chances = allot(4 * capacity);
  going = allot(4 * capacity);
  cells = allot(4 * capacity);
}

/** Put Gaussians into a listed cell. */
function add(place: usize, more: u32): void {
  if (more > left) fail(MANY_GAUSSIANS);
  left -= more;
  store<u32>(counts + 4 * place, load<u32>(counts + 4 * place) + more);
}

/** List a cell that holds so many. */
function occupy(cell: u32, held: u32): void {
  if (held > left) fail(MANY_GAUSSIANS);
  store<u32>(occupied + 4 * listed, cell);
  store<u32>(counts + 4 * listed, 0);
  add(listed++, held);
}

/** Add the Gaussians of the listed cells to `cells`. */
function gather(): u32 {
  for (let i: usize = 0; i < listed; i++)
    for (let held = load<u32>(counts + 4 * i); held > 0; held--) {
      store<u32>(cells + 4 * found, load<u32>(occupied + 4 * i));
      found++;
    }
  listed = 0;
  return found;
}

/** Room for the row and the column of so many Gaussians, for `readNear`. */
export function openEarlier(count: u32): usize {
  if (count > earlierRoom) {
    earlierRoom = max(count, 2 * earlierRoom);
    earlier = allot(8 * earlierRoom);
  }
  return earlier;
}

/**
 * Read which cell each of so many Gaussians lies in: of the weight `least`, and more where earlier ones are near. Return
 * how many there are.
 */
export function readNear(rows: u32, columns: u32, least: u32, near: u32, most: u32): u32 {
  begin(most);
  const all = rows * columns;
  total = <f64>least * all + PARTS * MASS * near;
  const bands = max(BANDS, (all + TOGETHER - 1) / TOGETHER);
  for (let band: u32 = 0; band < bands && left; band++) {
    const first = <u32>((<u64>rows * band) / bands);
    const last = <u32>((<u64>rows * (band + 1)) / bands);
    if (near) spread(rows, columns, near, first, last);
    const gaussians = <f64>left;
    let sum: f64 = 0;
    let cell = first * columns;
    for (let row = first, at = rowsNear; row < last; row++, at += 8 * REACH)
      for (const end = cell + columns; cell < end; cell++, at += 4) {
        const weight = near ? least + PARTS * window(at) : <f64>least;
        sum += weight;
        const rate = gaussians * weight;
        const chance = <i32>min(max(floor((65536 * rate) / (rate + total)), 16), 65520);
        if (!bit(chance)) continue;
        store<i32>(chances + 4 * listed, chance);
        store<u32>(going + 4 * listed, listed);
        occupy(cell, 1);
      }
    readMore();
    total -= sum;
  }
  return found;
}

/** Read the further bits of a band, and list its Gaussians. */
function readMore(): void {
  for (let count = listed; count > 0; ) {
    let kept: u32 = 0;
    for (let i: u32 = 0; i < count; i++) {
      const place = load<u32>(going + 4 * i);
      if (!bit(load<i32>(chances + 4 * place))) continue;
      add(place, 1);
      store<u32>(going + 4 * kept++, place);
    }
    count = kept;
  }
  gather();
}

/** Spread Gaussians over the rows of a band that are near theirs, and mirror these rows at their ends. */
function spread(rows: i32, columns: i32, near: u32, first: i32, last: i32): void {
  const stride = columns + 2 * REACH;
  const bytes: usize = 4 * (last - first) * stride;
  if (bytes > rowsRoom) {
    rowsRoom = max(bytes, 2 * rowsRoom);
    rowsNear = allot(rowsRoom);
  }
  memory.fill(rowsNear, 0, bytes);
  for (let i: u32 = 0; i < near; i++) {
    const row = load<i32>(earlier + 8 * i);
    if (row < first - REACH || row >= last + REACH) continue;
    const column = load<i32>(earlier + 8 * i + 4);
    for (let off = -REACH; off <= REACH; off++) {
      const at = mirror(row + off, rows);
      if (at < first || at >= last) continue;
      const sum = rowsNear + 4 * <usize>((at - first) * stride + REACH + column);
      store<u32>(sum, load<u32>(sum) + REACH + 1 - abs(off));
    }
  }
  for (let row = rowsNear + 4 * REACH; row < rowsNear + bytes; row += 4 * stride)
    for (let off = 0; off < REACH; off++) {
      store<u32>(row - 4 * (off + 1), load<u32>(row + 4 * mirror(-1 - off, columns)));
      store<u32>(row + 4 * (columns + off), load<u32>(row + 4 * mirror(columns + off, columns)));
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

/** As versions 1 and 2 have it: read which of the cells each Gaussian lies in, by a table. */
export function readCells(table: u32, all: u32, most: u32): u32 {
  begin(most);
  for (let cell: u32 = 0; cell < all; cell++) {
    const held = categorical(table, VALUES);
    if (held) occupy(cell, held);
  }
  // add to full cells until none is
  for (let full = FULL, more = true; more; full += FULL) {
    more = false;
    for (let i: u32 = 0; i < listed; i++) {
      if (load<u32>(counts + 4 * i) !== full) continue;
      const held = categorical(table, VALUES);
      add(i, held);
      more = more || held === FULL;
    }
  }
  return gather();
}
