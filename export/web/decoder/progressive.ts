/** A scene from bytes as they arrive. */

import { ByteReader, EndOfBytes } from "./bytes.ts";
import { crc16 } from "./checksums.ts";
import { LayerDecoder } from "./gaussians/layers.ts";
import { GrowingArray } from "./growing_array.ts";
import { type Header, mostGaussians, readHeader } from "./header.ts";
import { readRegionMap } from "./region_map.ts";
import { DecodeError, type RegionMap, type Scene } from "./scene.ts";

const SPARE = 64; // Gaussians that a layer of no bytes may hold

/** What the first bytes of a file have given. */
interface Opened {
  readonly header: Header;
  readonly regions: RegionMap | null;
  readonly layers: LayerDecoder;
}

export class ProgressiveDecoder {
  private readonly bytes = new GrowingArray<Uint8Array>(new Uint8Array(0));
  private opened: Opened | null = null;
  private position = 0; // of the next layer
  private layers = 0;
  private count = 0;
  private readonly means = new GrowingArray<Float32Array>(new Float32Array(0));
  private readonly cholesky = new GrowingArray<Float32Array>(new Float32Array(0));
  private readonly colors = new GrowingArray<Float32Array>(new Float32Array(0));
  private readonly regions = new GrowingArray<Int32Array>(new Int32Array(0));
  private scene: Scene | null = null;
  /** What was wrong with the bytes so far; what follows is not read. */
  error: DecodeError | null = null;

  /** Take the next bytes; return the scene of all whole layers if new ones became whole. */
  push(bytes: Uint8Array): Scene | null {
    if (this.error) return null;
    this.bytes.add(bytes);
    const before = this.layers;
    let damage: DecodeError | null = null;
    try {
      this.readOn();
    } catch (error) {
      damage = damageOf(error);
    }
    const hasNewLayers = this.layers > before;
    if (hasNewLayers) this.scene = this.makeScene();
    if (damage) this.error = new DecodeError(damage.message, this.scene);
    return hasNewLayers ? this.scene : null;
  }

  /** End the file; a DecodeError if it was damaged, or too short to be whole. */
  finish(): Scene {
    if (this.error) throw this.error;
    if (!this.scene) throw new EndOfBytes(`the file ends early: ${this.bytes.length} bytes hold no layer`);
    if (!this.scene.complete) {
      const all = this.opened!.header.layers.length;
      throw new EndOfBytes(`the file ends early, with ${this.layers} of ${all} layers`, this.scene);
    }
    return this.scene;
  }

  /** Read as far as the bytes go. */
  private readOn(): void {
    const data = this.bytes.all();
    const { header, layers } = (this.opened ??= this.open(data));
    while (this.layers < header.layers.length) {
      const { energy, bytes } = header.layers[this.layers]!;
      const reader = new ByteReader(data.subarray(this.position), EndOfBytes);
      const layer = reader.take(bytes);
      if (reader.number(2) !== crc16(layer)) {
        const sound = this.layers ? `; its first ${this.position} bytes are sound` : "";
        throw new DecodeError(`the file is damaged: the checksum of its layer ${this.layers + 1} is wrong${sound}`);
      }
      // each Gaussian takes more than a bit, and all must fit into memory
      const limit = Math.min(8 * bytes + SPARE, mostGaussians(header.channels) - this.count);
      for (const group of layers.read(layer, energy, limit)) {
        this.means.add(group.means);
        this.cholesky.add(group.cholesky);
        this.colors.add(group.colors);
        if (group.regions) this.regions.add(group.regions);
        this.count += group.count;
      }
      this.position += bytes + 2;
      this.layers++;
    }
    if (data.length > this.position)
      throw new DecodeError(`the file must end after ${this.position} bytes; got ${data.length}`);
  }

  private open(data: Uint8Array): Opened {
    const reader = new ByteReader(data, EndOfBytes);
    const { header, map } = readHeader(reader);
    this.position = reader.position;
    const regions = header.regions > 1 ? readRegionMap(map, header) : null;
    return { header, regions, layers: new LayerDecoder(header, regions && regions.labels) };
  }

  private makeScene(): Scene {
    const { header, regions } = this.opened!;
    const { height, width, channels } = header;
    return {
      height,
      width,
      channels,
      count: this.count,
      means: this.means.all().slice(),
      cholesky: this.cholesky.all().slice(),
      colors: this.colors.all().slice(),
      positions: regions && this.regions.all().slice(),
      regions,
      layers: this.layers,
      complete: this.layers === header.layers.length,
    };
  }
}

/** What is wrong with bytes that cannot be read, null if there are only too few of them. */
function damageOf(error: unknown): DecodeError | null {
  if (error instanceof EndOfBytes) return null;
  if (error instanceof RangeError) return new DecodeError(`the scene needs more memory than there is: ${error.message}`);
  if (error instanceof DecodeError) return error;
  throw error;
}

/** Read a file, or the coarser scene that its first bytes hold; a DecodeError on damage. */
export function decode(bytes: Uint8Array): Scene {
  const decoder = new ProgressiveDecoder();
  const scene = decoder.push(bytes);
  return scene && !decoder.error ? scene : decoder.finish();
}
