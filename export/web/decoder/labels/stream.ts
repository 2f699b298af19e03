/** The stream of a label map whose size is known (docs/format.md, "Labels"). */

import { RangeDecoder } from "../range_decoder.ts";
import { type Ids, readIds } from "./ids.ts";
import { type LabelModel, type Pixels, readPixels } from "./pixels.ts";

export interface Labels extends Pixels {
  readonly ids: BigInt64Array; // rising
}

/** Read a map of at most so many regions; `read` takes their ids from the stream. */
export function readLabels(
  stream: Uint8Array,
  height: number,
  width: number,
  model: () => LabelModel,
  mostRegions: number,
  read: (decoder: RangeDecoder, mostRegions: number) => Ids = readIds,
): Labels {
  const decoder = new RangeDecoder(stream);
  const { ids, positions } = read(decoder, Math.min(mostRegions, height * width));
  if (ids.length === 1) return { ids, labels: new Int32Array(height * width), met: 1 };
  return { ids, ...readPixels(decoder, height, width, positions, model()) };
}
