/** Scenes from `.kcgs` files; `labels.ts` beside it reads those that are label maps. */

export { decode, type ExactScene, ProgressiveDecoder } from "./progressive.ts";
export { type ContourWidth, DecodeError, type RegionMap, type Scene } from "./scene.ts";
