// A bit whose chance is learned, even at first: how many ones there were, and bits in all.

import { allot } from "./memory";
import { bit } from "./range_decoder";

const BYTES: usize = 8;

/** So many of them. */
export function adaptiveBits(count: usize): usize {
  const at = allot(count * BYTES);
  for (let i: usize = 0; i < count; i++) {
    store<u32>(at + i * BYTES, 2);
    store<u32>(at + i * BYTES + 4, 4);
  }
  return at;
}

export function readAdaptive(bits: usize, index: usize): i32 {
  const at = bits + index * BYTES;
  const ones = load<u32>(at);
  const all = load<u32>(at + 4);
  const chance = <i32>((<u64>65536 * ones) / all);
  const found = bit(min(max(chance, 64), 65472));
  store<u32>(at, ones + 2 * found);
  store<u32>(at + 4, all + 2);
  return found;
}
