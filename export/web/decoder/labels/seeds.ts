/** Which pixels are seeds, by how many lie in the halves of ever smaller blocks (docs/format.md, "Seeds"). */

import { AdaptiveBit } from "../models/adaptive_bit.ts";
import type { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";

interface Block {
  readonly y: number;
  readonly x: number;
  readonly height: number;
  readonly width: number;
  readonly seeds: number;
}

/** Return 1 for each seed, row by row. */
export function readSeeds(decoder: RangeDecoder, height: number, width: number): Uint8Array {
  const size = height * width;
  const seeds = decoder.unbounded();
  if (seeds > size) throw new DecodeError(`data must mark at most ${size} pixels; got ${seeds}`);
  const marks = new Uint8Array(size);
  const extreme = Array.from({ length: 8 }, () => new AdaptiveBit());
  const waiting: Block[] = [{ y: 0, x: 0, height, width, seeds: Number(seeds) }];
  for (let block = waiting.pop(); block; block = waiting.pop()) {
    const { y, x } = block;
    const area = block.height * block.width;
    if (block.seeds === 0) continue;
    if (block.seeds === area)
      for (let row = y; row < y + block.height; row++) marks.fill(1, row * width + x, row * width + x + block.width);
    else if (block.seeds === 1) {
      const place = decoder.number(area);
      if (place >= area) throw new DecodeError("data must mark pixels of the map");
      marks[(y + Math.floor(place / block.width)) * width + x + (place % block.width)] = 1;
    } else {
      const [first, second] = halves(block);
      const level = Math.min(Math.floor(Math.log2(block.seeds)) - 1, 7);
      const inside = readCount(decoder, block.seeds, first, second, extreme[level]!);
      waiting.push({ ...first, seeds: inside }, { ...second, seeds: block.seeds - inside });
    }
  }
  return marks;
}

/** Cut across the longer side; the first half is the smaller. */
function halves(block: Block): [Block, Block] {
  const { y, x, height, width } = block;
  if (height >= width) {
    const above = height >> 1;
    return [
      { ...block, height: above },
      { ...block, y: y + above, height: height - above },
    ];
  }
  const left = width >> 1;
  return [
    { ...block, width: left },
    { ...block, x: x + left, width: width - left },
  ];
}

/** Read how many of the seeds are in the first half. */
function readCount(decoder: RangeDecoder, seeds: number, first: Block, second: Block, extreme: AdaptiveBit): number {
  const low = Math.max(0, seeds - second.height * second.width);
  const high = Math.min(seeds, first.height * first.width);
  if (low === high) return low;
  if (high - low < 2 || extreme.read(decoder)) return decoder.fair() ? high : low;
  const count = low + 1 + decoder.number(high - low - 1);
  if (count >= high) throw new DecodeError("data must mark pixels of the map");
  return count;
}
