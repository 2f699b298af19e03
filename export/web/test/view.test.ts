import assert from "node:assert/strict";
import { test } from "node:test";

import { anchorAt, clamp, fit, MAX_SCALE, origin, pan, visiblePart, zoomAbout } from "../element/view.ts";
import type { Transform } from "../element/view.ts";

const SCENE = { width: 854, height: 480 };
const CANVAS = { width: 1001, height: 700 };

test("fit shows the whole scene in the middle", () => {
  const part = visiblePart(fit(SCENE, CANVAS), SCENE, CANVAS);
  assert.equal(part.width, CANVAS.width);
  assert.ok(Math.abs(part.rect[0]) < 1 && Math.abs(part.rect[2] - SCENE.width) < 1);
  assert.ok(part.y > 0 && Math.abs(2 * part.y + part.height - CANVAS.height) <= 1);
});

test("scale 1 samples the scene at its pixel centres", () => {
  const part = visiblePart({ ...fit(SCENE, CANVAS), scale: 1 }, SCENE, CANVAS);
  assert.deepEqual(part.rect, [0, 0, SCENE.width, SCENE.height]);
  assert.deepEqual([part.width, part.height], [SCENE.width, SCENE.height]);
});

test("a zoom keeps the point under the pointer", () => {
  const [x, y] = [640, 223];
  const under = (t: Transform): number[] => {
    const [ox, oy] = origin(t, CANVAS);
    return [(x - ox) / t.scale, (y - oy) / t.scale];
  };
  const start = fit(SCENE, CANVAS);
  const anchor = anchorAt(start, x, y, CANVAS);
  for (const factor of [4, 80]) {
    const after = under(zoomAbout(start, factor, anchor, SCENE, CANVAS));
    assert.ok(Math.hypot(after[0]! - anchor.scene[0], after[1]! - anchor.scene[1]) < 0.2);
  }
});

test("scale and centre stay within their limits", () => {
  assert.equal(clamp({ x: 0, y: 0, scale: 1e9 }, SCENE, CANVAS).scale, MAX_SCALE);
  const far = pan({ ...fit(SCENE, CANVAS), scale: 10 }, 1e6, -1e6, SCENE, CANVAS);
  const { rect } = visiblePart(far, SCENE, CANVAS);
  assert.ok(Math.abs(rect[0]) < 0.1 && Math.abs(rect[3] - SCENE.height) < 0.1);
  const small = clamp({ x: 0, y: 0, scale: 1e-9 }, { width: 8, height: 8 }, CANVAS);
  assert.deepEqual(small, { x: 4, y: 4, scale: 1 });
});
