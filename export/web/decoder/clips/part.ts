/** A key frame and those that are carried on from it (docs/format.md, "The stream of a carried frame"). */

import { ByteReader } from "../bytes.ts";
import { exp2 } from "../exact.ts";
import { type Group, LayerDecoder } from "../gaussians/layers.ts";
import { ENERGIES, mostGaussians, PARAMETERS } from "../header.ts";
import { AdaptiveNumber } from "../models/adaptive_number.ts";
import { AdaptiveSymbols } from "../models/adaptive_symbols.ts";
import type { ExactScene } from "../progressive.ts";
import { RangeDecoder } from "../range_decoder.ts";
import { DecodeError } from "../scene.ts";
import { activityOf, DifferenceDecoder, Differences, NEW } from "./differences.ts";
import { FollowingLabels } from "./following.ts";
import { MotionDecoder, moveGaussians, type Numbers } from "./motions.ts";
import { startClipProgram } from "./program.ts";

const VERSION = 3; // of layers
const SHIFTED = 64; // energies are from -64 on
const GONE = [0, 0, 0, 0, 1, 1, 1, 1].map((outside) => (outside ? [3, 1] : [40, 1]));
// standard deviations and factors in pixels, centres and colours, that can be rendered; in float32, as they are stored
const LEAST_SIGMA = Math.fround(1e-3);
const MOST = { factor: 1e7, mean: 1e8, color: Math.fround(1e12) };

/** A frame, in the order of the file. */
export interface Frame extends Numbers<Float32Array> {
  readonly regions: Int32Array; // N, positions among the ids of the part
  readonly keys: Int32Array; // N, each Gaussian's own in all frames that have it
  readonly labels: Int32Array | null; // positions, row by row
}

export class ClipPart {
  frame: Frame;
  nextKey: number;
  private readonly program = startClipProgram();
  private readonly motions: MotionDecoder;
  private readonly labels: FollowingLabels | null;
  private readonly gone = new AdaptiveSymbols(GONE, 2000);
  private readonly births = new AdaptiveNumber([2, ...Array<number>(20).fill(1)]);
  private readonly differences: DifferenceDecoder;
  private readonly ids: number;
  private activity: Uint8Array;

  /** `first`: the key of the first Gaussian; keys go on from there. */
  constructor(
    readonly still: ExactScene,
    first: number,
  ) {
    const { height, width, count, means, cholesky, colors, positions, regions } = still;
    if (regions !== null && regions.supersample > 1)
      throw new DecodeError(`regions of a clip must have one label for each pixel; got ${regions.supersample}**2`);
    const labels = regions && regions.labels;
    const keys = new Int32Array(count).map((_, n) => first + n);
    this.frame = { means, cholesky, colors, regions: positions ?? new Int32Array(count), keys, labels };
    this.nextKey = first + count;
    this.activity = new Uint8Array(count).fill(NEW);
    this.ids = regions === null ? 1 : regions.ids.length;
    this.motions = new MotionDecoder(this.ids, height, width);
    this.labels = labels && new FollowingLabels(this.program, labels, height, width, this.ids);
    this.differences = new DifferenceDecoder(still.channels);
  }

  /** Read the frame that follows the last one. */
  read(data: Uint8Array): void {
    const { frame, still } = this;
    const reader = new ByteReader(data);
    const qp = reader.varint("quantization parameter", 0, PARAMETERS.most - PARAMETERS.least) + PARAMETERS.least;
    const decoder = new RangeDecoder(reader.take(reader.left), this.program);
    const motions = this.motions.read(decoder);
    const labels = this.labels && this.labels.read(motions);
    const present = labels && presentIn(labels, this.ids);
    const moved = moveGaussians(frame, frame.regions, motions);
    const stay = this.readStaying(decoder, moved, present);
    const differences = new Differences(pick(moved, stay, still.channels), still.channels, exp2(-qp / 32), still.height * still.width);
    const activity = Uint8Array.from(stay, (n) => this.activity[n]!);
    const codes = this.differences.read(decoder, differences.strengths, activity);
    const carried = differences.restore(codes);
    const born = this.readBorn(decoder, qp, labels, present, stay.length);
    const gaussians = {
      means: joined(Float32Array, [carried.means, ...born.map(({ means }) => means)]),
      cholesky: joined(Float32Array, [carried.cholesky, ...born.map(({ cholesky }) => cholesky)]),
      colors: joined(Float32Array, [carried.colors, ...born.map(({ colors }) => colors)]),
    };
    check(gaussians);
    const regions = [stay.map((n) => frame.regions[n]!), ...born.map(({ regions }) => regions!)];
    const kept = stay.map((n) => frame.keys[n]!);
    const keys = new Int32Array(joined(Int32Array, regions).length - kept.length).map((_, n) => this.nextKey + n);
    this.nextKey += keys.length;
    this.activity = joined(Uint8Array, [activityOf(codes, 5 + still.channels), new Uint8Array(keys.length).fill(NEW)]);
    this.frame = {
      ...gaussians,
      regions: joined(Int32Array, regions),
      keys: joined(Int32Array, [kept, keys]),
      labels,
    };
  }

  /** Read which Gaussians stay; regions that left the image take theirs with them. */
  private readStaying(decoder: RangeDecoder, { means }: Numbers<Float64Array>, present: Uint8Array | null): Int32Array {
    const { height, width } = this.still;
    const contexts = this.activity.map((activity, n) => {
      const x = means[2 * n]!;
      const y = means[2 * n + 1]!;
      return activity + (x < 0 || y < 0 || x >= width || y >= height ? 4 : 0);
    });
    const gone = this.gone.read(decoder, contexts);
    const { regions } = this.frame;
    return Int32Array.from(gone.keys()).filter((n) => !gone[n] && (present === null || present[regions[n]!]! > 0));
  }

  private readBorn(
    decoder: RangeDecoder,
    qp: number,
    labels: Int32Array | null,
    present: Uint8Array | null,
    staying: number,
  ): Group[] {
    const { height, width, channels } = this.still;
    const count = this.births.read(decoder);
    if (count + staying === 0) throw new DecodeError("a frame must hold Gaussians; got none");
    const most = mostGaussians(channels);
    if (count + staying > most)
      throw new DecodeError(`a frame must hold at most ${most} Gaussians; got ${count + staying}`);
    if (count === 0) return [];
    const ids = present && Int32Array.from(present.keys()).filter((region) => present[region]! > 0);
    const regions = ids === null ? 1 : ids.length;
    const pixels = ids !== null && labels !== null && regions > 1 ? placesOf(labels, ids, this.ids) : null;
    const energy = decoder.uniform(128) - SHIFTED;
    if (energy < ENERGIES.least || energy > ENERGIES.most)
      throw new DecodeError(`a class of energy must be ${ENERGIES.least} to ${ENERGIES.most}; got ${energy}`);
    const header = { version: VERSION, height, width, channels, quantizationParameter: qp, regions, layers: [] };
    const groups = new LayerDecoder(header, pixels).read(decoder, energy, count);
    const found = groups.reduce((sum, group) => sum + group.count, 0);
    if (found !== count)
      throw new DecodeError(`a frame must have as many new Gaussians as it says, ${count}; got ${found}`);
    const one = ids === null ? 0 : ids[0]!;
    return groups.map((group) => ({
      ...group,
      regions: group.regions?.map((place) => ids![place]!) ?? new Int32Array(group.count).fill(one),
    }));
  }
}

/** Labels as places among the ids of regions that have pixels. */
function placesOf(labels: Int32Array, ids: Int32Array, regions: number): Int32Array {
  if (ids.length === regions) return labels;
  const places = new Int32Array(regions);
  ids.forEach((region, place) => (places[region] = place));
  const found = new Int32Array(labels.length);
  for (let i = 0; i < labels.length; i++) found[i] = places[labels[i]!]!;
  return found;
}

/** Which regions have pixels. */
function presentIn(labels: Int32Array, regions: number): Uint8Array {
  const present = new Uint8Array(regions);
  for (const label of labels) present[label] = 1;
  return present;
}

function pick({ means, cholesky, colors }: Numbers<Float64Array>, rows: Int32Array, channels: number): Numbers<Float64Array> {
  const take = (from: Float64Array, each: number): Float64Array => {
    const found = new Float64Array(each * rows.length);
    rows.forEach((row, n) => found.set(from.subarray(each * row, each * (row + 1)), each * n));
    return found;
  };
  return { means: take(means, 2), cholesky: take(cholesky, 3), colors: take(colors, channels) };
}

function joined<T extends Float32Array | Int32Array | Uint8Array>(Kind: new (length: number) => T, parts: readonly T[]): T {
  const found = new Kind(parts.reduce((length, part) => length + part.length, 0));
  let at = 0;
  for (const part of parts) {
    found.set(part, at);
    at += part.length;
  }
  return found;
}

/** Refuse numbers that cannot be rendered. */
function check({ means, cholesky, colors }: Numbers<Float32Array>): void {
  const within = (numbers: Float32Array, most: number): boolean => numbers.every((number) => Math.abs(number) < most);
  const wide = cholesky.every((number, i) => i % 3 === 1 || number > LEAST_SIGMA);
  if (!(wide && within(cholesky, MOST.factor) && within(means, MOST.mean) && within(colors, MOST.color)))
    throw new DecodeError("a frame holds Gaussians that cannot be rendered");
}
