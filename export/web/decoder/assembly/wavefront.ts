// A label map from wavefront to wavefront: pixels of equal x + 8 y (docs/format.md, "The wavefront").

import { Decision } from "./decision";
import { openExplicitLabels, readExplicitLabel } from "./explicit_labels";
import {
  continueRow, isQuiet, label, LEFT, openMargins, pixelAddress, reach, repeat, rowAddress, stride, strip, TOP,
} from "./margins";
import { allot, fail, MANY_CODED } from "./memory";
import { evaluate, features, neitherLogit, secondLogit } from "./network";
import { bit } from "./range_decoder";

const SLANT: i32 = 8;
const PLACES: usize = 80; // of the template
const MAX_CODED: i32 = 1 << 23; // pixels that bits decide; more take minutes
// where the counters of each decision begin, and their number
const SECOND: usize = 1 << 6;
const THIRD: usize = SECOND + (1 << 11);
const SECOND_COUNTERS: usize = THIRD + (1 << 16);
const NEITHER_THIRD: usize = 1 + 81;
const NEITHER_COUNTERS: usize = NEITHER_THIRD + 6561;

/**
 * Return where the numbers of the regions are, row by row; `seeds`: a byte for each pixel, 1 for a seed; `template`: dx
 * and dy of each place, i8.
 */
export function readWavefronts(height: i32, width: i32, seeds: usize, regions: i32, template: usize): usize {
  openMargins(height, width);
  openExplicitLabels(regions);
  const reader = WavefrontReader.of(height, width, seeds, regions, template);
  const last = width - 1 + SLANT * (height - 1);
  // the first pixel is of region 0, since regions are numbered as they are met
  for (let front = 1; front <= last; front++) reader.read(front);
  return strip(height, width);
}

/** A pixel of a wavefront that does not continue its row. */
@unmanaged
class Pixel {
  x: i32;
  y: i32;
  first: i32;
  second: i32; // -1 for a seed
  bits: i32; // 1: the second candidate, 2: neither
}

/** The labels of a map while they are read, and what tells where a row needs no look. */
@unmanaged
class WavefrontReader {
  height: i32;
  width: i32;
  seeds: usize; // a byte for each pixel, row by row
  several: bool; // more than two regions
  offsets: usize; // of the template, in bytes
  isSecond: Decision;
  isNeither: Decision;
  changes: usize; // of each row its last pixel that differs from the one before
  nextSeed: usize; // of each row its column
  wake: usize; // of each row the wavefront until which all of it is quiet
  pixels: usize; // those of a wavefront that do not continue their rows
  count: usize; // of these pixels
  coded: i32; // pixels that bits decided so far

  static of(height: i32, width: i32, seeds: usize, regions: i32, template: usize): WavefrontReader {
    const reader = changetype<WavefrontReader>(allot(offsetof<WavefrontReader>()));
    reader.height = height;
    reader.width = width;
    reader.seeds = seeds;
    reader.several = regions > 2;
    const longest = min(height, (width + SLANT - 1) / SLANT); // pixels of a wavefront
    reader.isSecond = Decision.of(SECOND_COUNTERS, longest);
    reader.isNeither = Decision.of(NEITHER_COUNTERS, longest);
    reader.pixels = allot(offsetof<Pixel>() * longest);
    reader.changes = allot(4 * (TOP + height + 2));
    reader.nextSeed = allot(4 * (TOP + height + 2));
    reader.wake = allot(4 * (TOP + height + 2));
    reader.offsets = allot(4 * PLACES);
    for (let t: usize = 0; t < PLACES; t++) {
      const place = template + 2 * t;
      store<i32>(reader.offsets + 4 * t, 4 * (load<i8>(place) + load<i8>(place + 1) * stride));
    }
    return reader;
  }

  /** Read a wavefront: the labels of the pixels with this x + 8 y. */
  read(front: i32): void {
    this.list(front);
    if (this.count === 0) return;
    this.readBits();
    this.settle();
  }

  /** List the pixels of a wavefront that are seeds or not quiet; the others have their label, since rows continue. */
  private list(front: i32): void {
    this.count = 0;
    const end = min(this.height - 1, front / SLANT);
    for (let j = max(0, (front - this.width + SLANT) / SLANT); j <= end; j++) {
      const x = front - SLANT * j + LEFT;
      const y = j + TOP;
      reach(y, x);
      if (load<i32>(rowAddress(this.wake, y)) > front) continue;
      const seed = this.findSeed(j, x);
      const before = label(y, x - 1);
      if (!this.isStillQuiet(y, x)) this.ask(y, x, before);
      else if (x === seed) this.add(y, x, before, -1);
      else {
        repeat(y, x, before);
        if (y >= TOP + 2 && load<i32>(rowAddress(this.changes, y - 2)) < x)
          store<i32>(rowAddress(this.wake, y), front + seed - x);
      }
    }
  }

  /** The column of the next seed of a row, or the row's end. */
  private findSeed(row: i32, x: i32): i32 {
    const next = rowAddress(this.nextSeed, row + TOP);
    let seed = max(load<i32>(next), x);
    const marks = this.seeds + <usize>row * this.width - LEFT;
    while (seed < this.width + LEFT && load<u8>(marks + seed) === 0) seed++;
    store<i32>(next, seed);
    return seed;
  }

  /** The same as `isQuiet`, by the last changes of rows. */
  private isStillQuiet(y: i32, x: i32): bool {
    if (y < TOP + 2) return isQuiet(y, x);
    const change = rowAddress(this.changes, y);
    if (load<i32>(change) > x - 2 || load<i32>(change - 4) > x - 2) return false;
    const before = label(y, x - 1);
    if (label(y - 1, x) !== before || label(y - 2, x) !== before) return false;
    return load<i32>(change - 8) < x || isQuiet(y, x);
  }

  private add(y: i32, x: i32, first: i32, second: i32): void {
    const next = this.pixel(this.count++);
    next.x = x;
    next.y = y;
    next.first = first;
    next.second = second;
    next.bits = 0;
  }

  /** List a pixel that bits decide, with their chances. */
  private ask(y: i32, x: i32, first: i32): void {
    const here = pixelAddress(y, x);
    let second = -1;
    for (let t: usize = 0; t < PLACES; t++) {
      const near = load<i32>(here + load<i32>(this.offsets + 4 * t));
      let feature: u8 = 0;
      if (near !== first) {
        if (second < 0) second = near;
        feature = near === second ? 1 : 2;
      }
      store<u8>(features + t, feature);
    }
    const n = this.count;
    this.add(y, x, first, second);
    evaluate();
    let near: usize = 0;
    for (let t: usize = 1; t <= 16; t++) near = (near << 1) | (load<u8>(features + t) ? 1 : 0);
    this.isSecond.prepare(n, secondLogit, near >> 10, SECOND + (near >> 5), THIRD + near);
    if (!this.several) return;
    let digits: usize = 0;
    for (let t: usize = 1; t <= 8; t++) digits = digits * 3 + load<u8>(features + t);
    this.isNeither.prepare(n, neitherLogit, 0, 1 + digits / 81, NEITHER_THIRD + digits);
  }

  private readBits(): void {
    for (let n: usize = 0; n < this.count; n++) {
      if (this.pixel(n).second < 0) continue;
      if (++this.coded > MAX_CODED) fail(MANY_CODED);
      if (this.several) this.pixel(n).bits = 2 * bit(this.isNeither.chance(n));
    }
    for (let n: usize = 0; n < this.count; n++) {
      const one = this.pixel(n);
      if (one.second >= 0) one.bits |= bit(this.isSecond.chance(n));
    }
  }

  /** Give the pixels their labels, and learn from them. */
  private settle(): void {
    for (let n: usize = 0; n < this.count; n++) {
      const one = this.pixel(n);
      // from here on the first candidate is the label
      const seed = one.second < 0;
      if (seed && !this.several) one.first = 1 - one.first;
      else if (seed || one.bits >= 2) one.first = readExplicitLabel(one.y, one.x, one.first, one.second);
      else if (one.bits) one.first = one.second;
    }
    for (let n: usize = 0; n < this.count; n++) {
      const one = this.pixel(n);
      if (one.second >= 0) {
        if (this.several) this.isNeither.learn(n, one.bits >> 1);
        if (one.bits < 2) this.isSecond.learn(n, one.bits);
      }
      this.write(one.y, one.x, one.first);
    }
  }

  private write(y: i32, x: i32, region: i32): void {
    if (region !== label(y, x - 1)) {
      store<i32>(rowAddress(this.changes, y), x);
      memory.fill(rowAddress(this.wake, y), 0, 12); // these rows see it
      continueRow(y, x, region);
    }
    repeat(y, x, region);
  }

  // @ts-ignore: decorator
  @inline
  private pixel(n: usize): Pixel {
    return changetype<Pixel>(this.pixels + n * offsetof<Pixel>());
  }
}
