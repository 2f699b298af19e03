/** What a `.kcgs` file holds: the one interface between decoder and renderer. `index.ts` makes scenes from bytes. */

export interface Scene {
  readonly height: number; // pixels
  readonly width: number;
  readonly channels: number; // numbers of a colour: 1 grey, 3 RGB; others as the file has them
  readonly count: number; // N
  readonly means: Float32Array; // N x 2, x then y; pixel centres are at +0.5
  readonly cholesky: Float32Array; // N x 3: l11, l21, l22
  readonly colors: Float32Array; // N x channels
  readonly positions: Int32Array | null; // N: the region of each Gaussian, a position among `regions.ids`; null: no map
  readonly regions: RegionMap | null;
  readonly layers: number; // whole layers that were read
  readonly complete: boolean; // whether these are all layers of the file
}

export interface RegionMap {
  readonly labels: Int32Array; // H x W, row by row: positions among `ids`, not ids
  readonly ids: Float64Array; // of the regions, rising; those above 2**53 are rounded
  readonly softness: number | null; // the one width of all contours in pixels; null where pairs differ
  readonly pairs: ContourWidth[]; // [] with one width
}

/** The width in pixels of the contour between two regions, positions a < b. */
export interface ContourWidth {
  readonly a: number;
  readonly b: number;
  readonly width: number;
}

/** Bytes that are damaged, that end early, or that are no such file; `partial` is the scene of the whole layers. */
export class DecodeError extends Error {
  override readonly name = "DecodeError";

  constructor(
    message: string,
    readonly partial: Scene | null = null,
  ) {
    super(message);
  }
}
