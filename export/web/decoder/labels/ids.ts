/** The number of regions and their ids (docs/format.md, "Regions and ids"). */

import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import { Remaining } from "./remaining.ts";

const MAX_BITS = 24; // of the number of regions

/** Ids that rise, and the position among them of each region, in the order in which the wavefront meets regions. */
export interface Ids {
  readonly ids: BigInt64Array;
  readonly positions: Int32Array;
}

/** Read the ids of a map of so many regions. */
export function readIds(decoder: RangeDecoder, regions: number): Ids {
  const count = readCount(decoder);
  if (count !== regions) throw new DecodeError(`the map must have ${regions} regions; got ${count}`);
  const counting = Int32Array.from({ length: count }, (_, i) => i);
  if (!decoder.fair()) return { ids: BigInt64Array.from(counting, BigInt), positions: counting };
  const ids = new BigInt64Array(count);
  let last = -1n;
  for (let i = 0; i < count; i++) {
    last += 1n + decoder.unbounded();
    if (last >= 1n << 63n) throw new DecodeError(`data must hold ids below 2**63; got ${last}`);
    ids[i] = last;
  }
  return { ids, positions: readOrder(decoder, count) };
}

function readCount(decoder: RangeDecoder): number {
  let bits = 1;
  while (decoder.fair())
    if (++bits > MAX_BITS) throw new DecodeError(`a map must have fewer than 2**${MAX_BITS} regions; got more`);
  return Number(decoder.ofLength(bits));
}

function readOrder(decoder: RangeDecoder, count: number): Int32Array {
  const remaining = new Remaining(count);
  return new Int32Array(count).map((_, i) => {
    const choices = count - i;
    const rank = decoder.number(choices);
    if (rank >= choices) throw new DecodeError(`data must name one of ${choices} ids that are left; got number ${rank}`);
    return remaining.take(rank);
  });
}
