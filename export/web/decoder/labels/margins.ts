/** Labels of a map with room around it for the pixels outside that have labels too (docs/format.md, "The wavefront"). */

export const LEFT = 8;
export const RIGHT = 9;
export const TOP = 6;
const AHEAD = 128; // pixels that a row is written at a time: to its end, a change would cost its width

/** Rows continue with their last label, so that only pixels near contours are looked at. */
export class Margins {
  readonly stride: number;
  readonly labels: Int32Array;
  private readonly ends: Int32Array; // how far each row is written

  constructor(
    readonly height: number,
    readonly width: number,
  ) {
    this.stride = width + LEFT + RIGHT;
    this.labels = new Int32Array((height + TOP + 1) * this.stride);
    this.ends = new Int32Array(height + TOP + 1);
  }

  /** Write the label of row `y` from column `x` on. */
  continue(y: number, x: number, label: number): void {
    const row = y * this.stride;
    const end = x + AHEAD;
    this.labels.fill(label, row + x, row + Math.min(end, this.stride));
    this.ends[y] = end;
  }

  /** Continue a row with its last label where a wavefront at column `x` would look beyond what is written. */
  reach(y: number, x: number): void {
    if (x + RIGHT >= this.ends[y]!) this.continue(y, x, this.labels[y * this.stride + x - 1]!);
  }

  /** Repeat the label of a pixel above and at the left of the map. */
  repeat(y: number, x: number, label: number): void {
    if (y === TOP)
      for (let row = 0; row < TOP; row++) this.labels.fill(label, row * this.stride + x, row * this.stride + x + RIGHT + 1);
    if (x === LEFT) this.labels.fill(label, (y + 1) * this.stride, (y + 1) * this.stride + LEFT);
  }

  /** Whether the neighbours of a pixel that come before it have one label. */
  quiet(y: number, x: number): boolean {
    const { labels, stride } = this;
    const at = y * stride + x;
    const label = labels[at - 1]!;
    for (let i = at - stride - 2; i < at - stride + 8; i++) if (labels[i] !== label) return false;
    for (let i = at - 2 * stride - 1; i < at - 2 * stride + 4; i++) if (labels[i] !== label) return false;
    return labels[at - 2] === label;
  }

  /** The labels of the map alone, row by row; nothing else is left. */
  strip(): Int32Array {
    for (let y = 0; y < this.height; y++) {
      const row = (y + TOP) * this.stride + LEFT;
      this.labels.copyWithin(y * this.width, row, row + this.width);
    }
    return this.labels.subarray(0, this.height * this.width);
  }
}
