/** What a pixel may be before the map is known: a small network of integers (docs/format.md, "Chances of a pixel"). */

import { GROUPS, TEMPLATE } from "./template.ts";

export const CLIP = 3071; // largest logit, in 1/256
const MOST = 4095; // of a unit
const KINDS = 3 ** 4; // of the features of a group

/** The tables of a label model, and room for one pixel. */
export class Network {
  /** The features of the pixel, by place in the template. */
  readonly features = new Uint8Array(TEMPLATE.length);
  /** The logits of the two decisions. */
  readonly logits = new Int32Array(2);
  readonly mixer: Int32Array;
  // sums of two units share a word of 32 bits: the lower one in its low half
  private readonly groups: Int32Array; // [groups, KINDS, A / 2]: what all features of a group add
  private readonly members: Uint8Array; // [groups, 4] places in the template, the last one repeated
  private readonly bias1: Int32Array; // [A / 2]
  private readonly layer2: Int32Array; // [A, B]
  private readonly bias2: Int32Array;
  private readonly layer3: Int32Array; // [B, 2]
  private readonly bias3: Int32Array;
  private readonly hidden: Int32Array;
  private readonly latent: Int32Array;

  /** `units`: of the first and of the second layer. */
  constructor(tables: Uint8Array, units: readonly [number, number]) {
    const [hidden, latent] = units;
    const view = new DataView(tables.buffer, tables.byteOffset, tables.byteLength);
    let at = 0;
    const take = (bytes: 1 | 2 | 4, count: number): Int32Array =>
      new Int32Array(count).map(() => {
        at += bytes;
        if (bytes === 1) return view.getInt8(at - 1);
        return bytes === 2 ? view.getInt16(at - 2, true) : view.getInt32(at - 4, true);
      });
    this.groups = groupSums(pairs(take(1, TEMPLATE.length * 2 * hidden)), hidden / 2);
    this.members = Uint8Array.from(GROUPS.flatMap((group) => [0, 1, 2, 3].map((i) => group[i] ?? group[0]!)));
    this.bias1 = pairs(take(2, hidden));
    this.layer2 = take(1, hidden * latent);
    this.bias2 = take(4, latent);
    this.layer3 = take(1, latent * 2);
    this.bias3 = take(4, 2);
    this.mixer = take(4, 4);
    this.hidden = new Int32Array(hidden / 2);
    this.latent = new Int32Array(latent);
  }

  /** Find the logits of the features. */
  evaluate(): void {
    this.sumFeatures();
    const { hidden, latent, layer3, logits } = this;
    latent.set(this.bias2);
    for (let j = 0; j < hidden.length; j++) {
      const both = hidden[j]!;
      const low = (both << 16) >> 16;
      if (low > 0) this.add(2 * j, low);
      if (both - low > 0) this.add(2 * j + 1, (both - low) >> 16);
    }
    let which = this.bias3[0]!;
    let neither = this.bias3[1]!;
    for (let k = 0; k < latent.length; k++) {
      const value = Math.min(Math.max(latent[k]! >> 6, 0), MOST);
      which += Math.imul(value, layer3[2 * k]!);
      neither += Math.imul(value, layer3[2 * k + 1]!);
    }
    logits[0] = Math.min(Math.max(which >> 4, -CLIP), CLIP);
    logits[1] = Math.min(Math.max(neither >> 4, -CLIP), CLIP);
  }

  /** The units of the first layer. */
  private sumFeatures(): void {
    const { features, groups, members, hidden } = this;
    const half = hidden.length;
    hidden.set(this.bias1);
    for (let group = 0; group < members.length; group += 4) {
      const [a, b] = [features[members[group]!]!, features[members[group + 1]!]!];
      const [c, d] = [features[members[group + 2]!]!, features[members[group + 3]!]!];
      const kind = ((a * 3 + b) * 3 + c) * 3 + d;
      if (kind === 0) continue;
      const row = ((group >> 2) * KINDS + kind) * half;
      for (let j = 0; j < half; j++) hidden[j] = (hidden[j]! + groups[row + j]!) | 0;
    }
  }

  /** Add what a unit of the first layer means to the second. */
  private add(unit: number, sum: number): void {
    const value = Math.min(sum, MOST);
    const { latent, layer2 } = this;
    const row = unit * latent.length;
    for (let k = 0; k < latent.length; k++) latent[k] = (latent[k]! + Math.imul(value, layer2[row + k]!)) | 0;
  }
}

/** Put each two numbers into one, the first in the low half. Sums of such are those of both, up to 15 bits. */
const pairs = (numbers: Int32Array): Int32Array =>
  new Int32Array(numbers.length / 2).map((_, i) => numbers[2 * i]! + 65536 * numbers[2 * i + 1]!);

/** What each kind of each group adds to the first layer, from what each feature adds, [T, 2, half]. */
function groupSums(layer1: Int32Array, half: number): Int32Array {
  const sums = new Int32Array(GROUPS.length * KINDS * half);
  GROUPS.forEach((group, g) => {
    for (let kind = 1; kind < KINDS; kind++) {
      // the first feature that is not 0, and the kind without it
      let weight = KINDS / 3;
      let i = 0;
      for (; kind < weight; i++) weight /= 3;
      const feature = Math.floor(kind / weight);
      const place = group[i];
      if (place === undefined) continue;
      const row = (g * KINDS + kind) * half;
      const rest = (g * KINDS + kind - feature * weight) * half;
      const added = (2 * place + feature - 1) * half;
      for (let j = 0; j < half; j++) sums[row + j] = sums[rest + j]! + layer1[added + j]!;
    }
  });
  return sums;
}
