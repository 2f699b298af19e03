/** Antialiased labels: a smooth curve through a contour cuts the pixels beside it. As kcgs/maps/antialiasing.py. */

/** What each pixel is of: its own label, and that of one neighbour. */
export interface SmoothLabels {
  readonly weight: Float32Array; // of its own label
  readonly other: Int32Array;
  readonly otherWeight: Float32Array;
}

// pixels along a straight piece of contour within which its ends are looked for
const SEARCH = 32;
// sixteenths that the weight of a line one pixel wide and that of its surroundings add up to
const LINE_SUM = 21.6;
// sixteenths of a pixel's surroundings: a line one pixel wide has no more of its own label
const LINE = 8;

type Read = (along: number, across: number) => number;

/** Antialias labels; lines one pixel wide get a larger weight where their contours are sharp. */
export function antialias(labels: Int32Array, width: number, height: number, isSharp: (pixel: number) => boolean): SmoothLabels {
  const place = (x: number, y: number): number =>
    Math.min(Math.max(y, 0), height - 1) * width + Math.min(Math.max(x, 0), width - 1);
  const weight = new Float32Array(labels.length).fill(1);
  const other = labels.slice();
  const otherWeight = new Float32Array(labels.length);
  const take = (pixel: number, neighbour: number, share: number): void => {
    if (share <= otherWeight[pixel]!) return;
    otherWeight[pixel] = share;
    other[pixel] = labels[neighbour]!;
  };
  for (const [length, lines, at] of [
    [width, height, place],
    [height, width, (along: number, across: number) => place(across, along)],
  ] as const) {
    const read: Read = (along, across) => labels[at(along, across)]!;
    for (let line = 1; line < lines; line++) {
      for (let start = 0, end = 1; start < length; start = end++) {
        const [own, above] = [read(start, line), read(start, line - 1)];
        while (end < length && read(end, line) === own && read(end, line - 1) === above) end++;
        if (own === above) continue;
        const first = start === 0 ? 0 : step(read, start, -1, line);
        const last = end === length ? 0 : step(read, end - 1, 1, line);
        for (let i = start; i < end; i++) {
          const left = start > 0 && i - start < SEARCH ? i - start : SEARCH;
          const right = end < length && end - 1 - i < SEARCH ? end - 1 - i : SEARCH;
          const [a, b] = [left < SEARCH ? first : 0, right < SEARCH ? last : 0];
          const position = (right - left) / (left + right + 1);
          const rise = ((a - b) * position + (a + b) * position ** 2) / 4;
          if (rise > 0) take(at(i, line - 1), at(i, line), rise);
          else take(at(i, line), at(i, line - 1), -rise);
        }
      }
    }
  }
  for (let y = 0, pixel = 0; y < height; y++) {
    for (let x = 0; x < width; x++, pixel++) {
      let own = 0;
      for (let i = -1; i <= 1; i++) {
        for (let j = -1; j <= 1; j++) if (labels[place(x + i, y + j)] === labels[pixel]) own += (2 - i * i) * (2 - j * j);
      }
      const gain = own <= LINE && isSharp(pixel) ? LINE_SUM / own - 1 : 1;
      weight[pixel] = (1 - otherWeight[pixel]!) * gain;
    }
  }
  return { weight, other, otherWeight };
}

/** Whether the contour above a pixel goes on one pixel higher, 1, or lower, -1, towards a side; 0: neither. */
function step(read: Read, i: number, side: number, line: number): number {
  const [own, above] = [read(i, line), read(i, line - 1)];
  const [next, nextAbove] = [read(i + side, line), read(i + side, line - 1)];
  if (next !== nextAbove) return 0;
  if (next === own) return read(i + side, line - 2) === own && read(i, line - 2) === above ? 0 : 1;
  if (next === above) return read(i + side, line + 1) === above && read(i, line + 1) === own ? 0 : -1;
  return 0;
}
