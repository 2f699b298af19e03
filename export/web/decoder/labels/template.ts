/** The earlier pixels that tell of a pixel (docs/format.md, "Chances of a pixel"). */

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

/** Row by row. */
const PLACES: readonly Place[] = REACH.flatMap(([first, last], row) =>
  Array.from({ length: last - first + 1 }, (_, i) => [first + i, row ? -row : 0] as const),
);

/** By distance. */
export const TEMPLATE: readonly Place[] = [...PLACES].sort(
  ([ax, ay], [bx, by]) => ax * ax + ay * ay - bx * bx - by * by || by - ay || ax - bx,
);

/** Neighbours in a row, up to four, as places of the template: most are of one label, which says nothing. */
export const GROUPS: readonly (readonly number[])[] = REACH.flatMap(([first, last], row) =>
  Array.from({ length: Math.ceil((last - first + 1) / 4) }, (_, group) =>
    PLACES.filter(([dx, dy]) => dy === (row ? -row : 0) && (dx - first) >> 2 === group).map((place) =>
      TEMPLATE.indexOf(place),
    ),
  ),
);
