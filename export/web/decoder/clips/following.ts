/** Label maps that follow each other (docs/format.md, "Label maps that follow"); `assembly/following.ts` reads them. */

import tables from "../../../../kcgs/codec/labels/deviation.bin?packed";
import { logistic } from "../labels/pixels.ts";
import { unpack } from "../packed_text.ts";
import { put } from "../program.ts";
import { DecodeError } from "../scene.ts";
import type { ClipProgram } from "./program.ts";
import { AROUND, EARLIER } from "./template.ts";

const MIXER = Int32Array.of(46000, 7000, 7000, 8000);
const MARGIN = 5; // around the program's maps
const MOST_SHIFT = 2 ** 37;

export class FollowingLabels {
  private readonly motions: number; // where the program has them
  private readonly order: number;

  /** `labels`: the first map, positions of two or more regions. */
  constructor(
    private readonly program: ClipProgram,
    private labels: Int32Array,
    private readonly height: number,
    private readonly width: number,
    private readonly regions: number,
  ) {
    const { squash, stretch } = logistic();
    const places = put(program, Int8Array.from([...EARLIER, ...AROUND].flat()));
    const model = [put(program, unpack(tables)), places, put(program, MIXER), put(program, squash), put(program, stretch)];
    program.openFollowing(height, width, regions, ...(model as [number, number, number, number, number]));
    this.motions = program.allot(48 * regions);
    this.order = program.allot(4 * regions);
    const rows = this.rows();
    rows.forEach((row, y) => row.set(labels.subarray(y * width, (y + 1) * width)));
  }

  /** Read the next map, by the motions of all regions; it is the same array where nothing changed. */
  read(motions: Float64Array): Int32Array {
    const { program, regions, width } = this;
    for (let at = 2; at < motions.length; at += 3)
      if (Math.abs(motions[at]!) > MOST_SHIFT)
        throw new DecodeError(`shifts of motions must be within ${MOST_SHIFT}; got ${motions[at]}`);
    program.measure();
    const areas = new Int32Array(program.memory.buffer, program.areas.value, regions);
    const order = Int32Array.from(areas.keys()).filter((region) => areas[region]! > 0);
    order.sort((one, other) => areas[other]! - areas[one]! || one - other);
    new Int32Array(program.memory.buffer, this.order, regions).set(order);
    new Float64Array(program.memory.buffer, this.motions, motions.length).set(motions);
    program.predict(this.order, order.length, this.motions);
    program.follow();
    const found = new Int32Array(this.labels.length);
    this.rows().forEach((row, y) => found.set(row, y * width));
    let same = 0;
    while (same < found.length && found[same] === this.labels[same]) same++;
    if (same < found.length) this.labels = found;
    return this.labels;
  }

  private rows(): Int32Array[] {
    const { memory, labels } = this.program;
    const stride = 4 * (this.width + 2 * MARGIN);
    return Array.from({ length: this.height }, (_, y) => new Int32Array(memory.buffer, labels.value + y * stride, this.width));
  }
}
