// A label map from wavefront to wavefront: pixels of equal x + 8 y (docs/format.md, "The wavefront").

import { Decision } from "./decision";
import { openEscapes, readEscape } from "./escapes";
import { allAlike, pixelAddress, continueRow, label, LEFT, openMargins, reach, repeat, stride, strip, TOP } from "./margins";
import { allot, fail, MANY_ASKED } from "./memory";
import { evaluate, features, neither, which } from "./network";
import { bit } from "./range_decoder";

const SLANT: i32 = 8;
const PLACES: usize = 80; // of the template
const MAX_UNCERTAIN: i32 = 1 << 23; // pixels that bits decide; more take minutes
// where the counters of each decision begin, and their number
const SECOND: usize = 1 << 6;
const THIRD: usize = SECOND + (1 << 11);
const WHICH: usize = THIRD + (1 << 16);
const NEITHER_THIRD: usize = 1 + 81;
const NEITHER: usize = NEITHER_THIRD + 6561;

/** A pixel of a wavefront that does not continue its row. */
@unmanaged
class Pixel {
  x: i32;
  y: i32;
  first: i32;
  second: i32; // -1 for a seed
  bits: i32; // 1: the second candidate, 2: neither
}

let height: i32 = 0;
let width: i32 = 0;
let seeds: usize = 0;
let several: bool = false; // more than two regions
let offsets: usize = 0; // of the template, in bytes
let isSecond = changetype<Decision>(0);
let isNeither = changetype<Decision>(0);
let changes: usize = 0; // of each row its last pixel that differs from the one before
let nextSeed: usize = 0;
let wake: usize = 0; // the wavefront until which all of a row is quiet
let pixels: usize = 0;
let listed: usize = 0;
let asked: i32 = 0;

// @ts-ignore: decorator
@inline
function pixel(n: usize): Pixel {
  return changetype<Pixel>(pixels + n * offsetof<Pixel>());
}

/** Return where the numbers of the regions are, row by row; `template`: dx and dy of each place, i8. */
export function readWavefronts(rows: i32, columns: i32, marks: usize, regions: i32, template: usize): usize {
  height = rows;
  width = columns;
  seeds = marks;
  several = regions > 2;
  openMargins(height, width);
  openEscapes(regions);
  const count = min(height, (width + SLANT - 1) / SLANT);
  isSecond = Decision.of(WHICH, count);
  isNeither = Decision.of(NEITHER, count);
  pixels = allot(offsetof<Pixel>() * count);
  changes = allot(4 * (TOP + height + 2));
  nextSeed = allot(4 * (TOP + height + 2));
  wake = allot(4 * (TOP + height + 2));
  offsets = allot(4 * PLACES);
  for (let t: usize = 0; t < PLACES; t++)
    store<i32>(offsets + 4 * t, 4 * (load<i8>(template + 2 * t) + load<i8>(template + 2 * t + 1) * stride));
  const last = width - 1 + SLANT * (height - 1);
  // the first pixel is of region 0, since regions are numbered as they are met
  for (let front = 1; front <= last; front++) {
    look(front);
    if (listed === 0) continue;
    readBits();
    settle();
  }
  return strip(height, width);
}

/** List the pixels of a wavefront that are seeds or not quiet; the others have their label, since rows continue. */
function look(front: i32): void {
  listed = 0;
  const end = min(height - 1, front / SLANT);
  for (let j = max(0, (front - width + SLANT) / SLANT); j <= end; j++) {
    const x = front - SLANT * j + LEFT;
    const y = j + TOP;
    reach(y, x);
    if (load<i32>(wake + 4 * y) > front) continue;
    const seed = findSeed(j, x);
    const before = label(y, x - 1);
    if (!quiet(y, x)) ask(y, x, before);
    else if (x === seed) list(y, x, before, -1);
    else {
      repeat(y, x, before);
      if (y >= TOP + 2 && load<i32>(changes + 4 * (y - 2)) < x) store<i32>(wake + 4 * y, front + seed - x);
    }
  }
}

/** The column of the next seed of a row, or the row's end. */
function findSeed(row: i32, x: i32): i32 {
  const next = nextSeed + 4 * (row + TOP);
  let seed = max(load<i32>(next), x);
  const marks = seeds + <usize>row * width - LEFT;
  while (seed < width + LEFT && load<u8>(marks + seed) === 0) seed++;
  store<i32>(next, seed);
  return seed;
}

/** The same as `allAlike`, by the last changes of rows. */
function quiet(y: i32, x: i32): bool {
  if (y < TOP + 2) return allAlike(y, x);
  const change = changes + 4 * y;
  if (load<i32>(change) > x - 2 || load<i32>(change - 4) > x - 2) return false;
  const before = label(y, x - 1);
  if (label(y - 1, x) !== before || label(y - 2, x) !== before) return false;
  return load<i32>(change - 8) < x || allAlike(y, x);
}

function list(y: i32, x: i32, first: i32, second: i32): void {
  const next = pixel(listed++);
  next.x = x;
  next.y = y;
  next.first = first;
  next.second = second;
  next.bits = 0;
}

/** List a pixel that bits decide, with their chances. */
function ask(y: i32, x: i32, first: i32): void {
  const here = pixelAddress(y, x);
  let second = -1;
  for (let t: usize = 0; t < PLACES; t++) {
    const near = load<i32>(here + load<i32>(offsets + 4 * t));
    let feature: u8 = 0;
    if (near !== first) {
      if (second < 0) second = near;
      feature = near === second ? 1 : 2;
    }
    store<u8>(features + t, feature);
  }
  const n = listed;
  list(y, x, first, second);
  evaluate();
  let near: usize = 0;
  for (let t: usize = 1; t <= 16; t++) near = (near << 1) | (load<u8>(features + t) ? 1 : 0);
  isSecond.prepare(n, which, near >> 10, SECOND + (near >> 5), THIRD + near);
  if (!several) return;
  let digits: usize = 0;
  for (let t: usize = 1; t <= 8; t++) digits = digits * 3 + load<u8>(features + t);
  isNeither.prepare(n, neither, 0, 1 + digits / 81, NEITHER_THIRD + digits);
}

function readBits(): void {
  for (let n: usize = 0; n < listed; n++) {
    if (pixel(n).second < 0) continue;
    if (++asked > MAX_UNCERTAIN) fail(MANY_ASKED);
    if (several) pixel(n).bits = 2 * bit(isNeither.chance(n));
  }
  for (let n: usize = 0; n < listed; n++) if (pixel(n).second >= 0) pixel(n).bits |= bit(isSecond.chance(n));
}

/** Give the pixels their labels, and learn from them. */
function settle(): void {
  for (let n: usize = 0; n < listed; n++) {
    const one = pixel(n);
    // from here on the first candidate is the label
    const seed = one.second < 0;
    if (seed && !several) one.first = 1 - one.first;
    else if (seed || one.bits >= 2) one.first = readEscape(one.y, one.x, one.first, one.second);
    else if (one.bits) one.first = one.second;
  }
  for (let n: usize = 0; n < listed; n++) {
    const one = pixel(n);
    if (one.second >= 0) {
      if (several) isNeither.learn(n, one.bits >> 1);
      if (one.bits < 2) isSecond.learn(n, one.bits);
    }
    write(one.y, one.x, one.first);
  }
}

function write(y: i32, x: i32, region: i32): void {
  if (region !== label(y, x - 1)) {
    store<i32>(changes + 4 * y, x);
    memory.fill(wake + 4 * y, 0, 12); // these rows see it
    continueRow(y, x, region);
  }
  repeat(y, x, region);
}
