/** The ids of a file of a label map (docs/format.md, "A file of a label map"). */

import { AdaptiveSymbol } from "../models/adaptive_symbol.ts";
import type { RangeDecoder } from "../range_decoder.ts";
import { countingUp, type Ids, readGaps, readOrder, readRegions } from "./ids.ts";

const MASK = [0n, 255n];
const LENGTHS = [8, ...Array<number>(16).fill(1), ...Array<number>(47).fill(1 / 8)];

export function readIdsOfFile(decoder: RangeDecoder, mostRegions: number): Ids {
  const counting = countingUp(readRegions(decoder, mostRegions));
  const ids = decoder.fair() ? readOthers(decoder, counting.ids.length) : counting.ids;
  return { ids, positions: decoder.fair() ? readOrder(decoder, ids.length) : counting.positions };
}

function readOthers(decoder: RangeDecoder, count: number): BigInt64Array {
  if (count === MASK.length && decoder.fair()) return BigInt64Array.from(MASK);
  const length = new AdaptiveSymbol(LENGTHS);
  return readGaps(count, () => decoder.ofLength(length.readOne(decoder)));
}
