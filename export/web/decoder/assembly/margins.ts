// Labels of a map with room around it: pixels outside have labels too (docs/format.md, "The wavefront").

import { allot } from "./memory";

export const LEFT: i32 = 8;
export const RIGHT: i32 = 9;
export const TOP: i32 = 6;
const AHEAD: i32 = 128; // pixels that a row is written at a time: to its end, a change would cost its width

export let stride: i32 = 0;
let labels: usize = 0;
let ends: usize = 0; // how far each row is written

export function openMargins(height: i32, width: i32): void {
  stride = width + LEFT + RIGHT;
  labels = allot(4 * <usize>(height + TOP + 1) * stride);
  ends = allot(4 * <usize>(height + TOP + 1));
}

/** Where the label of a pixel is. */
// @ts-ignore: decorator
@inline
export function pixelAddress(y: i32, x: i32): usize {
  return labels + 4 * (<usize>y * stride + x);
}

/** Where the number of a row is in a list of one i32 per row. */
// @ts-ignore: decorator
@inline
export function rowAddress(list: usize, y: i32): usize {
  return list + 4 * y;
}

// @ts-ignore: decorator
@inline
export function label(y: i32, x: i32): i32 {
  return load<i32>(pixelAddress(y, x));
}

function fill(y: i32, x: i32, end: i32, label: i32): void {
  const last = pixelAddress(y, end);
  for (let pixel = pixelAddress(y, x); pixel < last; pixel += 4) store<i32>(pixel, label);
}

/** Rows continue with their last label, so that only pixels near contours are looked at. */
export function continueRow(y: i32, x: i32, label: i32): void {
  fill(y, x, min(x + AHEAD, stride), label);
  store<i32>(rowAddress(ends, y), x + AHEAD);
}

/** Continue a row where a wavefront at column `x` would look beyond what is written. */
// @ts-ignore: decorator
@inline
export function reach(y: i32, x: i32): void {
  if (x + RIGHT >= load<i32>(rowAddress(ends, y))) continueRow(y, x, label(y, x - 1));
}

/** Repeat the label of a pixel above and at the left of the map. */
export function repeat(y: i32, x: i32, label: i32): void {
  if (y === TOP) for (let row = 0; row < TOP; row++) fill(row, x, x + RIGHT + 1, label);
  if (x === LEFT) fill(y + 1, 0, LEFT, label);
}

/** Whether the neighbours of a pixel that come before it have one label. */
export function isQuiet(y: i32, x: i32): bool {
  const first = label(y, x - 1);
  if (label(y, x - 2) !== first) return false;
  for (let i = x - 2; i < x + 8; i++) if (label(y - 1, i) !== first) return false;
  for (let i = x - 1; i < x + 4; i++) if (label(y - 2, i) !== first) return false;
  return true;
}

/** Where the labels of the map alone are, row by row; nothing else is left. */
export function strip(height: i32, width: i32): usize {
  for (let y = 0; y < height; y++) memory.copy(labels + 4 * (<usize>y * width), pixelAddress(y + TOP, LEFT), 4 * width);
  return labels;
}
