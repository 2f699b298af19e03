/** What the page and its worker say to each other. */

import type { Rect } from "./view.ts";

export type Provider = "wasm" | "webgpu";

/** One picture to decode; sizes are (height, width) as everywhere in kcgs. */
export interface RenderRequest {
  size: readonly [height: number, width: number];
  view?: Rect;
  visible?: readonly number[];
}

export type Command =
  | { kind: "open"; bytes: Uint8Array; regions: number; provider: Provider }
  | { kind: "switch"; provider: Provider }
  | { kind: "frame"; request: RenderRequest }
  | { kind: "image"; request: RenderRequest };

/** Which provider runs, after what happened; `notice` is set when it is not the one asked for. */
export interface Running {
  provider: Provider;
  notice?: string;
}

export interface Opened extends Running {
  inputs: readonly string[];
}

export interface FrameResult extends Running {
  bitmap: ImageBitmap;
  milliseconds: number;
}

export interface ImageResult extends Running {
  data: Float32Array<ArrayBuffer>;
  dims: readonly number[];
  milliseconds: number;
}

export interface Results {
  open: Opened;
  switch: Running;
  frame: FrameResult;
  image: ImageResult;
}

export type Message = { id: number } & Command;
export type Reply = { id: number; result: Results[keyof Results] } | { id: number; error: string };
