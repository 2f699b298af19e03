/** Label maps from `.kcgs` files (docs/format.md, "A file of a label map"); with larger tables than scenes have. */

import { ByteReader } from "./bytes.ts";
import { crc32 } from "./checksums.ts";
import { MOST_LABELS, MOST_REGIONS, MOST_SIDE } from "./header.ts";
import { readIdsOfFile } from "./labels/file_ids.ts";
import { labelModelOfFiles } from "./labels/prior2.ts";
import { readLabels } from "./labels/stream.ts";
import { DecodeError } from "./scene.ts";

export { DecodeError } from "./scene.ts";

const VERSION = 1;
const TYPES = [
  { type: "bool", most: 1n, array: Uint8Array },
  { type: "uint8", most: 0xffn, array: Uint8Array },
  { type: "int8", most: 0x7fn, array: Int8Array },
  { type: "uint16", most: 0xffffn, array: Uint16Array },
  { type: "int16", most: 0x7fffn, array: Int16Array },
  { type: "uint32", most: 0xffffffffn, array: Uint32Array },
  { type: "int32", most: 0x7fffffffn, array: Int32Array },
  { type: "int64", most: 2n ** 63n - 1n, array: BigInt64Array },
] as const;

export interface LabelMap {
  readonly height: number; // pixels
  readonly width: number;
  readonly type: (typeof TYPES)[number]["type"]; // of the numbers that the map was given in
  readonly labels: InstanceType<(typeof TYPES)[number]["array"]>; // ids, row by row; bool as 0 and 1
}

/** Read a label map; a DecodeError if the file is damaged, ends early, or holds no label map. */
export function decodeLabels(bytes: Uint8Array): LabelMap {
  const magic = String.fromCharCode(...bytes.subarray(0, 4));
  if (magic !== "kcgm") {
    const got = magic === "kcgs" ? "a scene, which decode reads" : JSON.stringify(magic);
    throw new DecodeError(`data must be a label map, which starts with "kcgm"; got ${got}`);
  }
  const content = bytes.subarray(0, -4);
  if (bytes.length < 8 || crc32(content) !== new ByteReader(bytes.subarray(-4)).number(4))
    throw new DecodeError("the file is damaged or ends early: its checksum is another");
  const reader = new ByteReader(content.subarray(4));
  const form = reader.number(1);
  const version = (form >> 6) + 1;
  if (version !== VERSION) throw new DecodeError(`its version must be ${VERSION}; got ${version}`);
  const height = reader.varint("height", 1, MOST_SIDE);
  const width = reader.varint("width", 1, MOST_SIDE);
  if (height * width > MOST_LABELS)
    throw new DecodeError(`a map must have at most ${MOST_LABELS} pixels; got ${height} x ${width}`);
  return { height, width, ...readTurned(reader.take(reader.left), height, width, form & 7, form >> 3) };
}

function readTurned(
  stream: Uint8Array,
  height: number,
  width: number,
  turn: number,
  kind: number,
): Pick<LabelMap, "type" | "labels"> {
  const { type, most, array } = TYPES[kind]!;
  const [rows, columns] = turn & 4 ? [width, height] : [height, width];
  // more are noise, of more bytes
  const regions = Math.min(MOST_REGIONS, Math.max(2 ** 18 + 1, 4 * stream.length));
  const { ids, labels: turned } = readLabels(stream, rows, columns, labelModelOfFiles, regions, readIdsOfFile);
  const highest = ids[ids.length - 1]!;
  if (highest > most) throw new DecodeError(`ids of ${type} must be at most ${most}; got ${highest}`);
  const labels = new array(turned.length);
  const numbers = labels instanceof BigInt64Array ? ids : Float64Array.from(ids, Number);
  for (let row = 0, i = 0; row < rows; row++)
    for (let column = 0; column < columns; column++, i++) {
      const y = turn & 2 ? rows - 1 - row : row;
      const x = turn & 1 ? columns - 1 - column : column;
      labels[turn & 4 ? x * width + y : y * width + x] = numbers[turned[i]!]!;
    }
  return { type, labels };
}
