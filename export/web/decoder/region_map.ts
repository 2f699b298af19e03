/** The region map of a scene (docs/format.md, "The region map"). */

import { ByteReader } from "./bytes.ts";
import type { Header } from "./header.ts";
import { readIds } from "./labels/ids.ts";
import { readPixels } from "./labels/pixels.ts";
import { AdaptiveSymbol } from "./models/adaptive_symbol.ts";
import { touchingPairs } from "./pairs.ts";
import { RangeDecoder } from "./range_decoder.ts";
import { type ContourWidth, DecodeError, type RegionMap } from "./scene.ts";

const FORTIETHS = 40; // of a pixel
const MAX_WIDTH = 64 * FORTIETHS;
const TOGETHER = 32; // pairs that are coded before their model learns

export function readRegionMap(bytes: Uint8Array, { height, width, regions }: Header): RegionMap {
  const reader = new ByteReader(bytes);
  const decoder = new RangeDecoder(reader.take(reader.varint("length of the labels", 1, bytes.length)));
  if (regions > height * width) throw new DecodeError(`${height} x ${width} pixels must have fewer regions; got ${regions}`);
  const { ids, positions } = readIds(decoder, regions);
  const { labels, met } = readPixels(decoder, height, width, positions);
  if (met !== regions) throw new DecodeError(`the map must have ${regions} regions; got ${met}`);
  const count = reader.varint("contour widths", 1, Math.min(MAX_WIDTH + 1, bytes.length));
  const widths = Array.from({ length: count }, () => reader.varint("a contour width", 0, MAX_WIDTH) / FORTIETHS);
  if (count === 1 && reader.remaining)
    throw new DecodeError(`the map must end after ${reader.position} bytes; got ${bytes.length}`);
  const pairs =
    count > 1 ? readPairs(reader.take(reader.remaining), touchingPairs(labels, width, regions), regions, widths) : [];
  // widths that are listed need not be used: then all contours may have one after all
  const first = pairs[0]?.width ?? widths[0]!;
  const one = pairs.every(({ width }) => width === first);
  return { labels, ids: Float64Array.from(ids, Number), softness: one ? first : null, pairs: one ? [] : pairs };
}

/** Read the width of each pair. */
function readPairs(stream: Uint8Array, pairs: Float64Array, regions: number, widths: number[]): ContourWidth[] {
  const decoder = new RangeDecoder(stream);
  const model = new AdaptiveSymbol(widths.map(() => 1));
  const contours: ContourWidth[] = [];
  while (contours.length < pairs.length)
    for (const place of model.read(decoder, Math.min(TOGETHER, pairs.length - contours.length))) {
      const pair = pairs[contours.length]!;
      contours.push({ a: Math.floor(pair / regions), b: pair % regions, width: widths[place]! });
    }
  return contours;
}
