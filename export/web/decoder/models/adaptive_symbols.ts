import type { RangeDecoder } from "../range_decoder.ts";

/** Symbols of several contexts, each with a table of its own; what is long ago is forgotten. */
export class AdaptiveSymbols {
  private readonly tables: readonly Float64Array[];

  /** `tables`: the weights at first, of each context; a call may have 24 contexts. */
  constructor(
    tables: readonly (readonly number[])[],
    private readonly memory: number,
  ) {
    this.tables = tables.map((weights) => Float64Array.from(weights));
  }

  /** Read one symbol for each context; tables learn from all of them at once. */
  read(decoder: RangeDecoder, contexts: Uint8Array): Uint8Array {
    const slots = new Int8Array(this.tables.length).fill(-1);
    let prepared = 0;
    const found = contexts.map((context) => {
      if (slots[context]! < 0) {
        slots[context] = prepared++;
        decoder.prepare(slots[context]!, this.tables[context]!);
      }
      return decoder.categorical(slots[context]!);
    });
    if (found.length === 0) return found;
    found.forEach((symbol, n) => (this.tables[contexts[n]!]![symbol]! += 1));
    for (const weights of this.tables)
      if (weights.reduce((sum, weight) => sum + weight, 0) > this.memory)
        for (let symbol = 0; symbol < weights.length; symbol++) weights[symbol]! /= 2;
    return found;
  }
}
