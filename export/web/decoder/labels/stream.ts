/** The stream of a label map whose size is known (docs/format.md, "Labels"). */

import { RangeDecoder } from "../range_decoder.ts";
import { type Ids, readIds } from "./ids.ts";
import type { Network } from "./network.ts";
import { readSeeds } from "./seeds.ts";
import { Wavefront } from "./wavefront.ts";

const NOISE = 64; // chance

export interface Labels {
  readonly ids: BigInt64Array; // rising
  readonly labels: Int32Array; // positions among the ids, row by row
}

/** Read a map of at most so many regions; `read` takes their ids from the stream. */
export function readLabels(
  stream: Uint8Array,
  height: number,
  width: number,
  network: () => Network,
  mostRegions: number,
  read: (decoder: RangeDecoder, mostRegions: number) => Ids = readIds,
): Labels {
  const decoder = new RangeDecoder(stream);
  const { ids, positions } = read(decoder, Math.min(mostRegions, height * width));
  if (ids.length === 1) return { ids, labels: new Int32Array(height * width) };
  const labels = readNumbers(decoder, height, width, network, ids.length);
  if (positions.some((position, number) => position !== number))
    for (let i = 0; i < labels.length; i++) labels[i] = positions[labels[i]!]!;
  return { ids, labels };
}

/** Read the numbers of regions, in the order in which the wavefront meets them. */
function readNumbers(
  decoder: RangeDecoder,
  height: number,
  width: number,
  network: () => Network,
  regions: number,
): Int32Array {
  if (decoder.bit(NOISE)) {
    const labels = new Int32Array(height * width);
    for (let i = 0; i < labels.length; i++) labels[i] = decoder.uniform(regions);
    return labels;
  }
  const seeds = readSeeds(decoder, height, width);
  return new Wavefront(decoder, height, width, seeds, network(), regions).read();
}
