/** What a file says before its content, and the limits that bound a decoder's memory (docs/format.md). */

import type { ByteReader } from "./bytes.ts";
import { crc32 } from "./checksums.ts";
import { DecodeError } from "./scene.ts";

const MAX_SIDE = 2 ** 20;
export const MAX_LABELS = 2 ** 26;
const MAX_REGIONS = 2 ** 24 - 1;
const MAX_CHANNELS = 1024;
const MAX_GAUSSIANS = 2 ** 21 - 1;
const MAX_COLORS = 2 ** 27;
const MAX_BYTES = 2 ** 32;
const MAX_LAYERS = 128;
const VERSION = 1;
export const ENERGIES = { min: -24, max: 40 };
const PARAMETERS = { min: -512, max: 1023 };

export interface Header {
  readonly height: number;
  readonly width: number;
  readonly channels: number;
  readonly quantizationParameter: number;
  readonly regions: number;
  readonly layers: readonly { readonly energy: number; readonly bytes: number }[];
}

export const mostGaussians = (channels: number): number =>
  Math.min(MAX_GAUSSIANS, Math.floor(MAX_COLORS / channels));

const text = (bytes: Uint8Array): string => JSON.stringify(String.fromCharCode(...bytes));

/** Read the header, its checksum and the bytes of the map (none with one region). */
export function readHeader(reader: ByteReader): { header: Header; map: Uint8Array } {
  const magic = String.fromCharCode(...reader.take(4));
  if (magic === "kcgm") throw new DecodeError("it is a label map, no scene");
  if (magic !== "kcgs") throw new DecodeError(`it must start with "kcgs"; got ${text(reader.data.subarray(0, 4))}`);
  const version = reader.number(1);
  if (version !== VERSION) throw new DecodeError(`its version must be ${VERSION}; got ${version}`);
  const height = reader.varint("height", 1, MAX_SIDE);
  const width = reader.varint("width", 1, MAX_SIDE);
  const channels = reader.varint("channels", 1, MAX_CHANNELS);
  const parameters = PARAMETERS.max - PARAMETERS.min;
  const quantizationParameter = reader.varint("quantization parameter", 0, parameters) + PARAMETERS.min;
  const regions = reader.varint("regions", 1, MAX_REGIONS);
  if (regions > 1 && height * width > MAX_LABELS)
    throw new DecodeError(`an image with regions must have at most ${MAX_LABELS} pixels; got ${height} x ${width}`);
  const length = regions > 1 ? reader.varint("length of the map", 1, MAX_BYTES) : 0;
  const layers = readLayers(reader);
  const above = reader.data.subarray(0, reader.position);
  const checksum = reader.number(4);
  const map = reader.take(length);
  if (crc32(map, crc32(above)) !== checksum)
    throw new DecodeError("the file is damaged: the checksum of its header and map is wrong");
  return { header: { height, width, channels, quantizationParameter, regions, layers }, map };
}

function readLayers(reader: ByteReader): { energy: number; bytes: number }[] {
  let energy = ENERGIES.max;
  const count = reader.varint("layers", 1, MAX_LAYERS);
  return Array.from({ length: count }, () => {
    energy -= reader.varint("energy", 0, energy - ENERGIES.min);
    return { energy, bytes: reader.varint("length of a layer", 1, MAX_BYTES) };
  });
}
