/** How many regions a pixel of a render can lie in, so that a GPU keeps room for as many. */

import { SHARED } from "./membership.ts";
import type { Membership } from "./membership.ts";

/** The most regions around any point between cells, `limit` at most. */
export function mostRegions(membership: Membership, limit: number): number {
  const { width, height, heads, lists } = membership;
  const seen: number[] = [];
  const note = (region: number): void => {
    if (!seen.includes(region)) seen.push(region);
  };
  let most = 1;
  for (let y = 0; y < height && most < limit; y++) {
    for (let x = 0; x < width; x++) {
      seen.length = 0;
      for (let j = y; j <= Math.min(height - 1, y + 1); j++) {
        for (let i = x; i <= Math.min(width - 1, x + 1); i++) {
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
