/** The blur of a label map at one pixel: how much of each region lies around it. */

import type { SmoothLabels } from "./antialias.ts";
import type { Levels } from "./levels.ts";

const RADIUS_SIGMAS = 4;
/** Wide blurs are evaluated at nodes, so many to a standard deviation: bilinear between them is off by 0.001 at most. */
const NODES = 8;

interface Kernel {
  readonly reach: number; // labels
  readonly weights: Float64Array; // at distance 0, 1 ... reach
  readonly sums: Float64Array; // of the weights from -reach up to, but without, -reach + i
  readonly spacing: number; // of nodes; 1: none
  readonly nodes: Map<number, Shares>;
}

/** Regions and their weights, in no order. */
export interface Shares {
  readonly regions: number[];
  readonly weights: number[];
}

/** Sums weights by region. */
class Tally {
  private readonly sums: Float64Array;
  private regions: number[] = [];

  constructor(regions: number) {
    this.sums = new Float64Array(regions);
  }

  add(region: number, weight: number): void {
    if (this.sums[region] === 0) this.regions.push(region);
    this.sums[region]! += weight + Number.MIN_VALUE;
  }

  /** The sums; what follows begins at none. */
  take(): Shares {
    const { regions, sums } = this;
    const weights = regions.map((region) => sums[region]!);
    for (const region of regions) sums[region] = 0;
    this.regions = [];
    return { regions, weights };
  }
}

export class Blur {
  private readonly kernels: Kernel[];
  private readonly widest: number;
  private readonly runEnds: Int32Array; // where the run of equal labels in its row ends that a label lies in
  private readonly across: Int32Array; // integral image of changes along rows
  private readonly down: Int32Array; // changes along columns, from the top
  private readonly pixel: Tally;
  private readonly node: Tally;

  constructor(
    private readonly labels: Int32Array,
    private readonly width: number,
    private readonly height: number,
    regions: number,
    private readonly levels: Levels,
    private readonly smooth: SmoothLabels | null,
  ) {
    this.kernels = levels.widths.map(kernelOf);
    // antialiasing reaches one pixel farther
    this.widest = Math.max(...this.kernels.map((kernel) => kernel.reach)) + Number(smooth !== null);
    this.pixel = new Tally(regions);
    this.node = new Tally(regions);
    this.runEnds = new Int32Array(labels.length);
    this.across = new Int32Array((width + 1) * (height + 1));
    this.down = new Int32Array(labels.length);
    this.scan();
  }

  private scan(): void {
    const { labels, width, height, runEnds, across, down } = this;
    for (let y = 0; y < height; y++) {
      const row = y * width;
      for (let x = width - 1, end = width; x >= 0; x--) {
        runEnds[row + x] = end;
        if (x > 0 && labels[row + x] !== labels[row + x - 1]) end = x;
      }
      for (let x = 0, changes = 0; x < width; x++) {
        const position = row + x;
        if (x > 0 && labels[position] !== labels[position - 1]) changes++;
        across[(y + 1) * (width + 1) + x + 1] = across[y * (width + 1) + x + 1]! + changes;
        if (y > 0) down[position] = down[position - width]! + Number(labels[position] !== labels[position - width]);
      }
    }
  }

  /** Whether no contour reaches into a pixel. */
  alone(x: number, y: number): boolean {
    const { width, height, widest, across, down } = this;
    const [x0, x1] = [Math.max(0, x - widest), Math.min(width, x + 1 + widest)];
    const [y0, y1] = [Math.max(0, y - widest), Math.min(height, y + 1 + widest)];
    const [above, below] = [y0 * (width + 1), y1 * (width + 1)];
    const changes = across[below + x1]! - across[below + x0 + 1]! - across[above + x1]! + across[above + x0 + 1]!;
    return changes === 0 && down[(y1 - 1) * width + x0] === down[y0 * width + x0];
  }

  /** The weights of the regions around a pixel. */
  weigh(x: number, y: number): Shares {
    const kernel = this.kernels[this.levels.of?.[y * this.width + x] ?? 0]!;
    if (kernel.spacing === 1) this.spread(this.pixel, x, y, kernel);
    else this.interpolate(x, y, kernel);
    return this.pixel.take();
  }

  private spread(into: Tally, x: number, y: number, { reach, weights, sums }: Kernel): void {
    const { labels, width, height, runEnds } = this;
    const [x0, x1] = [Math.max(0, x - reach), Math.min(width, x + reach + 1)];
    const [y0, y1] = [Math.max(0, y - reach), Math.min(height, y + reach + 1)];
    // the weight of what lies within the map
    const whole = (sums[x1 - x + reach]! - sums[x0 - x + reach]!) * (sums[y1 - y + reach]! - sums[y0 - y + reach]!);
    for (let row = y0; row < y1; row++) {
      const factor = weights[Math.abs(row - y)]! / whole;
      for (let position = x0; position < x1; ) {
        const region = labels[row * width + position]!;
        const end = Math.min(x1, runEnds[row * width + position]!);
        into.add(region, factor * (sums[end - x + reach]! - sums[position - x + reach]!));
        position = end;
      }
      if (this.smooth !== null) this.correct(this.smooth, into, row, x0, x1, (i) => factor * weights[Math.abs(i - x)]!);
    }
  }

  /** Add what antialiased pixels of a row have more or less than their label. */
  private correct(
    { weight, other, otherWeight }: SmoothLabels,
    into: Tally,
    row: number,
    from: number,
    to: number,
    factorOf: (x: number) => number,
  ): void {
    for (let x = from, position = row * this.width + from; x < to; x++, position++) {
      if (weight[position] === 1) continue;
      into.add(this.labels[position]!, factorOf(x) * (weight[position]! - 1));
      if (otherWeight[position]! > 0) into.add(other[position]!, factorOf(x) * otherWeight[position]!);
    }
  }

  /** Add the blur at a label, from that at the four nodes around it. */
  private interpolate(x: number, y: number, kernel: Kernel): void {
    const { spacing } = kernel;
    const [column, row] = [Math.floor(x / spacing), Math.floor(y / spacing)];
    const [i, j] = [x / spacing - column, y / spacing - row];
    for (const [right, down, share] of [
      [0, 0, (1 - i) * (1 - j)],
      [1, 0, i * (1 - j)],
      [0, 1, (1 - i) * j],
      [1, 1, i * j],
    ] as const) {
      if (share === 0) continue;
      const { regions, weights } = this.blurAt(column + right, row + down, kernel);
      for (let position = 0; position < regions.length; position++) this.pixel.add(regions[position]!, share * weights[position]!);
    }
  }

  /** The blur at a node, which may lie outside the map; evaluated once. */
  private blurAt(column: number, row: number, kernel: Kernel): Shares {
    const { spacing, nodes } = kernel;
    const key = row * this.width + column;
    let shares = nodes.get(key);
    if (shares === undefined) {
      this.spread(this.node, column * spacing, row * spacing, kernel);
      shares = this.node.take();
      nodes.set(key, shares);
    }
    return shares;
  }
}

function kernelOf(sigma: number): Kernel {
  const reach = Math.ceil(RADIUS_SIGMAS * sigma);
  const weights = Float64Array.from({ length: reach + 1 }, (_, i) => (i === 0 ? 1 : Math.exp(-0.5 * (i / sigma) ** 2)));
  const sums = new Float64Array(2 * reach + 2);
  for (let i = 0; i <= 2 * reach; i++) sums[i + 1] = sums[i]! + weights[Math.abs(i - reach)]!;
  return { reach, weights, sums, spacing: Math.max(1, Math.floor(sigma / NODES)), nodes: new Map() };
}
