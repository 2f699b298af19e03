/** The number of regions and their ids (docs/format.md, "Regions and ids"). */

import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import { Remaining } from "./remaining.ts";

const MOST_BITS = 24; // of the number of regions

/** Ids that rise, and the position among them of each region, in the order in which the wavefront meets regions. */
export interface Ids {
  readonly ids: BigInt64Array;
  readonly positions: Int32Array;
}

export const countingUp = (count: number): Ids => ({
  ids: new BigInt64Array(count).map((_, i) => BigInt(i)),
  positions: new Int32Array(count).map((_, i) => i),
});

export function readIds(decoder: RangeDecoder, mostRegions: number): Ids {
  const count = readRegions(decoder, mostRegions);
  if (!decoder.fair()) return countingUp(count);
  const ids = readGaps(count, () => decoder.unbounded());
  return { ids, positions: readOrder(decoder, count) };
}

export function readRegions(decoder: RangeDecoder, most: number): number {
  let bits = 0;
  while (decoder.fair())
    if (++bits === MOST_BITS) throw new DecodeError(`data must hold at most ${most} regions; got ${2 ** bits} or more`);
  const count = Number(decoder.ofLength(bits + 1));
  if (count > most) throw new DecodeError(`data must hold at most ${most} regions; got ${count}`);
  return count;
}

/** Ids that rise, by the distance of each from the one before, less 1. */
export function readGaps(count: number, gap: () => bigint): BigInt64Array {
  const ids = new BigInt64Array(count);
  let last = -1n;
  for (let i = 0; i < count; i++) {
    last += 1n + gap();
    if (last >= 1n << 63n) throw new DecodeError(`data must hold ids below 2**63; got ${last}`);
    ids[i] = last;
  }
  return ids;
}

export function readOrder(decoder: RangeDecoder, count: number): Int32Array {
  const remaining = new Remaining(count);
  return new Int32Array(count).map((_, i) => {
    const left = count - i;
    const rank = decoder.number(left);
    if (rank >= left) throw new DecodeError(`data must name one of ${left} ids that are left; got number ${rank}`);
    return remaining.take(rank);
  });
}
