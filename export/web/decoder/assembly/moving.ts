// A label map that is predicted from the last one, by an affine motion of each region (docs/format.md, "Moving a map").

import { allot } from "./memory";

export const MARGIN: i32 = 5; // around both maps: how far the templates of pixels reach

export let height: i32 = 0;
export let width: i32 = 0;
export let stride: i32 = 0;
/** Where pixel (0, 0) of the last map is, i32; when a map was read, of that. */
export let labels: usize = 0;
/** Where pixel (0, 0) of the predicted map is. */
export let predicted: usize = 0;
/** The pixels of each region, i32, as `measure` finds them. */
export let areas: usize = 0;
let boxes: usize = 0; // i32 [regions, 4]: first and last column, first and last row
let ranks: usize = 0; // i32 [regions]: place in the order
let regions: i32 = 0;

export function openMaps(rows: i32, columns: i32, all: i32): void {
  height = rows;
  width = columns;
  regions = all;
  stride = width + 2 * MARGIN;
  const bytes = at(height + 2 * MARGIN, 0);
  const corner = at(MARGIN, MARGIN);
  labels = allot(bytes) + corner;
  predicted = allot(bytes) + corner;
  areas = allot(4 * <usize>regions);
  boxes = allot(16 * <usize>regions);
  ranks = allot(4 * <usize>regions);
}

/** Where a pixel is, from pixel (0, 0) on. */
// @ts-ignore: decorator
@inline
export function at(y: i32, x: i32): usize {
  return 4 * <usize>(<isize>y * stride + x);
}

/** Find the area of each region in the last map, and its first and last column and row. */
export function measure(): void {
  for (let region: usize = 0; region < <usize>regions; region++) {
    store<i32>(areas + 4 * region, 0);
    const box = boxes + 16 * region;
    store<i32>(box, width);
    store<i32>(box, -1, 4);
    store<i32>(box, height, 8);
    store<i32>(box, -1, 12);
  }
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++) {
      const region = <usize>load<i32>(labels + at(y, x));
      const area = areas + 4 * region;
      store<i32>(area, load<i32>(area) + 1);
      const box = boxes + 16 * region;
      store<i32>(box, min(load<i32>(box), x));
      store<i32>(box, max(load<i32>(box, 4), x), 4);
      store<i32>(box, min(load<i32>(box, 8), y), 8);
      store<i32>(box, y, 12);
    }
}

/**
 * Move so many regions, in an order, i32, each over those before; then fill what none has. `motions`: six numbers of each
 * region, f64, whole ones.
 */
export function predict(order: usize, count: i32, motions: usize): void {
  memory.fill(predicted - at(MARGIN, MARGIN), 0xff, at(height + 2 * MARGIN, 0));
  for (let place: usize = 0; place < <usize>count; place++) {
    const region = load<i32>(order + 4 * place);
    store<i32>(ranks + 4 * <usize>region, <i32>place);
    claim(region, motions + 48 * <usize>region);
  }
  let known = -1;
  for (let y = 0; y < height; y++)
    if (fillRow(predicted + at(y, 0))) {
      if (known < 0) for (let above = 0; above < y; above++) copyRow(above, y);
      known = y;
    } else if (known >= 0) copyRow(y, known);
  if (known < 0) for (let y = 0; y < height; y++) fill(predicted + at(y, 0), 0, width, load<i32>(order));
  surround();
}

function copyRow(y: i32, from: i32): void {
  memory.copy(predicted + at(y, 0), predicted + at(from, 0), 4 * <usize>width);
}

function fill(row: usize, from: i32, to: i32, label: i32): void {
  for (let x = from; x < to; x++) store<i32>(row + 4 * <isize>x, label);
}

/** Outside, the map continues with the nearest pixel inside. */
function surround(): void {
  for (let y = 0; y < height; y++) {
    const row = predicted + at(y, 0);
    fill(row, -MARGIN, 0, load<i32>(row));
    fill(row, width, width + MARGIN, load<i32>(row + 4 * <usize>(width - 1)));
  }
  const bytes = at(1, 0);
  const top = predicted + at(0, -MARGIN);
  const bottom = predicted + at(height - 1, -MARGIN);
  for (let i: usize = 1; i <= <usize>MARGIN; i++) {
    memory.copy(top - i * bytes, top, bytes);
    memory.copy(bottom + i * bytes, bottom, bytes);
  }
}

// @ts-ignore: decorator
@inline
function whole(at: usize): i64 {
  return <i64>load<f64>(at);
}

/** Give a region the pixels that its motion leads from to one of its own. */
function claim(region: i32, motion: usize): void {
  const a = whole(motion);
  const b = whole(motion + 8);
  const c = whole(motion + 16);
  const d = whole(motion + 24);
  const e = whole(motion + 32);
  const f = whole(motion + 40);
  const box = boxes + 16 * <usize>region;
  for (let i = 0; i < height; i++) {
    // twice the source of the row's first centre; 2 a and 2 d more for each pixel
    let x = a + b * (2 * i + 1) + 2 * c;
    let y = d + e * (2 * i + 1) + 2 * f;
    from = 0;
    to = width;
    narrow(x, 2 * a, load<i32>(box), load<i32>(box, 4), width);
    narrow(y, 2 * d, load<i32>(box, 8), load<i32>(box, 12), height);
    x += from * 2 * a;
    y += from * 2 * d;
    const row = predicted + at(i, 0);
    for (let j = from; j < to; j++) {
      const source = at(
        <i32>min(max(y >> 17, 0), <i64>height - 1),
        <i32>min(max(x >> 17, 0), <i64>width - 1),
      );
      if (load<i32>(labels + source) === region) store<i32>(row + 4 * <usize>j, region);
      x += 2 * a;
      y += 2 * d;
    }
  }
}

// the columns that are looked at
let from: i64 = 0;
let to: i64 = 0;
const FAR: i64 = 1 << 62;

/** Narrow columns j to those of first <= (start + j step) >> 17 <= last; at the map's sides that has no end. */
function narrow(start: i64, step: i64, first: i32, last: i32, size: i32): void {
  const least = first > 0 ? start - ((<i64>first) << 17) : FAR;
  const most = last < size - 1 ? ((<i64>last + 1) << 17) - 1 - start : FAR;
  if (step === 0) {
    if (least < 0 || most < 0) to = 0;
  } else if (step > 0) {
    from = max(from, -quotient(least, step));
    to = min(to, quotient(most, step) + 1);
  } else {
    from = max(from, -quotient(most, -step));
    to = min(to, quotient(least, -step) + 1);
  }
}

/** Rounded down, also below zero. */
function quotient(n: i64, by: i64): i64 {
  return n >= 0 ? n / by : -((by - 1 - n) / by);
}

/** Fill what no region has from the left or the right, by the region that comes first; tell whether the row has any. */
function fillRow(row: usize): bool {
  let x = 0;
  while (x < width) {
    const label = load<i32>(row + 4 * <usize>x);
    if (label >= 0) {
      x++;
      continue;
    }
    let end = x;
    while (end < width && load<i32>(row + 4 * <usize>end) < 0) end++;
    if (end - x === width) return false;
    let chosen = x > 0 ? load<i32>(row + 4 * <usize>(x - 1)) : load<i32>(row + 4 * <usize>end);
    if (end < width) {
      const right = load<i32>(row + 4 * <usize>end);
      if (load<i32>(ranks + 4 * <usize>right) < load<i32>(ranks + 4 * <usize>chosen)) chosen = right;
    }
    fill(row, x, end, chosen);
    x = end;
  }
  return true;
}
