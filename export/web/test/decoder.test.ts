import assert from "node:assert/strict";
import { test } from "node:test";

import { ByteReader, EndOfBytes } from "../decoder/bytes.ts";
import { crc16, crc32 } from "../decoder/checksums.ts";
import { cosine, exp2, sine } from "../decoder/exact.ts";
import { GrowingArray } from "../decoder/growing_array.ts";
import { readHeader } from "../decoder/header.ts";
import { Remaining } from "../decoder/labels/remaining.ts";
import { GROUPS, TEMPLATE } from "../decoder/labels/template.ts";
import { touchingPairs } from "../decoder/pairs.ts";
import { DecodeError } from "../decoder/scene.ts";

const ascii = (text: string): Uint8Array => Uint8Array.from(text, (letter) => letter.charCodeAt(0));

test("checksums are those of zlib and of XMODEM", () => {
  assert.equal(crc32(ascii("123456789")), 0xcbf43926);
  assert.equal(crc32(ascii("56789"), crc32(ascii("1234"))), 0xcbf43926);
  assert.equal(crc16(ascii("123456789")), 0x31c3);
});

test("varints have the lowest bits first, and limits", () => {
  assert.equal(new ByteReader(Uint8Array.of(0xe5, 0x8e, 0x26)).varint("number", 0, 1e6), 624485);
  assert.throws(() => new ByteReader(Uint8Array.of(7)).varint("height", 8, 9), /height must be in \[8, 9\]; got 7/);
  assert.equal(new ByteReader(Uint8Array.of(129, 128, 128, 128, 0)).varint("width", 0, 1), 1);
  assert.throws(() => new ByteReader(Uint8Array.of(129, 128, 128, 128, 128, 0)).varint("width", 0, 1), /35 bits/);
  assert.throws(() => new ByteReader(new Uint8Array(9).fill(255)).varint("width", 0, 1), /more than 35 bits/);
  assert.throws(() => new ByteReader(Uint8Array.of(255), EndOfBytes).varint("width", 0, 1), EndOfBytes);
});

test("another version is refused", () => {
  assert.throws(() => readHeader(new ByteReader(ascii("kcgs\x02..."))), {
    name: "DecodeError",
    message: "its version must be 1; got 2",
  });
  assert.throws(() => readHeader(new ByteReader(ascii("kcgm"))), DecodeError);
});

test("powers and angles", () => {
  for (const x of [-80, -0.5, 0, 1, 34]) assert.ok(Math.abs(exp2(x) / 2 ** x - 1) < 1e-15);
  assert.ok(Math.abs(exp2(0.5) - Math.SQRT2) < 1e-15);
  assert.equal(sine(0.5), 1);
  assert.ok(Math.abs(cosine(0.25) - Math.SQRT1_2) < 1e-15 && cosine(0.5) === 0 && cosine(1) < -0.9999);
});

test("the template is sorted by distance, and its groups hold each place once", () => {
  assert.equal(TEMPLATE.length, 80);
  assert.deepEqual(TEMPLATE.slice(0, 5), [[-1, 0], [0, -1], [-1, -1], [1, -1], [-2, 0]]);
  const places = GROUPS.flat().filter((place) => place < 255);
  assert.deepEqual(places.sort((a, b) => a - b), [...TEMPLATE.keys()]);
  assert.ok(GROUPS.length === 21 && GROUPS.every((group) => group.length === 4));
});

test("what is left by rank", () => {
  const remaining = new Remaining(5);
  assert.deepEqual([3, 0, 1, 1, 0].map((rank) => remaining.take(rank)), [3, 0, 2, 4, 1]);
});

test("pairs of regions side by side, each once, in order", () => {
  const labels = Int32Array.of(0, 0, 2, 0, 1, 2);
  assert.deepEqual([...touchingPairs(labels, 3, 3)], [0 * 3 + 1, 0 * 3 + 2, 1 * 3 + 2]);
  const noise = new Int32Array(100 * 100).map((_, i) => (i * 7919) % 1009);
  assert.deepEqual(touchingPairs(noise, 100, 1009), touchingPairs(noise, 100, 1009).sort());
});

test("numbers to which more are added", () => {
  const growing = new GrowingArray<Int32Array>(new Int32Array(0));
  for (let i = 0; i < 100; i++) growing.add(Int32Array.of(i, -i));
  assert.equal(growing.length, 200);
  assert.deepEqual([...growing.all().subarray(-2)], [99, -99]);
});
