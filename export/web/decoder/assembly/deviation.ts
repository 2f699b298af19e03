// The chance that a pixel deviates from the predicted map: its small network, and which counters it has (docs/format.md,
// "Chances of a deviation"). All sums of the tables' first layer are below 2**15.

import { allot } from "./memory";
import { labels, predicted, stride } from "./moving";
import { CLIP } from "./network";

const EARLIER: usize = 35; // places
const AROUND: usize = 60;
const HIDDEN: usize = 32;
const LATENT: usize = 16;
const MOST: i32 = 4095; // of a unit
// where the counters of each decision begin, and their number
export const SECOND: usize = 1 << 8;
export const THIRD: usize = SECOND + (1 << 15);
export const DEVIATES: usize = THIRD + (1 << 16);
export const OTHER_THIRD: usize = 10;
export const OTHER: usize = OTHER_THIRD + 729;

let earlier: usize = 0; // i32 [EARLIER] bytes from the pixel
let around: usize = 0; // i32 [AROUND]
let layer1: usize = 0; // [2 EARLIER + AROUND, HIDDEN] i8
let bias1: usize = 0; // [HIDDEN] i16
let layer2: usize = 0; // [HIDDEN / 2, LATENT, 2] i16
let bias2: usize = 0; // [LATENT] i32
let layer3: usize = 0; // [LATENT] i8
let bias3: usize = 0; // i32
let hidden: usize = 0; // [HIDDEN] i16
let latent: usize = 0; // [LATENT] i32

/** `places`: dx and dy of each, i8, those of earlier pixels first. */
export function openDeviation(tables: usize, places: usize): void {
  earlier = allot(4 * EARLIER);
  around = allot(4 * AROUND);
  for (let t: usize = 0; t < EARLIER + AROUND; t++) {
    const bytes = 4 * (load<i8>(places + 2 * t) + load<i8>(places + 2 * t + 1) * stride);
    store<i32>(t < EARLIER ? earlier + 4 * t : around + 4 * (t - EARLIER), bytes);
  }
  layer1 = tables;
  bias1 = layer1 + (2 * EARLIER + AROUND) * HIDDEN;
  const weights2 = bias1 + 2 * HIDDEN;
  bias2 = weights2 + HIDDEN * LATENT;
  layer3 = bias2 + 4 * LATENT;
  bias3 = layer3 + LATENT;
  hidden = allot(2 * HIDDEN);
  latent = allot(4 * LATENT);
  layer2 = allot(2 * HIDDEN * LATENT);
  for (let j: usize = 0; j < HIDDEN; j++)
    for (let k: usize = 0; k < LATENT; k++)
      store<i16>(layer2 + (((j >> 1) * LATENT + k) * 2 + (j & 1)) * 2, load<i8>(weights2 + j * LATENT + k));
}

/** The second candidate of a pixel whose predicted label is `first`; -1 for none. */
export function secondOf(pixel: usize, first: i32): i32 {
  for (let t: usize = 0; t < EARLIER; t++) {
    const label = load<i32>(labels + pixel + load<i32>(earlier + 4 * t));
    if (label !== first) return label;
  }
  for (let t: usize = 0; t < AROUND; t++) {
    const label = load<i32>(predicted + pixel + load<i32>(around + 4 * t));
    if (label !== first) return label;
  }
  return -1;
}

// @ts-ignore: decorator
@inline
function add(row: usize): void {
  const weights = layer1 + row * HIDDEN;
  for (let j: usize = 0; j < HIDDEN; j += 8) {
    const sums = hidden + 2 * j;
    v128.store(sums, i16x8.add(v128.load(sums), v128.load_ext<i8>(weights + j)));
  }
}

/** The logit that a pixel deviates. */
export function evaluate(pixel: usize, first: i32): i32 {
  memory.copy(hidden, bias1, 2 * HIDDEN);
  for (let t: usize = 0; t < EARLIER; t++) {
    const place = pixel + load<i32>(earlier + 4 * t);
    const label = load<i32>(labels + place);
    if (label !== first) add(t);
    if (label !== load<i32>(predicted + place)) add(EARLIER + AROUND + t);
  }
  for (let t: usize = 0; t < AROUND; t++)
    if (load<i32>(predicted + pixel + load<i32>(around + 4 * t)) !== first) add(EARLIER + t);
  const zero = i16x8.splat(0);
  const most = i16x8.splat(<i16>MOST);
  for (let j: usize = 0; j < 2 * HIDDEN; j += 16)
    v128.store(hidden + j, i16x8.min_s(i16x8.max_s(v128.load(hidden + j), zero), most));
  for (let k: usize = 0; k < LATENT; k += 4) {
    let sums = v128.load(bias2 + 4 * k);
    let weights = layer2 + 4 * k;
    for (let j: usize = 0; j < 2 * HIDDEN; j += 4) {
      sums = i32x4.add(sums, i32x4.dot_i16x8_s(v128.load_splat<i32>(hidden + j), v128.load(weights)));
      weights += 4 * LATENT;
    }
    v128.store(latent + 4 * k, sums);
  }
  let total = load<i32>(bias3);
  for (let k: usize = 0; k < LATENT; k++)
    total += min(max(load<i32>(latent + 4 * k) >> 6, 0), MOST) * load<i8>(layer3 + k);
  return min(max(total >> 4, -CLIP), CLIP);
}

/** What `look` finds at the nearest places, a bit for each: labels that deviate, that are not the first candidate. */
export let deviates: usize = 0;
export let unlike: usize = 0;
/** Predicted labels about that are not the first candidate. */
export let otherwise: usize = 0;

export function look(pixel: usize, first: i32): void {
  deviates = unlike = otherwise = 0;
  for (let t: usize = 0; t < 7; t++) {
    const place = pixel + load<i32>(earlier + 4 * t);
    const label = load<i32>(labels + place);
    deviates |= <usize>(label !== load<i32>(predicted + place)) << t;
    unlike |= <usize>(label !== first) << t;
  }
  for (let t: usize = 0; t < 10; t++)
    otherwise |= <usize>(load<i32>(predicted + pixel + load<i32>(around + 4 * t)) !== first) << t;
}

/** Six digits for the labels at four earlier places and two about: the first candidate, the second, or another one. */
export function digits(pixel: usize, first: i32, second: i32): usize {
  let found: usize = 0;
  for (let t: usize = 0; t < 6; t++) {
    const map = t < 4 ? labels + load<i32>(earlier + 4 * t) : predicted + load<i32>(around + 4 * (t - 4));
    const label = load<i32>(pixel + map);
    found = 3 * found + (label === first ? 0 : label === second ? 1 : 2);
  }
  return found;
}
