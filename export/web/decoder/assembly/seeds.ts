// Which pixels are seeds, by how many lie in the halves of ever smaller blocks (docs/format.md, "Seeds").

import { adaptiveBits, readAdaptive } from "./adaptive_bit";
import { fail, MANY_SEEDS, SEED_OUTSIDE } from "./memory";
import { number, unbounded, uniform } from "./range_decoder";

let marks: usize = 0;
let stride: u32 = 0;
let extreme: usize = 0;

/** Set a byte to 1 for each seed, row by row, from `at` on. */
export function readSeeds(address: usize, height: u32, width: u32): void {
  const seeds = unbounded();
  if (seeds > <u64>height * width) fail(MANY_SEEDS);
  marks = address;
  stride = width;
  extreme = adaptiveBits(8);
  readBlock(0, 0, height, width, <u32>seeds);
}

function readBlock(y: u32, x: u32, height: u32, width: u32, seeds: u32): void {
  if (seeds === 0) return;
  const area = height * width;
  if (seeds === area) {
    for (let row: u32 = 0; row < height; row++) memory.fill(marks + (y + row) * stride + x, 1, width);
  } else if (seeds === 1) {
    const place = number(area);
    if (place >= area) fail(SEED_OUTSIDE);
    store<u8>(marks + (y + place / width) * stride + x + (place % width), 1);
  } else if (height >= width) {
    // across the longer side; the first half is the smaller, and comes last
    const half = height >> 1;
    const inside = readCount(seeds, half * width, area - half * width);
    readBlock(y + half, x, height - half, width, seeds - inside);
    readBlock(y, x, half, width, inside);
  } else {
    const half = width >> 1;
    const inside = readCount(seeds, half * height, area - half * height);
    readBlock(y, x + half, height, width - half, seeds - inside);
    readBlock(y, x, height, half, inside);
  }
}

/** How many of the seeds are in the first half, of that area, and not in the rest. */
function readCount(seeds: u32, first: u32, others: u32): u32 {
  const low = seeds > others ? seeds - others : 0;
  const high = min(seeds, first);
  if (low === high) return low;
  const level = min(<u32>30 - clz(seeds), 7);
  if (high - low < 2 || readAdaptive(extreme, level)) return uniform(2) ? high : low;
  const count = low + 1 + number(high - low - 1);
  if (count >= high) fail(SEED_OUTSIDE);
  return count;
}
