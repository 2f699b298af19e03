// Explicit labels: of seeds, and of pixels that have neither candidate (docs/format.md, "Pixels").

import { adaptiveBits, readAdaptive } from "./adaptive_bit";
import { label, stride } from "./margins";
import { allot, fail, MANY_EXPLICIT, NO_REGION } from "./memory";
import { number } from "./range_decoder";

const MOST: i32 = 1 << 18; // more take minutes
const RANKS: i32 = 3;
const FAR: i32 = 32;

let regions: i32 = 0;
let met: i32 = 1;
let count: i32 = 0;
let isNew: usize = 0; // [2] of seeds, of others
let isNearest: usize = 0; // [2, RANKS]
let nearest: usize = 0; // [RANKS] i32

export function openExplicitLabels(all: i32): void {
  regions = all;
  isNew = adaptiveBits(2);
  isNearest = adaptiveBits(2 * RANKS);
  nearest = allot(4 * RANKS);
}

/** Read the label of pixel (x, y) with these candidates; a seed has one, and -1. */
export function readExplicitLabel(y: i32, x: i32, first: i32, second: i32): i32 {
  if (++count > MOST) fail(MANY_EXPLICIT);
  const kind = second < 0 ? 0 : 1;
  if (met < regions && readAdaptive(isNew, kind)) return met++;
  const total = listNearest(y, x, first, second);
  for (let rank = 0; rank < total; rank++)
    if (readAdaptive(isNearest, kind * RANKS + rank)) return load<i32>(nearest + 4 * rank);
  const region = <i32>number(met);
  if (region >= met) fail(NO_REGION);
  return region;
}

/** List up to three labels other than the candidates, by distance from a pixel; return how many. */
function listNearest(y: i32, x: i32, first: i32, second: i32): i32 {
  let listed = 0;
  for (let radius = 1; radius <= FAR; radius++)
    for (let dy = -min(radius, y); dy <= 0; dy++) {
      const step = dy === -radius ? 1 : 2 * radius;
      for (let dx = -radius; dx <= radius && dx < -8 * dy; dx += step) {
        if (x + dx < 0 || x + dx >= stride) continue;
        const near = label(y + dy, x + dx);
        if (near === first || near === second || isListed(near, listed)) continue;
        store<i32>(nearest + 4 * listed, near);
        if (++listed === RANKS) return listed;
      }
    }
  return listed;
}

function isListed(near: i32, listed: i32): bool {
  for (let i = 0; i < listed; i++) if (load<i32>(nearest + 4 * i) === near) return true;
  return false;
}
