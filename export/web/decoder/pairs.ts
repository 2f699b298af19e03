const ROOM = 4096;

/** The pairs of regions that have labels side by side, in order: a times the number of regions plus b, a < b. */
export function touchingPairs(labels: Int32Array, width: number, regions: number): Float64Array {
  let pairs = new Float64Array(ROOM);
  let count = 0;
  let last = -1;
  const add = (one: number, other: number): void => {
    const pair = one < other ? one * regions + other : other * regions + one;
    if (one === other || pair === last) return;
    last = pair;
    if (count === pairs.length) {
      const distinct = unique(pairs);
      count = distinct.length;
      pairs = count > pairs.length / 2 ? new Float64Array(2 * pairs.length) : pairs;
      pairs.set(distinct);
    }
    pairs[count++] = pair;
  };
  for (let row = 0; row < labels.length; row += width) {
    for (let i = row + 1; i < row + width; i++) add(labels[i - 1]!, labels[i]!);
    if (row) for (let i = row; i < row + width; i++) add(labels[i - width]!, labels[i]!);
  }
  return unique(pairs.subarray(0, count));
}

const unique = (numbers: Float64Array): Float64Array =>
  numbers.sort().filter((number, i) => number !== numbers[i - 1]);
