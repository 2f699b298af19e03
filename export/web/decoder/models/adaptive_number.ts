import type { RangeDecoder } from "../range_decoder.ts";
import { AdaptiveSymbol } from "./adaptive_symbol.ts";

/** A number whose count of bits is learned, with the weights of 0 bits, 1, 2 and so on, at first. */
export class AdaptiveNumber {
  private readonly length: AdaptiveSymbol;

  constructor(weights: readonly number[]) {
    this.length = new AdaptiveSymbol(weights);
  }

  read(decoder: RangeDecoder): number {
    const bits = this.length.readOne(decoder);
    if (bits === 0) return 0;
    const highest = 2 ** (bits - 1);
    return highest + decoder.uniform(highest);
  }
}
