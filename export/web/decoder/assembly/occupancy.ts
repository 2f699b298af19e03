// The number of Gaussians in each cell (docs/format.md, "Occupancy"); most cells are empty, and there are many.

import { allot, fail, MANY_GAUSSIANS } from "./memory";
import { categorical } from "./range_decoder";

const FULL: u32 = 7; // a cell with this many has another symbol
const VALUES: u32 = 8;

let capacity: u32 = 0;
let occupied: usize = 0; // u32: cells that hold any
let counts: usize = 0; // u32: how many
/** The cell of each Gaussian, u32. */
export let cells: usize = 0;

/** Read which of `count` cells each Gaussian lies in, at most so many, by a table; return how many there are. */
export function readCells(table: u32, count: u32, most: u32): u32 {
  if (most > capacity) {
    capacity = max(most, 2 * capacity);
    occupied = allot(4 * capacity);
    counts = allot(4 * capacity);
    cells = allot(4 * capacity);
  }
  let left = most;
  let listed: usize = 0;
  for (let cell: u32 = 0; cell < count; cell++) {
    const held = categorical(table, VALUES);
    if (held === 0) continue;
    if (held > left) fail(MANY_GAUSSIANS);
    left -= held;
    store<u32>(occupied + 4 * listed, cell);
    store<u32>(counts + 4 * listed, held);
    listed++;
  }
  left = readFull(table, listed, left);
  let found = cells;
  for (let i: usize = 0; i < listed; i++)
    for (let held = load<u32>(counts + 4 * i); held > 0; held--) {
      store<u32>(found, load<u32>(occupied + 4 * i));
      found += 4;
    }
  return most - left;
}

/** Add to full cells until none is; return how many Gaussians are left. */
function readFull(table: u32, listed: usize, most: u32): u32 {
  let left = most;
  for (let total = FULL, full = true; full; total += FULL) {
    full = false;
    for (let i: usize = 0; i < listed; i++) {
      const held = counts + 4 * i;
      if (load<u32>(held) !== total) continue;
      const more = categorical(table, VALUES);
      if (more > left) fail(MANY_GAUSSIANS);
      left -= more;
      store<u32>(held, total + more);
      full = full || more === FULL;
    }
  }
  return left;
}
