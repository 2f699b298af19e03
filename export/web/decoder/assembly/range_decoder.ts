// The range coder and its symbols (docs/format.md); zeros follow the last byte.

import { allot, fail, NOT_A_STREAM } from "./memory";

const CODES: u64 = 1 << 24;
const VALUES: u32 = 2562; // of a categorical symbol, at most
const TABLES: u32 = 24;
const BINS: u32 = 16; // of angles

let data: usize = 0;
let end: usize = 0;
let difference: u64 = 0; // point - low
let range: u64 = 0;
const tables = allot(4 * (VALUES + 1) * TABLES);

/** Where the weights of a table are put. */
export const weights = allot(8 * VALUES);

/** Begin a stream. */
export function open(address: usize, bytes: usize): void {
  data = address;
  end = address + bytes;
  difference = (word() << 32) | word();
  range = u64.MAX_VALUE;
}

function word(): u64 {
  let result: u64 = 0;
  if (data + 4 <= end) result = bswap(load<u32>(data));
  else for (let i: usize = 0; i < 4; i++) result = (result << 8) | (data + i < end ? load<u8>(data + i) : 0);
  data += 4;
  return result;
}

function code(): u64 {
  const result = difference / (range >> 24);
  if (result >= CODES) fail(NOT_A_STREAM);
  return result;
}

/** Go into the interval [from, to) of the codes. */
// @ts-ignore: decorator
@inline
function take(from: u64, to: u64): void {
  const step = range >> 24;
  difference -= from * step;
  range = (to - from) * step;
  if (range >> 32) return;
  difference = (difference << 32) | word();
  range <<= 32;
}

/** A number of n, all equally likely, n at most 2**24. */
export function uniform(n: u32): u32 {
  if (n === 1) return 0;
  const width = (1 << 24) / n;
  const value = min(<u32>code() / width, n - 1);
  take(value * width, value === n - 1 ? CODES : <u64>((value + 1) * width));
  return value;
}

/** A number of n, which may be above 16 bits; the highest part may make it n or more. */
export function number(n: u32): u32 {
  if (n <= 0x10000) return uniform(n);
  const high = number((n + 0xffff) >> 16);
  return (high << 16) | uniform(0x10000);
}

/** A bit that is 1 with a chance in 1/65536. */
export function bit(chance: i32): i32 {
  // no code is needed, and so no quotient
  const step = range >> 24;
  const border = (CODES - 256 * <u64>chance) * step;
  if (difference >= CODES * step) fail(NOT_A_STREAM);
  const result = difference >= border;
  difference -= result ? border : 0;
  range = result ? CODES * step - border : border;
  if (!(range >> 32)) {
    difference = (difference << 32) | word();
    range <<= 32;
  }
  return <i32>result;
}

export function unbounded(): u64 {
  const bits = uniform(64);
  if (bits === 0) return 0;
  let value: u64 = 0;
  for (let shift: u32 = 0; shift < bits - 1; shift += 16)
    value |= <u64>uniform(1 << min(<u32>16, bits - 1 - shift)) << shift;
  return value | ((<u64>1) << (bits - 1));
}

// @ts-ignore: decorator
@inline
function begin(table: u32, value: u32): usize {
  return tables + 4 * (table * (VALUES + 1) + value);
}

/** The bin of an angle, one of so many; the weights of a model of bins follow `weights` by as many places. */
export function angleBin(turns: u32): u32 {
  for (let b: u32 = 0; b < BINS; b++) {
    const angles = ((b + 1) * turns) / BINS - (b * turns) / BINS;
    store<f64>(weights + 8 * b, load<f64>(weights + 8 * (BINS + b)) * <f64>angles);
  }
  prepare(0, BINS);
  return categorical(0, BINS);
}

/** Find where the codes of each value begin, of so many weights. */
export function prepare(table: u32, values: u32): void {
  let total: f64 = 0;
  for (let s: u32 = 0; s < values; s++) total += load<f64>(weights + 8 * s);
  const scale = <f64>((1 << 24) - values) / total;
  let sum: f64 = 0;
  for (let s: u32 = 0; s < values; s++) {
    store<u32>(begin(table, s), <u32>floor(sum * scale) + s);
    sum += load<f64>(weights + 8 * s);
  }
  store<u32>(begin(table, values), 1 << 24);
}

/** A categorical symbol by a table of so many values. */
export function categorical(table: u32, values: u32): u32 {
  const result = <u32>code();
  let value: u32 = 0;
  let last = values;
  // the first values are the likely ones of short tables
  if (values <= 16) while (result >= load<u32>(begin(table, value + 1))) value++;
  else
    while (last - value > 1) {
      const middle = (value + last) >> 1;
      if (result >= load<u32>(begin(table, middle))) value = middle;
      else last = middle;
    }
  take(load<u32>(begin(table, value)), load<u32>(begin(table, value + 1)));
  return value;
}
