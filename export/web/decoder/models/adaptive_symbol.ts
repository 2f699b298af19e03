import type { RangeDecoder } from "../range_decoder.ts";


/** One of a few symbols, with the weights that they have at first. */
export class AdaptiveSymbol {
  private readonly weights: Float64Array;

  constructor(weights: readonly number[]) {
    this.weights = Float64Array.from(weights);
  }

  /** Read a group of symbols, which are learned from together. */
  read(decoder: RangeDecoder, count: number): Int32Array {
    decoder.prepare(0, this.weights);
    const symbols = new Int32Array(count);
    for (let i = 0; i < count; i++) symbols[i] = decoder.categorical(0);
    for (let i = 0; i < count; i++) this.weights[symbols[i]!]! += 1;
    return symbols;
  }

  /** Read a symbol that is coded alone. */
  readOne(decoder: RangeDecoder): number {
    return this.read(decoder, 1)[0]!;
  }
}
