import type { RangeDecoder } from "../range_decoder.ts";

/** A bit whose chance is learned, even at first. */
export class AdaptiveBit {
  private ones = 2;
  private all = 4;

  read(decoder: RangeDecoder): number {
    const chance = Math.floor((65536 * this.ones) / this.all);
    const bit = decoder.bit(Math.min(Math.max(chance, 64), 65472));
    this.ones += 2 * bit;
    this.all += 2;
    return bit;
  }
}
