/** The program that `assembly/clips.ts` is compiled to. */

import program from "../clips.wasm?packed";
import { compile, PROBLEMS, type StreamProgram } from "../program.ts";
import { DecodeError } from "../scene.ts";

/** Addresses are in its memory. */
export interface ClipProgram extends StreamProgram {
  readonly labels: WebAssembly.Global<"i32">; // of pixel (0, 0) of the last map
  readonly areas: WebAssembly.Global<"i32">;
  openFollowing(
    height: number,
    width: number,
    regions: number,
    tables: number,
    places: number,
    mixer: number,
    squash: number,
    stretch: number,
  ): void;
  measure(): void;
  predict(order: number, count: number, motions: number): void;
  follow(): number;
}

let compiled: WebAssembly.Module | undefined;

/** Start the program, with memory of its own, for one part of a clip. */
export function startClipProgram(): ClipProgram {
  compiled ??= compile(program);
  const fail = (problem: number): never => {
    throw new DecodeError(PROBLEMS[problem] ?? "data must use all labels that it lists, and no more");
  };
  return new WebAssembly.Instance(compiled, { decoder: { fail } }).exports as unknown as ClipProgram;
}
