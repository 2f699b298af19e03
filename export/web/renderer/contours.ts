/** The regions of the pixels of an output, by rows: runs of pixels of one region, with weights along contours. */

import { sharpness, SHARED, WHOLE } from "./membership.ts";
import type { Membership } from "./membership.ts";
import { placed } from "./sampling.ts";
import type { Axis, FineAxis } from "./sampling.ts";

/** Runs sorted by region, then by row, then along the row. */
export interface Runs {
  readonly starts: Uint32Array; // the first run of each region, and their number
  readonly rows: Int32Array;
  readonly from: Int32Array;
  readonly to: Int32Array; // without
  readonly weights: Int32Array; // where the run's weights begin in `shares`; -1: all are 1
  readonly shares: Float32Array;
}

/** Find the runs of a render; `visible` says of each region whether it is wanted. */
export function runsOf(membership: Membership, across: FineAxis, down: FineAxis, visible: Uint8Array): Runs {
  const writer = new RunWriter(visible, across.count);
  const weigh = weigher(membership, across, down);
  for (let y = 0; y < down.count; y++) {
    for (let x = 0; x < across.count; x++) weigh(x, y, writer);
    writer.endRow(y);
  }
  return writer.finish();
}

type Weigh = (x: number, y: number, writer: RunWriter) => void;

/** A point has the bilinear mean of its four neighbours, raised to a power in an output of another size. */
function weigher(membership: Membership, across: FineAxis, down: FineAxis): Weigh {
  const { width, height, heads, lists, variances } = membership;
  const columns = placed(across, width);
  const rows = placed(down, height);
  const exponent = exponentOf(membership, across, down);
  const add = (writer: RunWriter, head: number, share: number): void => {
    if (head < SHARED) return writer.add(head, share);
    for (let entry = head - SHARED; lists[entry] !== 0; entry++) {
      writer.add(lists[entry]! >>> 16, (share * (lists[entry]! & 0xffff)) / WHOLE);
    }
  };
  return (x, y, writer) => {
    const [above, below] = [rows.low[y]! * width, rows.high[y]! * width];
    const [left, right] = [columns.low[x]!, columns.high[x]!];
    const first = heads[above + left]!;
    if (first < SHARED && first === heads[above + right] && first === heads[below + left]) {
      if (first === heads[below + right]) return writer.pure(first, x);
    }
    const [i, j] = [columns.share[x]!, rows.share[y]!];
    if ((1 - i) * (1 - j) > 0) add(writer, first, (1 - i) * (1 - j));
    if (i * (1 - j) > 0) add(writer, heads[above + right]!, i * (1 - j));
    if ((1 - i) * j > 0) add(writer, heads[below + left]!, (1 - i) * j);
    if (i * j > 0) add(writer, heads[below + right]!, i * j);
    if (typeof exponent !== "function") writer.place(x, exponent);
    else writer.place(x, exponent(interpolate(variances!, columns, rows, x, y, width)));
  };
}

function interpolate(cells: Float32Array, columns: Axis, rows: Axis, x: number, y: number, width: number): number {
  const [i, j, above, below] = [columns.share[x]!, rows.share[y]!, rows.low[y]! * width, rows.high[y]! * width];
  const [left, right] = [columns.low[x]!, columns.high[x]!];
  const upper = cells[above + left]! * (1 - i) + cells[above + right]! * i;
  return upper * (1 - j) + (cells[below + left]! * (1 - i) + cells[below + right]! * i) * j;
}

/** The exponent of weights between cells: a number, or one for each variance; null: weights stay as they are. */
function exponentOf(m: Membership, across: FineAxis, down: FineAxis): number | null | ((variance: number) => number) {
  const ratio = 1 / (across.step * down.step);
  if (!m.smooth) return null;
  return m.variances === null ? sharpness(m.variance, ratio) : (variance) => sharpness(variance, ratio);
}

interface Open {
  region: number;
  from: number;
  to: number;
  shares: Float32Array | null; // by column; null: a run of weights 1
}

/** Joins pixels to runs. */
class RunWriter {
  private readonly pixel = { regions: [] as number[], shares: [] as number[] };
  private open: Open[] = [];
  private readonly spare: Float32Array[] = [];
  private readonly runs: number[] = []; // region, row, from, to, place of weights
  private weights = new Float32Array(1 << 14);
  private length = 0;
  private last: Open | null = null;

  constructor(
    private readonly visible: Uint8Array,
    private readonly width: number,
  ) {}

  /** A pixel of one region. */
  pure(region: number, x: number): void {
    if (this.last !== null && this.last.region === region && this.last.to === x) {
      this.last.to++;
      return;
    }
    this.last = null;
    if (this.visible[region] === 0) return;
    this.last = { region, from: x, to: x + 1, shares: null };
    this.open.push(this.last);
  }

  /** A share of a region in the next pixel. */
  add(region: number, share: number): void {
    const { regions, shares } = this.pixel;
    const place = regions.indexOf(region);
    if (place >= 0) shares[place]! += share;
    else {
      regions.push(region);
      shares.push(share);
    }
  }

  /** End the pixel whose shares were added: raise them to a power, and let them sum to one. */
  place(x: number, exponent: number | null): void {
    const { regions, shares } = this.pixel;
    if (exponent !== null) sharpen(shares, exponent);
    if (regions.length === 1) this.pure(regions[0]!, x);
    else for (let i = 0; i < regions.length; i++) this.write(regions[i]!, x, shares[i]!);
    regions.length = shares.length = 0;
  }

  endRow(row: number): void {
    for (const { region, from, to, shares } of this.open) {
      this.runs.push(region, row, from, to, shares === null ? -1 : this.keep(shares.subarray(from, to)));
      if (shares !== null) this.spare.push(shares);
    }
    this.open = [];
    this.last = null;
  }

  finish(): Runs {
    const { runs, visible } = this;
    const count = runs.length / 5;
    const starts = new Uint32Array(visible.length + 1);
    for (let i = 0; i < count; i++) starts[runs[5 * i]! + 1]!++;
    for (let r = 0; r < visible.length; r++) starts[r + 1]! += starts[r]!;
    const next = starts.slice();
    const [rows, from, to, weights] = [1, 2, 3, 4].map(() => new Int32Array(count)) as [
      Int32Array,
      Int32Array,
      Int32Array,
      Int32Array,
    ];
    for (let i = 0; i < count; i++) {
      const entry = next[runs[5 * i]!]!++;
      rows[entry] = runs[5 * i + 1]!;
      from[entry] = runs[5 * i + 2]!;
      to[entry] = runs[5 * i + 3]!;
      weights[entry] = runs[5 * i + 4]!;
    }
    return { starts, rows, from, to, weights, shares: this.weights };
  }

  private write(region: number, x: number, share: number): void {
    if (share === 0 || this.visible[region] === 0) return;
    for (let i = this.open.length - 1; i >= 0; i--) {
      const run = this.open[i]!;
      if (run.to === x && run.region === region && run.shares !== null) {
        run.shares[x] = share;
        run.to++;
        return;
      }
    }
    const shares = this.spare.pop() ?? new Float32Array(this.width);
    shares[x] = share;
    this.open.push({ region, from: x, to: x + 1, shares });
  }

  private keep(shares: Float32Array): number {
    const start = this.length;
    this.length += shares.length;
    if (this.length > this.weights.length) {
      const larger = new Float32Array(2 * this.length);
      larger.set(this.weights);
      this.weights = larger;
    }
    this.weights.set(shares, start);
    return start;
  }
}

function sharpen(shares: number[], exponent: number): void {
  let [peak, total] = [0, 0];
  for (const share of shares) peak = Math.max(peak, share);
  for (let i = 0; i < shares.length; i++) total += shares[i] = (shares[i]! / peak) ** exponent;
  for (let i = 0; i < shares.length; i++) shares[i]! /= total;
}
