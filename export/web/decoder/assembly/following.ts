// A label map by where it deviates from the predicted one: pixels of equal x + 4 y (docs/format.md, "Label maps that
// follow").

import { adaptiveBits, readAdaptive } from "./adaptive_bit";
import { Decision, openTables } from "./decision";
import {
  deviates, DEVIATES, digits, evaluate, look, openDeviation, OTHER, OTHER_THIRD, otherwise, SECOND, secondOf, THIRD,
  unlike,
} from "./deviation";
import { allot, fail, LISTED, MANY_ASKED, MANY_ESCAPES } from "./memory";
import { at, height, labels, MARGIN, openMaps, predicted, stride, width } from "./moving";
import { bit, unbounded, uniform } from "./range_decoder";
import { readSeeds } from "./seeds";

const SLANT: i32 = 4;
const BAND: i32 = 4; // pixels within which a contour is near
const NOISE: i32 = 64; // chance
const RARE: i32 = -512; // logit of a label that is neither candidate
const MOST_ASKED: i32 = 1 << 23;
const MOST_LISTED: u64 = 1 << 18;

/** A pixel of a wavefront that may deviate. */
@unmanaged
class Pixel {
  x: i32;
  y: i32;
  first: i32;
  second: i32;
  asked: bool; // or else a seed
  deviates: i32;
  neither: i32;
}

let regions: i32 = 0;
let same: usize = 0;
let isOther = changetype<Decision>(0); // the pixel deviates
let isNeither = changetype<Decision>(0); // from both candidates
let seeds: usize = 0; // u8 [height, width]
let asked: usize = 0; // u8 [height, width]
let pixels: usize = 0;
let found: i32 = 0; // pixels of the wavefront
let count: i32 = 0; // pixels asked for, of the map
let listed: usize = 0; // i32
let room: i32 = 0;
let listLength: i32 = 0;
let used: i32 = 0;

/** Prepare for maps of a size; `mixer`: the weights that decisions begin with, `places` as `openDeviation` takes them. */
export function openFollowing(
  rows: i32, columns: i32, all: i32, tables: usize, places: usize, mixer: usize, squash: usize, stretch: usize,
): void {
  regions = all;
  openTables(squash, stretch);
  openMaps(rows, columns, all);
  openDeviation(tables, places);
  same = adaptiveBits(1);
  seeds = allot(<usize>height * width);
  asked = allot(<usize>height * width);
  const most = min(height, (width + SLANT - 1) / SLANT);
  pixels = allot(offsetof<Pixel>() * most);
  isOther = Decision.of(DEVIATES, most);
  isNeither = Decision.of(OTHER, most);
  for (let set: usize = 0; set < 64; set += 16) {
    memory.copy(isOther.weights + set, mixer, 16);
    memory.copy(isNeither.weights + set, mixer, 16);
  }
}

/** Read the map that follows; return whether it is the predicted one. */
export function follow(): bool {
  memory.copy(labels - at(MARGIN, MARGIN), predicted - at(MARGIN, MARGIN), at(height + 2 * MARGIN, 0));
  if (readAdaptive(same, 0)) return true;
  if (bit(NOISE)) {
    for (let y = 0; y < height; y++)
      for (let x = 0; x < width; x++) store<u32>(labels + at(y, x), uniform(regions));
    return false;
  }
  const size = <usize>height * width;
  memory.fill(seeds, 0, size);
  memory.fill(asked, 0, size);
  readSeeds(seeds, height, width);
  if (regions > 2) readList();
  markBand();
  used = count = 0;
  const last = width - 1 + SLANT * (height - 1);
  for (let front = 0; front <= last; front++) {
    gather(front);
    if (found === 0) continue;
    readBits();
    settle();
  }
  if (regions > 2 && used !== listLength) fail(LISTED);
  return false;
}

function readList(): void {
  const length = unbounded();
  if (length > MOST_LISTED) fail(MANY_ESCAPES);
  listLength = <i32>length;
  if (listLength > room) {
    room = listLength;
    listed = allot(4 * <usize>room);
  }
  for (let i: usize = 0; i < <usize>listLength; i++) store<u32>(listed + 4 * i, uniform(regions));
}

/** Ask for the pixels that have a contour of the predicted map near. */
function markBand(): void {
  for (let y = 0; y < height; y++) {
    const top = max(0, y - BAND);
    for (let x = 0; x < width; x++) {
      const label = load<i32>(predicted + at(y, x));
      if (x + 1 < width && label !== load<i32>(predicted + at(y, x + 1))) mark(top, max(0, x + 1 - BAND), y + BAND, x + BAND);
      if (y + 1 < height && label !== load<i32>(predicted + at(y + 1, x)))
        mark(max(0, y + 1 - BAND), max(0, x - BAND), y + BAND, x + BAND);
    }
  }
}

function mark(top: i32, left: i32, bottom: i32, right: i32): void {
  const bytes = <usize>(min(right, width - 1) - left + 1);
  for (let y = top; y <= min(bottom, height - 1); y++) memory.fill(asked + <usize>y * width + left, 1, bytes);
}

// @ts-ignore: decorator
@inline
function pixel(n: usize): Pixel {
  return changetype<Pixel>(pixels + n * offsetof<Pixel>());
}

/** List the pixels of a wavefront that are asked for, and the seeds. */
function gather(front: i32): void {
  found = 0;
  const end = min(height - 1, front / SLANT);
  for (let y = max(0, (front - width + SLANT) / SLANT); y <= end; y++) {
    const x = front - SLANT * y;
    const mark = <usize>y * width + x;
    const wanted = load<u8>(asked + mark) !== 0;
    if (!wanted && !load<u8>(seeds + mark)) continue;
    const next = pixel(found);
    next.x = x;
    next.y = y;
    next.first = load<i32>(predicted + at(y, x));
    next.second = -1;
    next.asked = wanted;
    next.deviates = 0;
    next.neither = 0;
    if (wanted) ask(found, next);
    found++;
  }
}

function ask(n: usize, one: Pixel): void {
  if (++count > MOST_ASKED) fail(MANY_ASKED);
  const place = at(one.y, one.x);
  one.second = secondOf(place, one.first);
  look(place, one.first);
  isOther.prepare(
    n,
    evaluate(place, one.first),
    ((deviates & 15) << 4) | (otherwise & 15),
    SECOND + ((deviates << 8) | (otherwise & 255)),
    THIRD + (((unlike & 63) << 10) | otherwise),
  );
}

function readBits(): void {
  let more = false;
  for (let n: usize = 0; n < <usize>found; n++) {
    const one = pixel(n);
    if (!one.asked) continue;
    one.deviates = bit(isOther.chance(n));
    more = more || one.deviates !== 0;
  }
  if (regions === 2 || !more) return;
  for (let n: usize = 0; n < <usize>found; n++) {
    const one = pixel(n);
    if (!one.deviates || one.second < 0) continue;
    const key = digits(at(one.y, one.x), one.first, one.second);
    isNeither.prepare(n, RARE, 0, 1 + key / 81, OTHER_THIRD + key);
    one.neither = bit(isNeither.chance(n));
  }
}

/** Give the pixels their labels, and learn from them. */
function settle(): void {
  for (let n: usize = 0; n < <usize>found; n++) {
    const one = pixel(n);
    if (one.asked) isOther.learn(n, one.deviates);
    if (one.deviates && one.second >= 0 && regions > 2) isNeither.learn(n, one.neither);
    const label = labelOf(one);
    if (label === one.first) continue;
    store<i32>(labels + at(one.y, one.x), label);
    markLater(one.y, one.x);
  }
}

function labelOf(one: Pixel): i32 {
  if (one.asked && !one.deviates) return one.first;
  if (regions === 2) return 1 - one.first;
  if (one.asked && one.second >= 0 && !one.neither) return one.second;
  // a list that ends early is noticed by how many labels were used
  const place = used++;
  return place < listLength ? load<i32>(listed + 4 * <usize>place) : one.first;
}

/** Ask for the later neighbours of a pixel that deviates. */
function markLater(y: i32, x: i32): void {
  later(y, x + 1);
  later(y, x + 2);
  for (let dx = -2; dx < 2; dx++) later(y + 1, x + dx);
  later(y + 2, x - 1);
  later(y + 2, x);
}

// @ts-ignore: decorator
@inline
function later(y: i32, x: i32): void {
  if (y < height && x >= 0 && x < width) store<u8>(asked + <usize>y * width + x, 1);
}
