/** Clips from `.kcgs` files (docs/format.md, "The file of a clip"): scenes one after another. */

import { touchingPairs } from "../pairs.ts";
import { type ExactScene, ProgressiveDecoder } from "../progressive.ts";
import { type ContourWidth, DecodeError, type RegionMap } from "../scene.ts";
import { type Container, readContainer } from "./container.ts";
import { ClipPart } from "./part.ts";

export { isClip } from "./container.ts";
export { DecodeError } from "../scene.ts";

const FORTIETHS = 40; // of a pixel

/** A frame as a scene. All frames from one key frame on have the same ids of regions. */
export interface ClipFrame extends ExactScene {
  /** N: a Gaussian keeps its number in frames read one after another from a key frame on; a jump may give others. */
  readonly keys: Int32Array;
}

/** Scenes one after another. A frame after the last one that was read takes one step, any other those since its key frame. */
export class Clip {
  readonly size: { readonly height: number; readonly width: number };
  readonly channels: number;
  readonly frameRate: number; // frames per second
  readonly frames: number;
  readonly keyFrames: readonly number[];
  readonly complete: boolean; // false: the file ends early, and these are its whole frames
  private part: ClipPart | null = null;
  private number = -1; // of the part's frame
  private scene: ClipFrame | null = null; // the part's frame

  constructor(private readonly container: Container) {
    const { height, width, channels, rate, records, complete } = container;
    this.size = { height, width };
    this.channels = channels;
    this.frameRate = rate[0] / rate[1];
    this.frames = records.length;
    this.keyFrames = [...records.keys()].filter((number) => records[number]!.key);
    this.complete = complete;
  }

  /** Return a frame, from 0; a DecodeError if it is damaged. Its arrays are not to be changed. */
  frame(number: number): ClipFrame {
    if (!(Number.isInteger(number) && number >= 0 && number < this.frames))
      throw new RangeError(`a frame must be 0 to ${this.frames - 1}; got ${number}`);
    if (number === this.number && this.scene !== null) return this.scene;
    const key = this.keyFrames.findLast((place) => place <= number)!;
    const next = this.part !== null && key <= this.number && this.number < number ? this.number + 1 : key;
    let place = next;
    try {
      for (; place <= number; place++) this.read(place);
      const part = this.part!;
      this.scene = sceneOf(part, this.scene);
    } catch (error) {
      this.part = this.scene = null;
      this.number = -1;
      if (error instanceof RangeError)
        throw new DecodeError(`the clip needs more memory than there is: ${error.message}`);
      if (error instanceof DecodeError) error.message = `frame ${place}: ${error.message}`;
      throw error;
    }
    return this.scene;
  }

  private read(number: number): void {
    const { key, data } = this.container.records[number]!;
    if (key) this.part = new ClipPart(this.readStill(data), this.part === null ? 0 : this.part.nextKey);
    else this.part!.read(data);
    this.number = number;
  }

  private readStill(data: Uint8Array): ExactScene {
    const decoder = new ProgressiveDecoder();
    decoder.push(data);
    const still = decoder.finish();
    const { height, width } = this.size;
    if (still.height !== height || still.width !== width || still.channels !== this.channels)
      throw new DecodeError(
        `a key frame must be ${height} x ${width}, ${this.channels} channels; got ${still.height} x ${still.width}, ${still.channels}`,
      );
    return still;
  }
}

/** Read a clip; of one that ends early, its whole frames. A DecodeError if there are none, or the file is damaged. */
export function openClip(bytes: Uint8Array): Clip {
  const container = readContainer(bytes);
  if (container.records.length === 0) throw new DecodeError("the clip ends early: it holds no whole frame");
  return new Clip(container);
}

/** The last frame of a part; `before`: that which was shown before, whose map may be the same. */
function sceneOf({ still, frame }: ClipPart, before: ClipFrame | null): ClipFrame {
  const { height, width, channels, regions: first, exactIds } = still;
  const { means, cholesky, colors, regions: positions, keys, labels } = frame;
  const known = before?.regions?.labels === labels && before?.exactIds === exactIds ? before!.regions : null;
  const regions = first && labels && (known ?? withLabels(first, labels, width));
  return {
    height,
    width,
    channels,
    count: keys.length,
    means,
    cholesky,
    colors,
    regionIds: regions && Float64Array.from(positions, (position) => regions.ids[position]!),
    regions,
    layers: 1,
    complete: true,
    positions: regions && positions,
    exactIds,
    keys,
  };
}

/** The map of a frame, with the widths of the key frame's contours; pairs that touch later have the mean. */
function withLabels(first: RegionMap, labels: Int32Array, width: number): RegionMap {
  const { pairs, ids } = first;
  if (first.softness !== null) return { ...first, labels };
  const place = ({ a, b }: ContourWidth): number => a * ids.length + b;
  const widths = new Map(pairs.map((pair) => [place(pair), pair.width]));
  const sum = pairs.reduce((total, pair) => total + Math.floor(pair.width * FORTIETHS + 0.5), 0);
  const mean = Math.floor(sum / pairs.length) / FORTIETHS;
  const found = Array.from(touchingPairs(labels, width, ids.length), (pair) => ({
    a: Math.floor(pair / ids.length),
    b: pair % ids.length,
    width: widths.get(pair) ?? mean,
  }));
  const softness = found[0]?.width ?? 0;
  const one = found.every((pair) => pair.width === softness);
  return { ...first, labels, pairs: one ? [] : found, softness: one ? softness : null };
}
