/** The region map of a scene (docs/format.md, "The region map"). */

import { ByteReader } from "./bytes.ts";
import { type Header, MOST_LABELS } from "./header.ts";
import { labelModel } from "./labels/prior.ts";
import { readLabels } from "./labels/stream.ts";
import { AdaptiveSymbol } from "./models/adaptive_symbol.ts";
import { touchingPairs } from "./pairs.ts";
import { RangeDecoder } from "./range_decoder.ts";
import { type ContourWidth, DecodeError, type RegionMap } from "./scene.ts";

const MOST_SUPERSAMPLE = 64;
const FORTIETHS = 40; // of a pixel
const MOST_WIDTH = 64 * FORTIETHS;
const TOGETHER = 32; // pairs that are coded before their model learns

export interface ReadMap {
  readonly map: RegionMap;
  readonly ids: BigInt64Array;
}

export function readRegionMap(bytes: Uint8Array, header: Header): ReadMap {
  const reader = new ByteReader(bytes);
  const k = reader.varint("labels along a side of a pixel", 1, MOST_SUPERSAMPLE);
  const height = k * header.height;
  const width = k * header.width;
  if (height * width > MOST_LABELS)
    throw new DecodeError(`a map must have at most ${MOST_LABELS} labels; got ${height} x ${width}`);
  const stream = reader.take(reader.varint("length of the labels", 1, bytes.length));
  const { ids, labels, met } = readLabels(stream, height, width, labelModel, header.regions);
  if (met !== header.regions) throw new DecodeError(`the map must have ${header.regions} regions; got ${met}`);
  const count = reader.varint("contour widths", 1, Math.min(MOST_WIDTH + 1, bytes.length));
  const widths = Array.from({ length: count }, () => reader.varint("a contour width", 0, MOST_WIDTH) / FORTIETHS);
  if (count === 1 && reader.left)
    throw new DecodeError(`the map must end after ${reader.position} bytes; got ${bytes.length}`);
  const pairs =
    count > 1 ? readPairs(reader.take(reader.left), touchingPairs(labels, width, ids.length), ids.length, widths) : [];
  // widths that are listed need not be used: then all contours may have one after all
  const first = pairs[0]?.width ?? widths[0]!;
  const one = pairs.every(({ width }) => width === first);
  const map = { supersample: k, labels, ids: Float64Array.from(ids, Number), softness: one ? first : null };
  return { map: { ...map, pairs: one ? [] : pairs }, ids };
}

/** Read the width of each pair. */
function readPairs(stream: Uint8Array, pairs: Float64Array, regions: number, widths: number[]): ContourWidth[] {
  const decoder = new RangeDecoder(stream);
  const model = new AdaptiveSymbol(widths.map(() => 1));
  const found: ContourWidth[] = [];
  while (found.length < pairs.length)
    for (const place of model.read(decoder, Math.min(TOGETHER, pairs.length - found.length))) {
      const pair = pairs[found.length]!;
      found.push({ a: Math.floor(pair / regions), b: pair % regions, width: widths[place]! });
    }
  return found;
}

/** The region of each pixel: the most frequent of its labels, the least on a tie. */
export function pixelRegions({ supersample: k, labels }: RegionMap, height: number, width: number): Int32Array {
  if (k === 1) return labels;
  const around = new Int32Array(k * k);
  return new Int32Array(height * width).map((_, pixel) => {
    const corner = Math.floor(pixel / width) * k * k * width + (pixel % width) * k;
    for (let i = 0; i < k * k; i++) around[i] = labels[corner + Math.floor(i / k) * k * width + (i % k)]!;
    return mostFrequent(around);
  });
}

function mostFrequent(numbers: Int32Array): number {
  numbers.sort();
  let best = numbers[0]!;
  let most = 0;
  for (let start = 0, i = 1; i <= numbers.length; i++)
    if (numbers[i] !== numbers[start]) {
      if (i - start > most) {
        most = i - start;
        best = numbers[start]!;
      }
      start = i;
    }
  return best;
}
