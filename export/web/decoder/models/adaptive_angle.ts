import type { RangeDecoder } from "../range_decoder.ts";

const BINS = 16; // of half a turn

/** Angles, each one of so many in half a turn, in bins with the weights that they have at first. */
export class AdaptiveAngle {
  private readonly weights: Float64Array;

  constructor(weights: readonly number[]) {
    this.weights = Float64Array.from(weights);
  }

  /** Read a group of angles, one of each of `turns`; of fewer than the bins nothing is learned. */
  read(decoder: RangeDecoder, turns: Int32Array): Int32Array {
    const { program } = decoder;
    new Float64Array(program.memory.buffer, program.weights.value + 8 * BINS, BINS).set(this.weights);
    const bins = turns.map((all) => (all < BINS ? 0 : program.angleBin(all)));
    return bins.map((bin, n) => {
      const all = turns[n]!;
      if (all < BINS) return decoder.uniform(all);
      this.weights[bin]! += 1;
      const begin = Math.floor((bin * all) / BINS);
      const place = decoder.uniform(Math.floor(((bin + 1) * all) / BINS) - begin);
      return (begin + place + all - Math.floor(all / (2 * BINS))) % all;
    });
  }
}
