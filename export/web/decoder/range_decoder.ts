/** The range coder and its symbols with fixed chances (docs/format.md). */

import { type Program, put, startProgram } from "./program.ts";

const ALPHABET = 2 ** 16;

/** Turns bytes into symbols; zeros follow the last byte. A program has one stream at a time. */
export class RangeDecoder {
  private readonly sizes: number[] = []; // of the tables

  constructor(
    data: Uint8Array,
    readonly program: Program = startProgram(),
  ) {
    program.open(put(program, data), data.length);
  }

  /** A number of n, all equally likely, n at most 2**24. */
  uniform(n: number): number {
    return n === 1 ? 0 : this.program.uniform(n);
  }

  /** Prepare one of 24 tables of categorical symbols, by weights above 0, of at most 2,562 values. */
  prepare(table: number, weights: Float64Array): void {
    const { memory, prepare, weights: address } = this.program;
    new Float64Array(memory.buffer, address.value, weights.length).set(weights);
    prepare(table, weights.length);
    this.sizes[table] = weights.length;
  }

  /** A categorical symbol by a table. */
  categorical(table: number): number {
    return this.program.categorical(table, this.sizes[table]!);
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
}
