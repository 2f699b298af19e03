/** The weights that the models of layers have at first (docs/format.md, "Weights at the start"). */

const WEIGHT = 0.05; // of a start against what is seen, in Gaussians
const repeat = (count: number, value: number): number[] => Array<number>(count).fill(value);
const bins = (...values: number[]): number[] => values.map((value) => WEIGHT * value);

export const COUNTS = [2, ...repeat(9, 1), ...repeat(12, 0.3)];
export const STRAYS = [20, 0.5];
export const GREY = bins(
  ...[1, 1, 2, 3, 12, 22, 49, 80, 102, 110, 110, 103, 88, 74, 62, 46, 34, 27, 22, 17, 12, 6, 6, 12],
);
export const HUE = bins(382, 247, 144, 96, 51, 30, 21, 12, 7, 3, 2, 2, 1, 1, ...repeat(10, 0.5));
export const HUE2 = bins(547, 224, 98, 63, 27, 13, 12, 9, 5, 1, 1, ...repeat(13, 0.5));
export const RATIO = bins(102, 159, 168, 150, 125, 98, 69, 46, 30, 21, 14, 8, 5, 3, 2, 1, ...repeat(8, 0.5));
