/** The range coder and its symbols with fixed chances (docs/format.md). */

import { DecodeError } from "./scene.ts";

const CODES = 2 ** 24;
const PART = 2 ** 24; // numbers of 64 bits are held as two parts, of 40 bits and of 24, which float64 holds exactly
const ALPHABET = 2 ** 16;

/** Turns bytes into symbols; zeros follow the last byte. */
export class RangeDecoder {
  private position = 8;
  // `point - low` of the format, in two parts; `step` is `range >> 24`, and the rest of `range` is never looked at
  private high: number;
  private low: number;
  private step = 2 ** 40 - 1;
  // what the last code left of `point - low`
  private rest = 0;

  constructor(private readonly data: Uint8Array) {
    const second = this.word(4);
    this.high = this.word(0) * 256 + (second >>> 24);
    this.low = second & 0xffffff;
  }

  /** A number of n, all equally likely, n at most 2**24. */
  uniform(n: number): number {
    if (n === 1) return 0;
    const width = (CODES / n) | 0;
    const code = this.code();
    const value = Math.min((code / width) | 0, n - 1);
    this.take(code, value * width, value === n - 1 ? CODES : (value + 1) * width);
    return value;
  }

  /** A bit that is 1 with a chance in 1/65536. */
  bit(chance: number): number {
    const border = CODES - 256 * chance;
    const code = this.code();
    if (code < border) {
      this.take(code, 0, border);
      return 0;
    }
    this.take(code, border, CODES);
    return 1;
  }

  /** A categorical symbol, by where the codes of each value begin, and their end (`beginnings`). */
  categorical(begins: Uint32Array): number {
    const code = this.code();
    let value = 0;
    let end = begins.length - 1;
    // the first values are the likely ones of short tables
    if (end <= 16) while (code >= begins[value + 1]!) value++;
    else
      while (end - value > 1) {
        const middle = (value + end) >> 1;
        if (code >= begins[middle]!) value = middle;
        else end = middle;
      }
    this.take(code, begins[value]!, begins[value + 1]!);
    return value;
  }

  /** A number of n, which may be above 16 bits; the highest part may make it n or more. */
  number(n: number): number {
    if (n <= ALPHABET) return this.uniform(n);
    const high = this.number(Math.ceil(n / ALPHABET));
    return high * ALPHABET + this.uniform(ALPHABET);
  }

  fair(): boolean {
    return this.uniform(2) === 1;
  }

  plain(bits: number): bigint {
    let value = 0n;
    for (let shift = 0; shift < bits; shift += 16)
      value |= BigInt(this.uniform(2 ** Math.min(16, bits - shift))) << BigInt(shift);
    return value;
  }

  /** A number of so many bits, of which the highest is 1; 0 for none. */
  ofLength(bits: number): bigint {
    return bits ? (1n << BigInt(bits - 1)) | this.plain(bits - 1) : 0n;
  }

  unbounded(): bigint {
    return this.ofLength(this.uniform(64));
  }

  private word(at: number): number {
    const { data } = this;
    if (at + 4 <= data.length)
      return ((data[at]! << 24) | (data[at + 1]! << 16) | (data[at + 2]! << 8) | data[at + 3]!) >>> 0;
    let word = 0;
    for (let i = at; i < at + 4; i++) word = word * 256 + (data[i] ?? 0);
    return word;
  }

  /** `(point - low) // step`. */
  private code(): number {
    const { high, low, step } = this;
    let code = Math.floor((high * PART + low) / step); // of 53 bits: perhaps one off
    const top = Math.floor(step / PART);
    let rest = (high - code * top) * PART + (low - code * (step - top * PART));
    if (rest < 0) {
      code--;
      rest += step;
    } else if (rest >= step) {
      code++;
      rest -= step;
    }
    if (code >= CODES) throw new DecodeError("data must be an encoder's stream; got bytes that no encoder wrote");
    this.rest = rest;
    return code;
  }

  /** Go into the interval [begin, end) of the codes. */
  private take(code: number, begin: number, end: number): void {
    const { step } = this;
    const top = Math.floor(step / PART);
    const bottom = step - top * PART;
    const away = code - begin;
    const low = away * bottom + this.rest;
    const carry = Math.floor(low / PART);
    this.high = away * top + carry;
    this.low = low - carry * PART;
    const width = (end - begin) * bottom;
    const range = Math.floor(width / PART) + (end - begin) * top; // without its last 24 bits
    this.step = range;
    if (range < 256) {
      const word = this.word(this.position);
      this.position += 4;
      this.step = (end - begin) * step * 256;
      this.high = (this.high * PART + this.low) * 256 + (word >>> 24);
      this.low = word & 0xffffff;
    }
  }
}

/** Where the codes of each value begin, for weights above 0, and their end; `into` has room for one more than these. */
export function beginnings(weights: ArrayLike<number>, into = new Uint32Array(weights.length + 1)): Uint32Array {
  const count = weights.length;
  let total = 0;
  for (let s = 0; s < count; s++) total += weights[s]!;
  const scale = (CODES - count) / total;
  let sum = 0;
  for (let s = 0; s < count; s++) {
    into[s] = Math.floor(sum * scale) + s;
    sum += weights[s]!;
  }
  into[count] = CODES;
  return into;
}
