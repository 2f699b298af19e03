/** Area means: an image shrinks to the means over each pixel's share of rows and columns, fractions included. */

import type { FineAxis } from "./sampling.ts";

/** Shrink (rows, columns, channels) along both axes. */
export function areaMean(
  image: Float32Array,
  channels: number,
  across: FineAxis,
  down: FineAxis,
  size: [number, number],
): Float32Array {
  const narrow = across.mean === null ? image : shrink(image, down.count, across, channels, size[1]);
  return down.mean === null ? narrow : shrink(narrow, 1, down, size[1] * channels, size[0]);
}

/** Shrink the middle axis of (outer, axis.count, inner) to `count`. */
function shrink(image: Float32Array, outer: number, axis: FineAxis, inner: number, count: number): Float32Array {
  const { from, span } = axis.mean!;
  const result = new Float32Array(outer * count * inner);
  for (let i = 0; i < count; i++) {
    const begin = Math.min(Math.max(from + i * span, 0), axis.count - span / 2);
    const end = Math.min(from + (i + 1) * span, axis.count);
    for (let line = Math.floor(begin); line < end; line++) {
      const share = (Math.min(end, line + 1) - Math.max(begin, line)) / (end - begin);
      if (share <= 0) continue;
      for (let o = 0; o < outer; o++) {
        const [to, source] = [(o * count + i) * inner, (o * axis.count + line) * inner];
        for (let c = 0; c < inner; c++) result[to + c]! += share * image[source + c]!;
      }
    }
  }
  return result;
}
