// The chance of a decision: the network and three counters, mixed (docs/format.md, "Probabilities of a pixel").

import { allot } from "./memory";
import { CLIP, mixer } from "./network";

const SURE: i32 = 16; // least chance, in 1/65536
const HEAVIEST: i32 = 1 << 22;
const MEMORY: i32 = 40; // decisions that a counter remembers

let squashed: usize = 0; // [2 CLIP + 1] i32, for x from -CLIP on
let stretched: usize = 0; // [4096] i32

export function openTables(squash: usize, stretch: usize): void {
  squashed = squash;
  stretched = stretch;
}

// @ts-ignore: decorator
@inline
function squash(x: i32): i32 {
  return load<i32>(squashed + 4 * (min(max(x, -CLIP), CLIP) + CLIP));
}

/** A question about a pixel, as it was coded. */
@unmanaged
class Question {
  x0: i32;
  x1: i32;
  x2: i32;
  x3: i32;
  first: usize; // counters: a chance, u16, and an age, u16
  second: usize;
  third: usize;
  weights: usize;
  chance: i32;
}

/** One of the two decisions about pixels, and its questions in a wavefront. */
@unmanaged
export class Decision {
  counters: usize;
  weights: usize; // [4, 4] i32
  questions: usize;

  /** `counters`: in all three tables; `most`: questions in a wavefront. */
  static of(counters: usize, count: usize): Decision {
    const decision = changetype<Decision>(allot(offsetof<Decision>()));
    decision.counters = allot(4 * counters);
    decision.weights = allot(64);
    for (let set: usize = 0; set < 64; set += 16) memory.copy(decision.weights + set, mixer, 16);
    decision.questions = allot(offsetof<Question>() * count);
    return decision;
  }

  private question(n: usize): Question {
    return changetype<Question>(this.questions + n * offsetof<Question>());
  }

  /** Prepare a question by the network's logit and the places of its three counters. */
  prepare(n: usize, logit: i32, first: usize, second: usize, third: usize): void {
    const question = this.question(n);
    question.first = this.counters + 4 * first;
    question.second = this.counters + 4 * second;
    question.third = this.counters + 4 * third;
    question.x0 = logit;
    question.x1 = estimate(question.first, logit);
    question.x2 = estimate(question.second, logit);
    question.x3 = estimate(question.third, logit);
    const age = load<u16>(question.third + 2);
    const weights = this.weights + (age === 0 ? 0 : age < 5 ? 16 : age < 12 ? 32 : 48);
    const total =
      <i64>load<i32>(weights) * question.x0 +
      <i64>load<i32>(weights + 4) * question.x1 +
      <i64>load<i32>(weights + 8) * question.x2 +
      <i64>load<i32>(weights + 12) * question.x3;
    question.weights = weights;
    question.chance = min(max(squash(<i32>(total >> 16)), SURE), 65536 - SURE);
  }

  /** The chance of a 1, in 1/65536. */
  chance(n: usize): i32 {
    return this.question(n).chance;
  }

  /** Move the weights along the error, and the counters to the bit. */
  learn(n: usize, bit: i32): void {
    const question = this.question(n);
    const error = (bit << 16) - question.chance;
    move(question.weights, question.x0, error);
    move(question.weights + 4, question.x1, error);
    move(question.weights + 8, question.x2, error);
    move(question.weights + 12, question.x3, error);
    remember(question.first, bit, question.x0);
    remember(question.second, bit, question.x0);
    remember(question.third, bit, question.x0);
  }
}

// @ts-ignore: decorator
@inline
function estimate(counter: usize, logit: i32): i32 {
  return load<u16>(counter + 2) ? load<i32>(stretched + 4 * (load<u16>(counter) >> 4)) : logit;
}

// @ts-ignore: decorator
@inline
function move(weight: usize, x: i32, error: i32): void {
  const updated = load<i32>(weight) + ((6 * x * error + (1 << 17)) >> 18);
  store<i32>(weight, min(max(updated, -HEAVIEST), HEAVIEST));
}

function remember(counter: usize, bit: i32, logit: i32): void {
  let chance = <i32>load<u16>(counter);
  let age = <i32>load<u16>(counter + 2);
  if (age === 0) {
    chance = squash(logit);
    age = 2;
  }
  const away = 2 * ((bit << 16) - chance);
  const part = 2 * age + 3;
  // rounded down, also below zero
  chance += away >= 0 ? away / part : -((part - 1 - away) / part);
  store<u16>(counter, <u16>min(max(chance, 32), 65504));
  store<u16>(counter + 2, <u16>min(age + 1, MEMORY));
}
