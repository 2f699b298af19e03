// What 64-bit integers or speed need: the range coder, the cells of Gaussians, and the pixels of label maps.

import { openTables } from "./decision";
import { allot } from "./memory";
import { openNetwork } from "./network";
import { bit, uniform } from "./range_decoder";
import { readSeeds } from "./seeds";
import { readWavefronts } from "./wavefront";

export { allot } from "./memory";
export { cells, openEarlier, readNear } from "./occupancy";
export { angleBin, categorical, open, prepare, uniform, weights } from "./range_decoder";

const NOISE: i32 = 64; // chance

/** Take the label model; `groups` and `template` are places, `squash` and `stretch` functions. */
export function model(tables: usize, groups: usize, squash: usize, stretch: usize): void {
  openNetwork(tables, groups);
  openTables(squash, stretch);
}

/** How many regions the map has, of those that it may have. */
export let met: i32 = 0;

/** Return where the labels of a map are, i32, row by row: of region n `positions[n]`. */
export function readLabels(height: i32, width: i32, regions: i32, template: usize, positions: usize): usize {
  const size = <usize>height * width;
  const labels = bit(NOISE) ? readNoise(size, regions) : readMap(height, width, regions, template);
  const marks = allot(regions);
  for (let i: usize = 0; i < size; i++) {
    const region = <usize>load<u32>(labels + 4 * i);
    if (!load<u8>(marks + region)) {
      store<u8>(marks + region, 1);
      met++;
    }
    store<i32>(labels + 4 * i, load<i32>(positions + 4 * region));
  }
  return labels;
}

function readNoise(size: usize, regions: i32): usize {
  const labels = allot(4 * size);
  for (let i: usize = 0; i < size; i++) store<u32>(labels + 4 * i, uniform(regions));
  return labels;
}

function readMap(height: i32, width: i32, regions: i32, template: usize): usize {
  const seeds = allot(<usize>height * width);
  readSeeds(seeds, height, width);
  return readWavefronts(height, width, seeds, regions, template);
}
