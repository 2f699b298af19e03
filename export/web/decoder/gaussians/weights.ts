/** The weights that the models of layers have at first (docs/format.md, "Weights at the start"). */

const WEIGHT = 0.05; // of a start against what is seen, in Gaussians
const repeat = <T>(count: number, value: T): T[] => Array<T>(count).fill(value);
// shapes of contexts, whose last bins weigh 1
const shapes = (...contexts: number[][]): number[][] =>
  contexts.map((values) => [...values, ...repeat(24 - values.length, 1)].map((value) => WEIGHT * value));

export const COUNTS = [2, ...repeat(9, 1), ...repeat(12, 0.3)];
export const MARGINS = [3, ...repeat(4, 1), ...repeat(4, 0.3)];
export const STRAYS = [20, 0.5];
export const ANGLES = repeat(2, [4.5, 3.5, 2.7, 2.5, 2.4, 2.5, 2.7, 3.5]).flat();
export const OUTSIDE = [0.3, ...repeat(4, 1), ...repeat(17, 0.3)];

/** The bins of the adaptive magnitudes, for each context. */
export const SHAPES = {
  grey: shapes(
    [5, 4, 3, 5, 7, 11, 24, 58, 115, 132, 129, 118, 106, 92, 76, 56, 33, 17, 9, 5, 3, 2],
  ),
  hue: shapes(
    [29, 30, 30, 31, 34, 40, 54, 79, 106, 110, 111, 85, 66, 69, 52, 37, 22, 13, 5, 3, 2, 2],
    [151, 134, 110, 53, 57, 73, 80, 82, 67, 49, 40, 33, 27, 21, 14, 9, 5, 2],
    [476, 254, 123, 66, 34, 20, 12, 8, 5, 3, 2, 2],
  ),
  hue2: shapes(
    [655, 228, 78, 27, 6, 3, 2, 2],
    [498, 262, 104, 54, 33, 18, 12, 9, 6, 3, 2, 2, 2],
    [283, 205, 150, 108, 71, 57, 40, 30, 21, 16, 9, 4, 4, 3, 3, 2],
  ),
  ratio: shapes(
    [263, 234, 192, 150, 91, 38, 17, 9, 5, 3, 2],
    [104, 132, 155, 170, 163, 133, 83, 40, 15, 6, 3, 2],
    [91, 105, 117, 123, 124, 127, 119, 92, 60, 29, 12, 4, 2],
    [116, 120, 126, 118, 110, 97, 86, 70, 55, 42, 33, 21, 9, 3],
    [111, 118, 140, 139, 125, 99, 77, 59, 42, 33, 20, 17, 11, 9, 5, 3],
    [101, 109, 143, 147, 142, 104, 85, 56, 44, 24, 17, 12, 8, 4, 4, 4, 4],
    [154, 183, 172, 137, 115, 74, 60, 38, 26, 19, 9, 5, 5, 4, 1, 1, 3],
    [219, 282, 216, 116, 69, 40, 17, 17, 10, 8, 4, 3, 2, 1, 1, 2, 2],
  ),
};
