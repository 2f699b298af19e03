/** The container of a clip: a header, then records, each with its checksum (docs/format.md, "The file of a clip"). */

import { ByteReader, EndOfBytes } from "../bytes.ts";
import { crc32 } from "../checksums.ts";
import { MOST_CHANNELS, MOST_SIDE } from "../header.ts";
import { DecodeError } from "../scene.ts";

export const VERSION = 4;
export const KEY = 0;
const END = 2;
const MOST_RATE = 2 ** 20;
const MOST_BYTES = 2 ** 32;
const MOST_FRAMES = 2 ** 30;

/** A frame as bytes: a still file, or what changed since the frame before. */
export interface ClipRecord {
  readonly key: boolean;
  readonly data: Uint8Array;
}

export interface Container {
  readonly height: number;
  readonly width: number;
  readonly channels: number;
  readonly rate: readonly [frames: number, seconds: number];
  readonly records: readonly ClipRecord[]; // of the frames that are whole
  readonly complete: boolean; // whether the file ends where it should
}

/** Whether a file holds frames. */
export const isClip = (bytes: Uint8Array): boolean =>
  String.fromCharCode(...bytes.subarray(0, 4)) === "kcgs" && bytes[4] === VERSION;

/** Take a clip apart. */
export function readContainer(bytes: Uint8Array): Container {
  const reader = new ByteReader(bytes, EndOfBytes);
  const magic = String.fromCharCode(...reader.take(4));
  if (magic !== "kcgs") throw new DecodeError(`it must start with "kcgs"; got ${JSON.stringify(magic)}`);
  const version = reader.number(1);
  if (version !== VERSION) throw new DecodeError(`a clip has version ${VERSION}; got ${version}`);
  const height = reader.varint("height", 1, MOST_SIDE);
  const width = reader.varint("width", 1, MOST_SIDE);
  const channels = reader.varint("channels", 1, MOST_CHANNELS);
  const frames = reader.varint("frame rate", 1, MOST_RATE);
  const seconds = reader.varint("seconds of the frame rate", 1, MOST_RATE);
  const above = bytes.subarray(0, reader.position);
  if (reader.number(4) !== crc32(above))
    throw new DecodeError("the file is damaged: the checksum of its header is another");
  return { height, width, channels, rate: [frames, seconds], ...readRecords(reader) };
}

function readRecords(reader: ByteReader): Pick<Container, "records" | "complete"> {
  const records: ClipRecord[] = [];
  while (records.length < MOST_FRAMES) {
    const record = readRecord(reader, records.length);
    if (record === null) return { records, complete: false };
    if (record.kind === END) {
      if (reader.left)
        throw new DecodeError(`the clip must end after ${reader.position} bytes; got ${reader.data.length}`);
      return { records, complete: true };
    }
    const key = record.kind === KEY;
    if (!records.length && !key) throw new DecodeError("the first frame of a clip must be a key frame");
    records.push({ key, data: record.data });
  }
  throw new DecodeError(`a clip must hold at most ${MOST_FRAMES} frames`);
}

/** Read the next record; null where the file ends within it. */
function readRecord(reader: ByteReader, number: number): { kind: number; data: Uint8Array } | null {
  const start = reader.position;
  try {
    const kind = reader.varint("kind of a record", KEY, END);
    const length = reader.varint("length of a record", 0, MOST_BYTES);
    const head = reader.data.subarray(start, reader.position);
    const data = reader.take(length);
    if (reader.number(4) !== crc32(data, crc32(head, crc32(varint(number)))))
      throw new DecodeError(
        `the file is damaged: the checksum of frame ${number} is another`,
      );
    return { kind, data };
  } catch (error) {
    if (error instanceof EndOfBytes) return null;
    throw error;
  }
}

function varint(number: number): Uint8Array {
  const bytes = [number & 127];
  for (let rest = number >>> 7; rest; rest >>>= 7) {
    bytes[bytes.length - 1]! |= 128;
    bytes.push(rest & 127);
  }
  return Uint8Array.from(bytes);
}
