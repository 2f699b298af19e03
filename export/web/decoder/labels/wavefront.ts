/** A label map from wavefront to wavefront: pixels of equal x + 8 y (docs/format.md, "The wavefront"). */

import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import { Decision } from "./decision.ts";
import { Escapes } from "./escapes.ts";
import { LEFT, Margins, TOP } from "./margins.ts";
import type { Network } from "./network.ts";
import { TEMPLATE } from "./template.ts";

const SLANT = 8;
const MOST_ASKED = 2 ** 23; // pixels that bits decide; more take minutes
// where the counters of each decision begin, and their number
const WHICH = { first: 0, second: 2 ** 6, third: 2 ** 6 + 2 ** 11, all: 2 ** 6 + 2 ** 11 + 2 ** 16 };
const NEITHER = { first: 0, second: 1, third: 1 + 3 ** 4, all: 1 + 3 ** 4 + 3 ** 8 };

/** Reads the numbers of the regions of a map, two or more, whose seeds are known. */
export class Wavefront {
  private readonly margins: Margins;
  private readonly escapes: Escapes;
  private readonly which: Decision;
  private readonly neither: Decision;
  private readonly offsets: Int32Array; // of the template
  private readonly several: boolean; // more than two regions
  // of each row of the map: its last pixel that differs from the one before, the next seed, the wavefront until which
  // all of it is quiet
  private readonly changes: Int32Array;
  private readonly nextSeed: Int32Array;
  private readonly wake: Int32Array;
  // of each pixel of a wavefront that does not continue its row
  private readonly column: Int32Array;
  private readonly row: Int32Array;
  private readonly first: Int32Array;
  private readonly second: Int32Array; // -1 for a seed
  private readonly bits: Uint8Array; // 1: the second candidate, 2: neither
  private listed = 0;
  private asked = 0;

  constructor(
    private readonly decoder: RangeDecoder,
    private readonly height: number,
    private readonly width: number,
    private readonly seeds: Uint8Array,
    private readonly network: Network,
    regions: number,
  ) {
    const most = Math.min(height, Math.ceil(width / SLANT));
    this.margins = new Margins(height, width);
    this.escapes = new Escapes(decoder, this.margins, regions);
    this.which = new Decision(WHICH.all, network.mixer, most);
    this.several = regions > 2;
    this.neither = new Decision(NEITHER.all, network.mixer, most);
    this.offsets = Int32Array.from(TEMPLATE, ([dx, dy]) => dy * this.margins.stride + dx);
    const rows = () => new Int32Array(TOP + height + 2);
    [this.changes, this.nextSeed, this.wake] = [rows(), rows(), rows()];
    const pixels = () => new Int32Array(most);
    [this.column, this.row, this.first, this.second] = [pixels(), pixels(), pixels(), pixels()];
    this.bits = new Uint8Array(most);
  }

  /** Return the numbers, row by row. */
  read(): Int32Array {
    const last = this.width - 1 + SLANT * (this.height - 1);
    for (let front = 0; front <= last; front++) {
      this.look(front);
      if (this.listed === 0) continue;
      this.readBits();
      this.settle();
    }
    return this.margins.strip();
  }

  /** List the pixels of a wavefront that are seeds or not quiet; the others have their label, since rows continue. */
  private look(front: number): void {
    const { margins, wake, changes } = this;
    this.listed = 0;
    const end = Math.min(this.height - 1, Math.floor(front / SLANT));
    for (let j = Math.max(0, Math.ceil((front - this.width + 1) / SLANT)); j <= end; j++) {
      const x = front - SLANT * j + LEFT;
      const y = j + TOP;
      margins.reach(y, x);
      if (wake[y]! > front) continue;
      const seed = this.findSeed(j, x);
      const label = margins.labels[y * margins.stride + x - 1]!;
      if (!this.quiet(y, x)) this.ask(y, x, label);
      else if (x === seed) this.list(y, x, label, -1);
      else {
        margins.repeat(y, x, label);
        if (y >= TOP + 2 && changes[y - 2]! < x) wake[y] = front + seed - x;
      }
    }
  }

  /** The column of the next seed of a row, or the row's end. */
  private findSeed(row: number, x: number): number {
    const y = row + TOP;
    let seed = Math.max(this.nextSeed[y]!, x);
    const end = this.width + LEFT;
    const start = row * this.width - LEFT;
    while (seed < end && this.seeds[start + seed] === 0) seed++;
    this.nextSeed[y] = seed;
    return seed;
  }

  /** The same as `Margins.quiet`, by the last changes of rows. */
  private quiet(y: number, x: number): boolean {
    const { margins, changes } = this;
    if (y < TOP + 2) return margins.quiet(y, x);
    if (changes[y]! > x - 2 || changes[y - 1]! > x - 2) return false;
    const { labels, stride } = margins;
    const at = y * stride + x;
    const label = labels[at - 1]!;
    if (labels[at - stride] !== label || labels[at - 2 * stride] !== label) return false;
    return changes[y - 2]! < x || margins.quiet(y, x);
  }

  private list(y: number, x: number, first: number, second: number): void {
    const n = this.listed++;
    this.column[n] = x;
    this.row[n] = y;
    this.first[n] = first;
    this.second[n] = second;
  }

  /** List a pixel that bits decide, with their chances. */
  private ask(y: number, x: number, first: number): void {
    const { network, offsets, listed } = this;
    const { features } = network;
    const { labels, stride } = this.margins;
    const at = y * stride + x;
    let second = -1;
    for (let t = 0; t < features.length; t++) {
      const label = labels[at + offsets[t]!]!;
      if (label === first) features[t] = 0;
      else if (second < 0 || label === second) {
        second = label;
        features[t] = 1;
      } else features[t] = 2;
    }
    this.list(y, x, first, second);
    network.evaluate();
    let near = 0;
    for (let t = 1; t <= 16; t++) near = near * 2 + (features[t] ? 1 : 0);
    this.which.prepare(
      listed,
      network.logits[0]!,
      WHICH.first + (near >> 10),
      WHICH.second + (near >> 5),
      WHICH.third + near,
    );
    if (!this.several) return;
    let four = 0;
    for (let t = 1; t <= 4; t++) four = four * 3 + features[t]!;
    let eight = four;
    for (let t = 5; t <= 8; t++) eight = eight * 3 + features[t]!;
    this.neither.prepare(listed, network.logits[1]!, NEITHER.first, NEITHER.second + four, NEITHER.third + eight);
  }

  private readBits(): void {
    const { bits, second, listed, decoder } = this;
    for (let n = 0; n < listed; n++) {
      bits[n] = 0;
      if (second[n]! < 0) continue;
      if (++this.asked > MOST_ASKED)
        throw new DecodeError(`data must ask for at most ${MOST_ASKED} pixels near contours; got more`);
      if (this.several) bits[n] = 2 * decoder.bit(this.neither.chance(n));
    }
    for (let n = 0; n < listed; n++) if (second[n]! >= 0) bits[n]! += decoder.bit(this.which.chance(n));
  }

  /** Give the pixels their labels, and learn from them. */
  private settle(): void {
    const { bits, column, row, first, second, listed } = this;
    const found = first; // candidates are in use until labels are read
    for (let n = 0; n < listed; n++) {
      const seed = second[n]! < 0;
      if (seed && !this.several) found[n] = 1 - first[n]!;
      else if (seed || bits[n]! >= 2) found[n] = this.escapes.read(row[n]!, column[n]!, first[n]!, second[n]!);
      else if (bits[n]!) found[n] = second[n]!;
    }
    for (let n = 0; n < listed; n++) {
      if (second[n]! >= 0) {
        const neither = bits[n]! >> 1;
        if (this.several) this.neither.learn(n, neither);
        if (!neither) this.which.learn(n, bits[n]!);
      }
      this.write(row[n]!, column[n]!, found[n]!);
    }
  }

  private write(y: number, x: number, label: number): void {
    const { margins, changes, wake } = this;
    if (label !== margins.labels[y * margins.stride + x - 1]) {
      changes[y] = x;
      wake.fill(0, y, y + 3); // these rows see it
      margins.continue(y, x, label);
    }
    margins.repeat(y, x, label);
  }
}
