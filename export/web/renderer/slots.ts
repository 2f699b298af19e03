/** How many regions a pixel of a render can lie in, so that a GPU keeps room for as many. */

import { SHARED } from "./membership.ts";
import type { Membership } from "./membership.ts";

/** The most regions around any point between cells, `limit` at most. */
export function mostRegions(membership: Membership, limit: number): number {
  const { width, height, heads, lists } = membership;
  const present: number[] = [];
  const note = (region: number): void => {
    if (!present.includes(region)) present.push(region);
  };
  let largest = 1;
  for (let y = 0; y < height && largest < limit; y++) {
    for (let x = 0; x < width; x++) {
      present.length = 0;
      for (let j = y; j <= Math.min(height - 1, y + 1); j++) {
        for (let i = x; i <= Math.min(width - 1, x + 1); i++) {
          const head = heads[j * width + i]!;
          if (head < SHARED) note(head);
          else for (let entry = head - SHARED; lists[entry] !== 0; entry++) note(lists[entry]! >>> 16);
        }
      }
      largest = Math.max(largest, present.length);
    }
  }
  return Math.min(largest, limit);
}
