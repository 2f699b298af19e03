/** Defines `<kcgs-image>`. */

import type { RegionClick } from "./kcgs-image.ts";
import { KcgsImage } from "./kcgs-image.ts";

export { decode, DecodeError, ProgressiveDecoder } from "../decoder/index.ts";
export type { ContourWidth, RegionMap, Scene } from "../decoder/index.ts";
export type { ImageOptions } from "./image_file.ts";
export type { Ids, RegionClick } from "./kcgs-image.ts";
export { KcgsImage };

declare global {
  interface HTMLElementEventMap {
    regionclick: CustomEvent<RegionClick>;
  }
  interface HTMLElementTagNameMap {
    "kcgs-image": KcgsImage;
  }
}

if (!customElements.get("kcgs-image")) customElements.define("kcgs-image", KcgsImage);
