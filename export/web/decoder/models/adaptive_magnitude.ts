import type { RangeDecoder } from "../range_decoder.ts";

const BINS = 24;
const PARTS = 256;
// sizes below 16 have a bucket each, each octave above has eight
const BOUNDS: number[] = Array.from({ length: 16 }, (_, size) => size);
for (let octave = 4; octave < 24; octave++)
  for (let eighth = 8; eighth < 16; eighth++) BOUNDS.push(eighth * 2 ** (octave - 3));
BOUNDS.push(2 ** 24);
const BUCKETS = BOUNDS.length - 1;

/** Sizes 0, 1, 2 ... each in units of a scale: a shape over size / scale, learned for all scales. */
export class AdaptiveMagnitude {
  private readonly shapes: Float64Array[];

  /** `shapes`: the bins at first, of each context. */
  constructor(shapes: readonly (readonly number[])[]) {
    this.shapes = shapes.map((bins) => Float64Array.from(bins));
  }

  /** Read a group of sizes, one for each context; `levels` say by which of the scales, at most 8. */
  read(decoder: RangeDecoder, scales: readonly number[], levels: Uint8Array, contexts: Uint8Array): Int32Array {
    const sizes = new Int32Array(contexts.length);
    const prepared: boolean[] = [];
    for (let i = 0; i < sizes.length; i++) {
      const context = contexts[i]!;
      const table = levels[i]! * this.shapes.length + context;
      if (!prepared[table]) decoder.prepare(table, weights(this.shapes[context]!, scales[levels[i]!]!));
      prepared[table] = true;
      sizes[i] = decoder.categorical(table);
    }
    for (let i = 0; i < sizes.length; i++) {
      const bucket = sizes[i]!;
      sizes[i] = BOUNDS[bucket]! + decoder.uniform(BOUNDS[bucket + 1]! - BOUNDS[bucket]!);
    }
    this.learn(scales, levels, contexts, sizes);
    return sizes;
  }

  private learn(scales: readonly number[], levels: Uint8Array, contexts: Uint8Array, sizes: Int32Array): void {
    const edgesOf = scales.map(borders);
    edgesOf.forEach((edges) => (edges[BINS] = Infinity));
    const learned = this.shapes.map(() => new Float64Array(BINS));
    for (let n = 0; n < sizes.length; n++) {
      const size = sizes[n]!;
      const edges = edgesOf[levels[n]!]!;
      const low = Math.max(size - 0.5, 0);
      const high = size + 0.5;
      const bins = learned[contexts[n]!]!;
      for (let i = 0; i < BINS && edges[i]! < high; i++) {
        const covered = Math.min(high, edges[i + 1]!) - Math.max(low, edges[i]!);
        if (covered > 0) bins[i]! += Math.floor((covered / (high - low)) * PARTS + 0.5);
      }
    }
    this.shapes.forEach((shape, context) => {
      for (let i = 0; i < BINS; i++) shape[i]! += learned[context]![i]! / PARTS;
    });
  }
}

const borders = (scale: number): Float64Array => new Float64Array(BINS + 1).map((_, i) => i * (scale * 0.125));

/** The weights of the buckets. */
function weights(shape: Float64Array, scale: number): Float64Array {
  const edges = borders(scale);
  const sums = new Float64Array(BINS + 1);
  for (let i = 0; i < BINS; i++) sums[i + 1] = sums[i]! + shape[i]!;
  const total = sums[BINS]!;
  let bin = 0;
  // F of the format; its arguments rise
  const rise = (x: number): number => {
    while (bin < BINS - 1 && edges[bin + 1]! <= x) bin++;
    const share = Math.min((x - edges[bin]!) / (edges[bin + 1]! - edges[bin]!), 1);
    return sums[bin]! + share * (sums[bin + 1]! - sums[bin]!);
  };
  let before = rise(0);
  const chances = new Float64Array(BUCKETS);
  for (let bucket = 0; bucket < BUCKETS; bucket++) {
    const after = rise(BOUNDS[bucket + 1]! - 0.5);
    chances[bucket] = after - before + (0.001 * total) / BUCKETS;
    before = after;
  }
  return chances;
}
