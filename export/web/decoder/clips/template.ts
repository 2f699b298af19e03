/** The places that tell whether a pixel deviates (docs/format.md, "Chances of a deviation"), by distance. */

type Place = readonly [dx: number, dy: number];

/** Columns of each row above the pixel, nearest row first. */
const REACH = [
  [-5, -1],
  [-5, 3],
  [-4, 4],
  [-3, 3],
  [-2, 2],
] as const;
const SIDE = 4;
const FARTHEST = 18; // squared

const nearestFirst = (places: Place[]): Place[] =>
  places.sort(([ax, ay], [bx, by]) => ax * ax + ay * ay - bx * bx - by * by || by - ay || ax - bx);

export const EARLIER: readonly Place[] = nearestFirst(
  REACH.flatMap(([first, last], row) =>
    Array.from({ length: last - first + 1 }, (_, i) => [first + i, row ? -row : 0] as const),
  ),
);

const SQUARE = Array.from({ length: (2 * SIDE + 1) ** 2 }, (_, i): Place => {
  return [(i % (2 * SIDE + 1)) - SIDE, Math.floor(i / (2 * SIDE + 1)) - SIDE];
});

export const AROUND: readonly Place[] = nearestFirst(
  SQUARE.filter(([dx, dy]) => dx * dx + dy * dy > 0 && dx * dx + dy * dy <= FARTHEST),
);
