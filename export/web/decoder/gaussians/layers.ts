/** The stream of a layer (docs/format.md); models go on from layer to layer. */

import { AdaptiveAngle } from "../models/adaptive_angle.ts";
import { AdaptiveMagnitude } from "../models/adaptive_magnitude.ts";
import { AdaptiveNumber } from "../models/adaptive_number.ts";
import { AdaptiveSymbol } from "../models/adaptive_symbol.ts";
import { type Cells, Occupancy } from "../models/occupancy.ts";
import { exp2 } from "../exact.ts";
import { ENERGIES, type Header } from "../header.ts";
import { startProgram } from "../program.ts";
import { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import { angles, MIN_SIZE, MAX_SIZE, OCTAVES, places, Quantizer, restoreColor, restoreShape, type Steps } from "./quantizer.ts";
import { ANGLES, COUNTS, SHAPES, STRAYS } from "./weights.ts";

const CLASSES = 64; // of size, that a stream may name
const FAINT = 0.35;
const STRONG = 0.8;
const LEVELS = 8; // of size within a class
// what follows a group of Gaussians
const END = 0;
const HOLDS = 1; // the next energy

/** Gaussians of one energy; `regions` are positions among the ids of the map, null without a map. */
export interface Group {
  readonly count: number;
  readonly means: Float32Array;
  readonly cholesky: Float32Array;
  readonly colors: Float32Array;
  readonly regions: Int32Array | null;
}

export class LayerDecoder {
  private readonly quantizer: Quantizer;
  private readonly counts = new AdaptiveNumber(COUNTS);
  private readonly occupancy: Occupancy;
  private readonly ratio = new AdaptiveMagnitude(SHAPES.ratio);
  private readonly colors = [SHAPES.grey, SHAPES.hue, SHAPES.hue2].map((shapes) => new AdaptiveMagnitude(shapes));
  private readonly angle = new AdaptiveAngle(ANGLES);
  private readonly strays = new AdaptiveSymbol(STRAYS);
  private readonly program = startProgram();

  constructor(
    private readonly header: Header,
    private readonly labels: Int32Array | null, // the region of each pixel, row by row
  ) {
    const { quantizationParameter, height, width } = header;
    this.quantizer = new Quantizer(quantizationParameter, height, width);
    this.occupancy = new Occupancy(height, width);
  }

  /** Read a layer, whose highest energy is given, of at most so many Gaussians. */
  read(bytes: Uint8Array, energy: number, limit: number): Group[] {
    const decoder = new RangeDecoder(bytes, this.program);
    const groups: Group[] = [];
    let remaining = limit;
    for (let follows = HOLDS; follows !== END; energy--) {
      if (energy < ENERGIES.min)
        throw new DecodeError(`a class of energy must be at least ${ENERGIES.min}; got ${energy}`);
      if (follows === HOLDS) {
        const group = this.readGroup(decoder, energy, remaining);
        groups.push(group);
        remaining -= group.count;
      }
      follows = decoder.uniform(3);
    }
    return groups;
  }

  private readGroup(decoder: RangeDecoder, energy: number, limit: number): Group {
    const steps = this.quantizer.steps(energy);
    const classes = this.readClasses(decoder, limit);
    const count = classes.reduce((sum, { cells }) => sum + cells.row.length, 0);
    const scale = new Int32Array(count).map(() => decoder.uniform(steps.scales));
    const ratio = this.ratio.read(decoder, [2 / steps.ratio], new Uint8Array(count), this.ratioContexts(classes, count));
    const excess = ratio.find((steep) => steep > steps.mostRatio);
    if (excess !== undefined) throw new DecodeError(`a ratio must be at most ${steps.mostRatio} steps; got ${excess}`);
    const turns = ratio.map((steep) => angles(steps, steep));
    const angle = this.angle.read(decoder, turns);
    const codes = this.readColors(decoder, steps, scale);
    const shape = new Float64Array(3 * count);
    const colors = new Float32Array(codes.length);
    let n = 0;
    for (const { size, cells } of classes) {
      const step = this.quantizer.colorStep(size);
      for (const end = n + cells.row.length; n < end; n++) {
        restoreShape(steps, size, scale[n]!, ratio[n]!, angle[n]! / turns[n]!, shape, 3 * n);
        restoreColor(codes, this.header.channels, step, colors, this.header.channels * n);
      }
    }
    const means = new Float32Array(2 * count);
    for (const axis of [0, 1] as const) readMeans(decoder, steps, classes, shape, axis, means);
    const regions = this.labels && this.readRegions(decoder, means, this.labels);
    return { count, means, cholesky: Float32Array.from(shape), colors, regions };
  }

  /** Read the classes of size, falling, and the cells of their Gaussians. */
  private readClasses(decoder: RangeDecoder, limit: number): Class[] {
    const first = decoder.uniform(CLASSES);
    const last = first + decoder.uniform(CLASSES - first);
    const counts: { size: number; count: number }[] = [];
    let total = 0;
    for (let position = first; position <= last; position++) {
      const count = this.counts.read(decoder);
      total += count;
      if (count) counts.unshift({ size: position + MIN_SIZE, count });
    }
    if (total > limit) throw new DecodeError(`a layer must hold at most ${limit} Gaussians; got ${total}`);
    const largest = counts[0];
    if (!largest) throw new DecodeError("a layer must hold Gaussians; got none");
    if (largest.size > MAX_SIZE)
      throw new DecodeError(`a class of size must be at most ${MAX_SIZE}; got ${largest.size}`);
    return counts.map(({ size, count }) => ({ size, cells: this.occupancy.read(decoder, size, count) }));
  }

  private ratioContexts(classes: readonly Class[], count: number): Uint8Array {
    const contexts = new Uint8Array(count);
    let n = 0;
    for (const { size, cells } of classes) {
      const end = n + cells.row.length;
      contexts.fill(Math.min(Math.max(size + 1, 0), 7), n, end);
      n = end;
    }
    return contexts;
  }

  private readColors(decoder: RangeDecoder, { loud, scales }: Steps, scale: Int32Array): Int32Array {
    const { channels } = this.header;
    const count = scale.length;
    const levels = Uint8Array.from(scale, (place) => Math.floor((LEVELS * place + LEVELS / 2) / scales));
    const measures = Array.from({ length: LEVELS }, (_, v) => loud * exp2(OCTAVES * (0.5 - (v + 0.5) / LEVELS)));
    const codes = new Int32Array(channels * count);
    const contexts = new Uint8Array(count);
    for (let channel = 0; channel < channels; channel++) {
      const sizes = this.colors[Math.min(channel, 2)]!.read(decoder, measures, levels, contexts);
      for (let n = 0; n < count; n++) {
        const size = sizes[n]!;
        codes[channels * n + channel] = size && decoder.uniform(2) ? -size : size;
        const measure = measures[levels[n]!]!;
        contexts[n] = size > STRONG * measure ? 2 : size > FAINT * measure ? 1 : 0;
      }
    }
    return codes;
  }

  /** Read the region of each Gaussian: that under its centre, or another. */
  private readRegions(decoder: RangeDecoder, means: Float32Array, labels: Int32Array): Int32Array {
    const { height, width, regions } = this.header;
    const strays = this.strays.read(decoder, means.length / 2);
    return strays.map((stray, n) => {
      const x = Math.min(Math.max(Math.floor(means[2 * n]!), 0), width - 1);
      const y = Math.min(Math.max(Math.floor(means[2 * n + 1]!), 0), height - 1);
      const under = labels[y * width + x]!;
      return stray ? (under + 1 + decoder.uniform(regions - 1)) % regions : under;
    });
  }
}

interface Class {
  readonly size: number;
  readonly cells: Cells;
}

/** Read the places along an axis, 0 for x, within the cells. */
function readMeans(
  decoder: RangeDecoder,
  steps: Steps,
  classes: readonly Class[],
  shape: Float64Array,
  axis: 0 | 1,
  means: Float32Array,
): void {
  let n = 0;
  for (const { cells } of classes) {
    const { side } = cells;
    for (const cell of axis ? cells.row : cells.column) {
      const count = places(steps, side, shape[3 * n + 2 * axis]!);
      means[2 * n + axis] = side * (cell + (decoder.uniform(count) + 0.5) / count);
      n++;
    }
  }
}
