/** What a pixel may be before the map is known: a small network of integers (docs/format.md, "Chances of a pixel"). */

/** Columns of each row above the pixel that the network sees, nearest row first. */
const REACH = [
  [-8, -1],
  [-8, 7],
  [-7, 8],
  [-6, 7],
  [-5, 6],
  [-3, 4],
  [-2, 3],
] as const;

export const TEMPLATE: readonly (readonly [dx: number, dy: number])[] = REACH.flatMap(([first, last], row) =>
  Array.from({ length: last - first + 1 }, (_, i) => [first + i, row ? -row : 0] as const),
).sort(([ax, ay], [bx, by]) => ax * ax + ay * ay - bx * bx - by * by || by - ay || ax - bx);

export const CLIP = 3071; // largest logit, in 1/256
const MOST = 4095; // of a unit

/** The tables of a label model, and room for one pixel. */
export class Network {
  readonly features = new Uint8Array(TEMPLATE.length);
  /** The logits of the two decisions. */
  readonly logits = new Int32Array(2);
  readonly mixer: Int32Array;
  // sums of two units share a word of 32 bits: the lower one in its low half
  private readonly layer1: Int32Array; // [T, 2, A / 2]
  private readonly bias1: Int32Array; // [A / 2]
  private readonly layer2: Int32Array; // [A, B]
  private readonly bias2: Int32Array;
  private readonly layer3: Int32Array; // [B, 2]
  private readonly bias3: Int32Array;
  private readonly hidden: Int32Array;
  private readonly latent: Int32Array;

  /** `units`: of the first and of the second layer. */
  constructor(tables: Uint8Array, units: readonly [number, number]) {
    const [hidden, latent] = units;
    const view = new DataView(tables.buffer, tables.byteOffset, tables.byteLength);
    let at = 0;
    const take = (bytes: 1 | 2 | 4, count: number): Int32Array =>
      new Int32Array(count).map(() => {
        at += bytes;
        if (bytes === 1) return view.getInt8(at - 1);
        return bytes === 2 ? view.getInt16(at - 2, true) : view.getInt32(at - 4, true);
      });
    this.layer1 = pairs(take(1, TEMPLATE.length * 2 * hidden));
    this.bias1 = pairs(take(2, hidden));
    this.layer2 = take(1, hidden * latent);
    this.bias2 = take(4, latent);
    this.layer3 = take(1, latent * 2);
    this.bias3 = take(4, 2);
    this.mixer = take(4, 4);
    this.hidden = new Int32Array(hidden / 2);
    this.latent = new Int32Array(latent);
  }

  /** Find the logits of the features. */
  evaluate(): void {
    const { features, layer1, hidden, latent, logits } = this;
    const half = hidden.length;
    hidden.set(this.bias1);
    for (let t = 0; t < features.length; t++) {
      const feature = features[t]!;
      if (feature === 0) continue;
      const row = (2 * t + feature - 1) * half;
      for (let j = 0; j < half; j++) hidden[j] = (hidden[j]! + layer1[row + j]!) | 0;
    }
    latent.set(this.bias2);
    for (let j = 0; j < half; j++) {
      const both = hidden[j]!;
      const low = (both << 16) >> 16;
      this.add(2 * j, low);
      this.add(2 * j + 1, (both - low) >> 16);
    }
    for (let h = 0; h < 2; h++) {
      let total = this.bias3[h]!;
      for (let k = 0; k < latent.length; k++)
        total += Math.min(Math.max(latent[k]! >> 6, 0), MOST) * this.layer3[2 * k + h]!;
      logits[h] = Math.min(Math.max(total >> 4, -CLIP), CLIP);
    }
  }

  /** Add what a unit of the first layer means to the second. */
  private add(unit: number, sum: number): void {
    if (sum <= 0) return;
    const value = Math.min(sum, MOST);
    const { latent, layer2 } = this;
    const row = unit * latent.length;
    for (let k = 0; k < latent.length; k++) latent[k] = (latent[k]! + value * layer2[row + k]!) | 0;
  }
}

/** Put each two numbers into one, the first in the low half. Sums of such are those of both, up to 15 bits. */
const pairs = (numbers: Int32Array): Int32Array =>
  new Int32Array(numbers.length / 2).map((_, i) => numbers[2 * i]! + 65536 * numbers[2 * i + 1]!);
