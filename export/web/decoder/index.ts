/** Scenes from `.kcgs` files. */

export { decode, ProgressiveDecoder } from "./progressive.ts";
export { type ContourWidth, DecodeError, type RegionMap, type Scene } from "./scene.ts";
