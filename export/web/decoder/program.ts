/** The program that `assembly` is compiled to. */

import { unpack } from "./packed_text.ts";
import program from "./program.wasm?packed";
import { DecodeError } from "./scene.ts";

/** `assembly/index.ts`; addresses are in its memory. */
export interface Program {
  readonly memory: WebAssembly.Memory;
  readonly weights: WebAssembly.Global<"i32">;
  readonly cells: WebAssembly.Global<"i32">;
  readonly met: WebAssembly.Global<"i32">;
  allot(bytes: number): number;
  open(stream: number, bytes: number): void;
  uniform(n: number): number;
  prepare(table: number, values: number): void;
  categorical(table: number, values: number): number;
  angleBin(turns: number): number;
  openEarlier(count: number): number;
  readNear(rows: number, columns: number, base: number, near: number, capacity: number): number;
  model(tables: number, groups: number, squash: number, stretch: number): void;
  readLabels(height: number, width: number, regions: number, template: number, positions: number): number;
}

// by the numbers of `assembly/memory.ts`
const PROBLEMS = [
  "data must be an encoder's stream; got bytes that no encoder wrote",
  "data must mark at most the pixels of the map; got more",
  "data must mark pixels of the map",
  `data must ask for at most ${2 ** 23} pixels near contours; got more`,
  `data must hold at most ${2 ** 18} labels that no neighbour has; got more`,
  "data must hold labels of regions that were met; got another",
  "cells must hold the Gaussians of their class; got more",
  "the file needs more memory than there is",
];

let compiled: WebAssembly.Module | undefined;

function compile(): WebAssembly.Module {
  try {
    return new WebAssembly.Module(unpack(program));
  } catch (error) {
    throw new DecodeError(
      `the decoder needs WebAssembly with SIMD, which a Content-Security-Policy allows by 'wasm-unsafe-eval'; ${error}`,
    );
  }
}

/** Start the program, with memory of its own, which does not shrink. */
export function startProgram(): Program {
  compiled ??= compile();
  const fail = (problem: number): never => {
    throw new DecodeError(PROBLEMS[problem]!);
  };
  return new WebAssembly.Instance(compiled, { decoder: { fail } }).exports as unknown as Program;
}

/** Put numbers into the program's memory; return where. */
export function put({ memory, allot }: Program, array: Uint8Array | Int8Array | Int32Array): number {
  const address = allot(array.byteLength);
  new Uint8Array(memory.buffer, address).set(new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
  return address;
}
