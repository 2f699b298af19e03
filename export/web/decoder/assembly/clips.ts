// What clips need: the range coder, the cells of Gaussians, and label maps that follow (docs/format.md).

export { allot } from "./memory";
export { cells, openEarlier, readCells, readNear } from "./occupancy";
export { angleBin, categorical, open, prepare, uniform, weights } from "./range_decoder";
export { follow, openFollowing } from "./following";
export { areas, labels, measure, predict } from "./moving";
