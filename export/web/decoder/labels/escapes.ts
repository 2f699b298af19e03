/** Labels of seeds, and of pixels that have neither candidate (docs/format.md, "Pixels"). */

import { AdaptiveBit } from "../models/adaptive_bit.ts";
import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import type { Margins } from "./margins.ts";

const MOST = 2 ** 18; // more take minutes
const RANKS = 3;
const FAR = 32;

class Models {
  readonly fresh = new AdaptiveBit();
  readonly rank = Array.from({ length: RANKS }, () => new AdaptiveBit());
}

export class Escapes {
  private met = 1;
  private count = 0;
  private readonly seeds = new Models();
  private readonly others = new Models();

  constructor(
    private readonly decoder: RangeDecoder,
    private readonly margins: Margins,
    private readonly regions: number,
  ) {}

  /** Read the label of pixel (x, y) with these candidates; a seed has one, and -1. */
  read(y: number, x: number, first: number, second: number): number {
    if (++this.count > MOST)
      throw new DecodeError(`data must hold at most ${MOST} labels that no neighbour has; got more`);
    const models = second < 0 ? this.seeds : this.others;
    if (this.met < this.regions && models.fresh.read(this.decoder)) return this.met++;
    let rank = 0;
    for (const label of this.nearest(y, x, first, second)) if (models.rank[rank++]!.read(this.decoder)) return label;
    return this.decoder.number(this.met);
  }

  /** List up to three labels other than the candidates, by distance from a pixel. */
  private nearest(y: number, x: number, first: number, second: number): number[] {
    const { labels, stride } = this.margins;
    const found: number[] = [];
    for (let radius = 1; radius <= FAR; radius++)
      for (let dy = -Math.min(radius, y); dy <= 0; dy++) {
        const step = dy === -radius ? 1 : 2 * radius;
        for (let dx = -radius; dx <= radius && dx < -8 * dy; dx += step) {
          if (x + dx < 0 || x + dx >= stride) continue;
          const label = labels[(y + dy) * stride + x + dx]!;
          if (label === first || label === second || found.includes(label)) continue;
          if (found.push(label) === RANKS) return found;
        }
      }
    return found;
  }
}
