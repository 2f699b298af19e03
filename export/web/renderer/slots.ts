/** How many regions a pixel of a render can lie in, so that a GPU keeps room for as many. */

import { SHARED } from "./membership.ts";
import type { Membership } from "./membership.ts";

/** The most regions around any point between cells, `limit` at most. */
export function mostRegions(membership: Membership, limit: number): number {
  const { width, height, heads, lists, hard, perPixel } = membership;
  const side = hard ? Math.max(1, perPixel) : 1;
  const seen: number[] = [];
  const note = (region: number): void => {
    if (!seen.includes(region)) seen.push(region);
  };
  let most = 1;
  for (let y = 0; y < height && most < limit; y += side) {
    for (let x = 0; x < width; x += side) {
      seen.length = 0;
      for (let j = Math.max(0, y - (side > 1 ? 1 : 0)); j <= Math.min(height - 1, y + side); j++) {
        for (let i = Math.max(0, x - (side > 1 ? 1 : 0)); i <= Math.min(width - 1, x + side); i++) {
          const head = heads[j * width + i]!;
          if (head < SHARED) note(head);
          else for (let at = head - SHARED; lists[at] !== 0; at++) note(lists[at]! >>> 16);
        }
      }
      most = Math.max(most, seen.length);
    }
  }
  return Math.min(most, limit);
}
