import assert from "node:assert/strict";
import { test } from "node:test";

import { FrameQueue, FrameTimes } from "../src/frames.ts";
import { psnr } from "../src/pixels.ts";
import { sameOrigin } from "../src/sources.ts";

const later = (ms = 1): Promise<void> => new Promise((resolve) => setTimeout(resolve, ms));

test("at most one runs, and the newest view is the last one drawn", async () => {
  let view = 0;
  let running = 0;
  const drawn: number[] = [];
  const queue = new FrameQueue(async () => {
    assert.equal(++running, 1);
    const mine = view;
    await later(5);
    drawn.push(mine);
    running--;
  });
  for (view = 1; view < 50; view++) queue.want();
  await later();
  queue.want();
  await queue.idle();
  assert.ok(drawn.length <= 3);
  assert.equal(drawn.at(-1), 50);
});

test("views go before tasks, urgent tasks before others, and a failed task stops nothing", async () => {
  const order: string[] = [];
  const queue = new FrameQueue(async () => void order.push("view"));
  const first = queue.task(async () => {
    order.push("first");
    await later();
    throw new Error("no");
  });
  void queue.task(async () => void order.push("second"));
  void queue.task(async () => void order.push("urgent"), true);
  queue.want();
  await assert.rejects(first, /no/);
  await queue.idle();
  assert.deepEqual(order, ["first", "view", "urgent", "second"]);
});

test("the median is that of the last ten, and slow frames divide the resolution", () => {
  const times = new FrameTimes();
  assert.equal(times.median, null);
  assert.equal(times.divisorFor(1e6), 1);
  for (const ms of [900, 900, 900, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]) times.add(ms, 1e6);
  assert.equal(times.median, 5.5);
  times.clear();
  times.add(640, 1e6);
  assert.equal(times.divisorFor(1e6), 4);
});

test("PSNR is taken on clipped values", () => {
  const original = Uint8ClampedArray.from([255, 0, 51, 255]);
  assert.equal(psnr({ data: Float32Array.from([3, -2, 0.2 + 1e-9]), dims: [1, 3, 1, 1] }, original) > 100, true);
  const off = psnr({ data: Float32Array.from([0.9, 0.1, 0.3]), dims: [1, 3, 1, 1] }, original);
  assert.ok(Math.abs(off - 20) < 1e-4);
});

test("addresses of other servers are refused", () => {
  const base = "http://localhost:8000/page/";
  assert.equal(sameOrigin("a b.onnx", base).href, "http://localhost:8000/page/a%20b.onnx");
  for (const address of ["//elsewhere.test/a", "https://localhost:8000/a", "http://localhost:8001/a", "data:,a", "http://"]) {
    assert.throws(() => sameOrigin(address, base), /server/);
  }
});
