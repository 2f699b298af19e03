/** What a decoder file says of itself, read from its bytes: onnxruntime-web does not expose metadata_props. */

import protobuf from "protobufjs/minimal.js";

/** Fields of onnx.ModelProto, and of the StringStringEntryProto inside metadata_props. */
const IR_VERSION = 1;
const GRAPH = 7;
const METADATA_PROPS = 14;
const KEY = 1;
const VALUE = 2;
const LENGTH_DELIMITED = 2;

export interface SceneMetadata {
  kcgsVersion: string;
  recipe: string;
  width: number;
  height: number;
  channels: number;
  numGaussians: number;
  numRegions: number;
  regionIds: number[];
  contours: string;
  cutoff: string;
  precision: string;
  clamp: boolean;
  leftOut: string[];
}

/** A file that this page cannot open; the message is for the person who chose it. */
export class DecoderFileError extends Error {
  override name = "DecoderFileError";
}

/** Read metadata_props of an ONNX model, passing over all other fields unread. */
export function readProperties(bytes: Uint8Array): Map<string, string> {
  if (bytes.length === 0) throw new DecoderFileError("the file is empty.");
  const properties = new Map<string, string>();
  const reader = protobuf.Reader.create(bytes);
  let versioned = false;
  let graph = false;
  try {
    while (reader.pos < reader.len) {
      const tag = reader.uint32();
      const field = tag >>> 3;
      if (field === METADATA_PROPS && (tag & 7) === LENGTH_DELIMITED) {
        const [key, value] = readEntry(reader);
        properties.set(key, value);
        continue;
      }
      versioned ||= field === IR_VERSION && (tag & 7) === 0;
      graph ||= field === GRAPH && (tag & 7) === LENGTH_DELIMITED;
      reader.skipType(tag & 7);
    }
  } catch {
    // A foreign file may hold a tag or two that pass; a model that breaks off has named its version by then.
    throw new DecoderFileError(
      versioned ? "the file is damaged or cut short; export or download it again." : "this is not an ONNX file.",
    );
  }
  if (!versioned || !graph) throw new DecoderFileError("this is not an ONNX file.");
  return properties;
}

/** Read the metadata of a scene decoder; any other file is a DecoderFileError. */
export function readSceneMetadata(bytes: Uint8Array): SceneMetadata {
  const properties = readProperties(bytes);
  if (properties.get("format") !== "kcgs.decoder") {
    throw new DecoderFileError("this ONNX model is not a kcgs decoder; make one with `kcgs export SCENE -o decoder.onnx`.");
  }
  const version = properties.get("format_version");
  if (version !== "1") {
    throw new DecoderFileError(`its format version is ${version ?? "missing"}; this page reads version 1.`);
  }
  if (properties.get("kind") !== "scene") {
    throw new DecoderFileError(
      `this page opens scene decoders; this is a ${properties.get("kind") ?? "nameless"} decoder, which holds no ` +
        "picture of its own. Make one with `kcgs export SCENE -o decoder.onnx`.",
    );
  }
  return {
    kcgsVersion: properties.get("kcgs_version") ?? "",
    recipe: properties.get("recipe") ?? "",
    width: readCount(properties, "width", 1),
    height: readCount(properties, "height", 1),
    channels: readCount(properties, "channels", 1),
    numGaussians: readCount(properties, "num_gaussians", 0),
    numRegions: readCount(properties, "num_regions", 1),
    regionIds: readList(properties, "region_ids", isInteger),
    contours: properties.get("contours") ?? "",
    cutoff: properties.get("cutoff") ?? "",
    precision: properties.get("precision") ?? "",
    clamp: properties.get("clamp") === "true",
    leftOut: readList(properties, "left_out", isString),
  };
}

function readEntry(reader: protobuf.Reader): [string, string] {
  const length = reader.uint32();
  const end = reader.pos + length;
  if (end > reader.len) throw new RangeError("metadata entry passes the end of the file");
  let key = "";
  let value = "";
  while (reader.pos < end) {
    const tag = reader.uint32();
    if (tag === ((KEY << 3) | LENGTH_DELIMITED)) key = reader.string();
    else if (tag === ((VALUE << 3) | LENGTH_DELIMITED)) value = reader.string();
    else reader.skipType(tag & 7);
  }
  return [key, value];
}

function readCount(properties: Map<string, string>, key: string, least: number): number {
  const text = properties.get(key) ?? "";
  const count = Number(text);
  if (text === "" || !Number.isSafeInteger(count) || count < least) {
    throw new DecoderFileError(`its metadata is damaged: ${key} must be a whole number from ${least}, got "${text}".`);
  }
  return count;
}

const isInteger = (item: unknown): item is number => Number.isSafeInteger(item);
const isString = (item: unknown): item is string => typeof item === "string";

function readList<T>(properties: Map<string, string>, key: string, is: (item: unknown) => item is T): T[] {
  let list: unknown;
  try {
    list = JSON.parse(properties.get(key) ?? "");
  } catch {
    // Told below, with lists of the wrong things.
  }
  if (!Array.isArray(list) || !list.every(is)) {
    throw new DecoderFileError(`its metadata is damaged: ${key} is not the list that it should be.`);
  }
  return list;
}
