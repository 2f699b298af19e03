/** The chance of a decision: the network and three counters, mixed (docs/format.md, "Chances of a pixel"). */

import { CLIP } from "./network.ts";

const SURE = 16; // least chance, in 1/65536
const HEAVIEST = 2 ** 22;
const MEMORY = 40; // decisions that a counter remembers

const SQUASH = new Int32Array(2 * CLIP + 1).map((_, i) => Math.round(65536 / (1 + Math.exp((CLIP - i) / 256))));
const STRETCH = new Int32Array(4096);
for (let q = 0, x = 0; q < 4096; q++) {
  while (SQUASH[x]! < 16 * q + 8) x++;
  STRETCH[q] = x - CLIP;
}

const squash = (x: number): number => SQUASH[Math.min(Math.max(x, -CLIP), CLIP) + CLIP]!;

/** Columns of a question: four estimates, three counters, the first of its weights, its chance. */
const COUNTERS = 4;
const WEIGHTS = 7;
const CHANCE = 8;
const QUESTION = 9;

/** One of the two decisions about pixels, and its questions in a wavefront. */
export class Decision {
  private readonly chances: Uint16Array;
  private readonly ages: Uint8Array;
  private readonly weights: Int32Array;
  private readonly questions: Int32Array;

  /** `counters`: in all three tables; `most`: questions in a wavefront. */
  constructor(counters: number, mixer: Int32Array, most: number) {
    this.chances = new Uint16Array(counters);
    this.ages = new Uint8Array(counters);
    this.weights = new Int32Array(16).map((_, i) => mixer[i & 3]!);
    this.questions = new Int32Array(QUESTION * most);
  }

  /** Prepare a question by the network's logit and the places of its three counters. */
  prepare(question: number, logit: number, first: number, second: number, third: number): void {
    const { questions } = this;
    const at = QUESTION * question;
    questions[at] = logit;
    questions[at + COUNTERS] = first;
    questions[at + COUNTERS + 1] = second;
    questions[at + COUNTERS + 2] = third;
    for (let i = 0; i < 3; i++) {
      const counter = questions[at + COUNTERS + i]!;
      questions[at + 1 + i] = this.ages[counter] ? STRETCH[this.chances[counter]! >> 4]! : logit;
    }
    const age = this.ages[third]!;
    const set = age === 0 ? 0 : age < 5 ? 4 : age < 12 ? 8 : 12;
    let total = 0;
    for (let i = 0; i < 4; i++) total += this.weights[set + i]! * questions[at + i]!;
    questions[at + WEIGHTS] = set;
    questions[at + CHANCE] = Math.min(Math.max(squash(Math.floor(total / 65536)), SURE), 65536 - SURE);
  }

  /** The chance of a 1, in 1/65536. */
  chance(question: number): number {
    return this.questions[QUESTION * question + CHANCE]!;
  }

  /** Move the weights along the error, and the counters to the bit. */
  learn(question: number, bit: number): void {
    const { questions, weights } = this;
    const at = QUESTION * question;
    const set = questions[at + WEIGHTS]!;
    const error = 65536 * bit - questions[at + CHANCE]!;
    for (let i = 0; i < 4; i++) {
      const weight = weights[set + i]! + ((6 * questions[at + i]! * error + 131072) >> 18);
      weights[set + i] = Math.min(Math.max(weight, -HEAVIEST), HEAVIEST);
    }
    for (let i = 0; i < 3; i++) {
      const counter = questions[at + COUNTERS + i]!;
      let chance = this.chances[counter]!;
      let age = this.ages[counter]!;
      if (age === 0) {
        chance = squash(questions[at]!);
        age = 2;
      }
      chance += Math.floor((2 * (65536 * bit - chance)) / (2 * age + 3));
      this.chances[counter] = Math.min(Math.max(chance, 32), 65504);
      this.ages[counter] = Math.min(age + 1, MEMORY);
    }
  }
}
