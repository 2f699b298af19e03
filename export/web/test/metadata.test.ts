import assert from "node:assert/strict";
import { test } from "node:test";

import protobuf from "protobufjs/minimal.js";

import { DecoderFileError, readProperties, readSceneMetadata } from "../src/metadata.ts";

const PROPERTIES = {
  format: "kcgs.decoder",
  format_version: "1",
  kind: "scene",
  width: "96",
  height: "64",
  channels: "3",
  num_gaussians: "1250",
  num_regions: "2",
  region_ids: "[0, 7]",
  left_out: '["opacities: merged"]',
};

/** A model with metadata before and after a graph that is no graph: the reader must not look into it. */
function model(properties: Record<string, string>): Uint8Array {
  const writer = protobuf.Writer.create().uint32((1 << 3) | 0).int32(10);
  const [first, ...rest] = Object.entries(properties);
  const entry = ([key, value]: [string, string]): void => {
    writer.uint32((14 << 3) | 2).fork().uint32((1 << 3) | 2).string(key).uint32((2 << 3) | 2).string(value).ldelim();
  };
  if (first) entry(first);
  writer.uint32((7 << 3) | 2).bytes(new Uint8Array(1000).fill(0xff));
  rest.forEach(entry);
  return writer.finish();
}

const refusal = (says: RegExp) => (error: unknown) => error instanceof DecoderFileError && says.test(error.message);

test("properties are read from either side of the graph", () => {
  assert.deepEqual(Object.fromEntries(readProperties(model(PROPERTIES))), PROPERTIES);
});

test("scene metadata has numbers and lists", () => {
  const metadata = readSceneMetadata(model(PROPERTIES));
  assert.deepEqual(metadata.regionIds, [0, 7]);
  assert.deepEqual([metadata.width, metadata.height, metadata.numGaussians], [96, 64, 1250]);
  assert.deepEqual(metadata.leftOut, ["opacities: merged"]);
});

test("every cut of a file is refused", () => {
  const whole = model(PROPERTIES);
  for (let length = 0; length < whole.length; length++) {
    assert.throws(() => readSceneMetadata(whole.subarray(0, length)), DecoderFileError, `cut at ${length}`);
  }
});

test("random bytes are refused", () => {
  let state = 1;
  for (let run = 0; run < 500; run++) {
    const bytes = Uint8Array.from({ length: 64 }, () => (state = (state * 48271) % 2147483647) & 255);
    assert.throws(() => readSceneMetadata(bytes), DecoderFileError);
  }
});

test("the message says what is wrong", () => {
  assert.throws(() => readSceneMetadata(new Uint8Array()), refusal(/empty/));
  assert.throws(() => readSceneMetadata(model({})), refusal(/not a kcgs decoder/));
  assert.throws(() => readSceneMetadata(model({ ...PROPERTIES, kind: "generic" })), refusal(/opens scene decoders/));
  assert.throws(() => readSceneMetadata(model({ ...PROPERTIES, format_version: "2" })), refusal(/version is 2/));
  assert.throws(() => readSceneMetadata(model({ ...PROPERTIES, width: "-3" })), refusal(/width/));
  assert.throws(() => readSceneMetadata(model({ ...PROPERTIES, region_ids: "7" })), refusal(/region_ids/));
});
