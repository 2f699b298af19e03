// The first estimate of a pixel's label: a small network of integers (docs/format.md, "Probabilities of a pixel").
// All sums of the tables' first layer are below 2**15.

import { allot } from "./memory";

export const CLIP: i32 = 3071; // largest logit, in 1/256
const PLACES: usize = 80; // of the template
const GROUPS: usize = 21; // of up to four neighbours: most are of one label, which says nothing
const KINDS: usize = 81; // of the features of a group
const MOST: i32 = 4095; // of a unit
const A: usize = 48; // units
const B: usize = 16;

/** The features of the pixel, by place in the template. */
export let features: usize = 0;
/** The logits of the two decisions. */
export let secondLogit: i32 = 0;
export let neitherLogit: i32 = 0;
/** The weights that decisions begin with. */
export let mixer: usize = 0;

let hidden: usize = 0; // [A] i16
let latent: usize = 0; // [B] i32
let members: usize = 0; // [GROUPS, 4] u8: places in the template
let groups: usize = 0; // [GROUPS, KINDS, A] i16: what all features of a group add
let bias1: usize = 0; // [A] i16
let layer2: usize = 0; // [A / 2, B, 2] i16
let bias2: usize = 0; // [B] i32
let layer3: usize = 0; // [B, 2] i8
let bias3: usize = 0; // [2] i32

/** Prepare the network: its tables, and the places of each group, 255 for none. */
export function openNetwork(tables: usize, groupPlaces: usize): void {
  features = allot(256); // at 255 it stays 0
  members = groupPlaces;
  hidden = allot(2 * A);
  latent = allot(4 * B);
  bias1 = tables + PLACES * 2 * A;
  const weights2 = bias1 + 2 * A;
  bias2 = weights2 + A * B;
  layer3 = bias2 + 4 * B;
  bias3 = layer3 + 2 * B;
  mixer = bias3 + 8;
  layer2 = allot(2 * A * B);
  for (let j: usize = 0; j < A; j++)
    for (let k: usize = 0; k < B; k++)
      store<i16>(layer2 + (((j >> 1) * B + k) * 2 + (j & 1)) * 2, load<i8>(weights2 + j * B + k));
  sumGroups(tables);
}

/** What each kind of each group adds to the first layer. */
function sumGroups(layer1: usize): void {
  groups = allot(GROUPS * KINDS * 2 * A);
  for (let group: usize = 0; group < GROUPS; group++)
    for (let kind: usize = 1; kind < KINDS; kind++) {
      // the first feature that is not 0, and the kind without it
      let weight = KINDS / 3;
      let i: usize = 0;
      for (; kind < weight; i++) weight /= 3;
      const place = <usize>load<u8>(members + 4 * group + i);
      if (place === 255) continue;
      const feature = kind / weight;
      const sum = groups + (group * KINDS + kind) * 2 * A;
      const others = sum - feature * weight * 2 * A;
      const added = layer1 + (2 * place + feature - 1) * A;
      for (let j: usize = 0; j < A; j += 8)
        v128.store(sum + 2 * j, i16x8.add(v128.load(others + 2 * j), v128.load_ext<i8>(added + j)));
    }
}

/** Find the logits of the features. */
export function evaluate(): void {
  sumFeatures();
  const zero = i16x8.splat(0);
  const limit = i16x8.splat(<i16>MOST);
  for (let j: usize = 0; j < 2 * A; j += 16)
    v128.store(hidden + j, i16x8.min_s(i16x8.max_s(v128.load(hidden + j), zero), limit));
  for (let k: usize = 0; k < B; k += 4) {
    let sums = v128.load(bias2 + 4 * k);
    let weights = layer2 + 4 * k;
    for (let j: usize = 0; j < 2 * A; j += 4) {
      sums = i32x4.add(sums, i32x4.dot_i16x8_s(v128.load_splat<i32>(hidden + j), v128.load(weights)));
      weights += 4 * B;
    }
    v128.store(latent + 4 * k, sums);
  }
  let first = load<i32>(bias3);
  let second = load<i32>(bias3 + 4);
  for (let k: usize = 0; k < B; k++) {
    const value = min(max(load<i32>(latent + 4 * k) >> 6, 0), MOST);
    first += value * load<i8>(layer3 + 2 * k);
    second += value * load<i8>(layer3 + 2 * k + 1);
  }
  secondLogit = min(max(first >> 4, -CLIP), CLIP);
  neitherLogit = min(max(second >> 4, -CLIP), CLIP);
}

/** The sums of the first layer. */
function sumFeatures(): void {
  memory.copy(hidden, bias1, 2 * A);
  for (let group: usize = 0; group < GROUPS; group++) {
    let kind: usize = 0;
    for (let i: usize = 0; i < 4; i++) kind = kind * 3 + load<u8>(features + load<u8>(members + 4 * group + i));
    if (kind === 0) continue;
    const row = groups + (group * KINDS + kind) * 2 * A;
    for (let j: usize = 0; j < 2 * A; j += 16)
      v128.store(hidden + j, i16x8.add(v128.load(hidden + j), v128.load(row + j)));
  }
}
