/** The pixels of a label map (docs/format.md, "The wavefront"). */

import tables from "../../../../kcgs/codec/labels/scene_prior.bin?packed";
import { unpack } from "../packed_text.ts";
import { put } from "../program.ts";
import type { RangeDecoder } from "../range_decoder.ts";
import { GROUPS, TEMPLATE } from "./template.ts";

const CLIP = 3071; // largest logit, in 1/256

/** The positions of two or more regions, row by row, and how many regions there are. */
export interface Pixels {
  readonly labels: Int32Array;
  readonly met: number;
}

let model: { tables: Uint8Array; squash: Int32Array; stretch: Int32Array } | undefined;

/** Read a map; `positions` are those of the regions in the order in which the wavefront meets them. */
export function readPixels({ program }: RangeDecoder, height: number, width: number, positions: Int32Array): Pixels {
  model ??= { tables: unpack(tables), ...logistic() };
  const groups = put(program, Uint8Array.from(GROUPS.flat()));
  program.model(put(program, model.tables), groups, put(program, model.squash), put(program, model.stretch));
  const template = put(program, Int8Array.from(TEMPLATE.flat()));
  const address = program.readLabels(height, width, positions.length, template, put(program, positions));
  return { labels: new Int32Array(program.memory.buffer, address, height * width).slice(), met: program.met.value };
}

/** squash(x) for x from -CLIP to CLIP, and stretch(q) for q from 0 to 4095. */
function logistic(): { squash: Int32Array; stretch: Int32Array } {
  const squash = new Int32Array(2 * CLIP + 1);
  for (let i = 0; i < squash.length; i++) squash[i] = Math.round(65536 / (1 + Math.exp((CLIP - i) / 256)));
  const stretch = new Int32Array(4096);
  for (let q = 0, x = 0; q < stretch.length; q++) {
    while (squash[x]! < 16 * q + 8) x++;
    stretch[q] = x - CLIP;
  }
  return { squash, stretch };
}
