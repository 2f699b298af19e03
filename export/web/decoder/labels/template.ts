/** The earlier pixels that tell of a pixel (docs/format.md, "Probabilities of a pixel"). */

/** Columns of each row above the pixel that are seen, nearest row first. */
const REACH = [
  [-8, -1],
  [-8, 7],
  [-7, 8],
  [-6, 7],
  [-5, 6],
  [-3, 4],
  [-2, 3],
] as const;

type Place = readonly [dx: number, dy: number];

/** By distance. */
export const TEMPLATE: readonly Place[] = REACH.flatMap(([first, last], row) =>
  Array.from({ length: last - first + 1 }, (_, i) => [first + i, row ? -row : 0] as const),
).sort(
  ([ax, ay], [bx, by]) => ax * ax + ay * ay - bx * bx - by * by || by - ay || ax - bx,
);

/** Neighbours in a row, up to four, as places of the template; 255 where there is none. */
export const GROUPS: readonly (readonly number[])[] = REACH.flatMap(([first, last], row) =>
  Array.from({ length: Math.ceil((last - first + 1) / 4) }, (_, group) =>
    [0, 1, 2, 3].map((i) => {
      const place = TEMPLATE.findIndex(([dx, dy]) => dx === first + 4 * group + i && dy === (row ? -row : 0));
      return place < 0 ? 255 : place;
    }),
  ),
);
