// A bit whose chance is learned, even at first: how many ones there were, and bits in all.

import { allot } from "./memory";
import { bit } from "./range_decoder";

const BYTES: usize = 8;

/** So many of them. */
export function adaptiveBits(count: usize): usize {
  const address = allot(count * BYTES);
  for (let i: usize = 0; i < count; i++) {
    store<u32>(address + i * BYTES, 2);
    store<u32>(address + i * BYTES + 4, 4);
  }
  return address;
}

export function readAdaptive(bits: usize, index: usize): i32 {
  const address = bits + index * BYTES;
  const ones = load<u32>(address);
  const all = load<u32>(address + 4);
  const chance = <i32>((<u64>65536 * ones) / all);
  const value = bit(min(max(chance, 64), 65472));
  store<u32>(address, ones + 2 * value);
  store<u32>(address + 4, all + 2);
  return value;
}
