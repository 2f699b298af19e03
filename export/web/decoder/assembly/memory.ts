// What is wrong, for the text of the error that the caller makes of it; see ../program.ts.
export const NOT_A_STREAM = 0;
export const MANY_SEEDS = 1;
export const SEED_OUTSIDE = 2;
export const MANY_CODED = 3;
export const MANY_EXPLICIT = 4;
export const NO_REGION = 5;
export const MANY_GAUSSIANS = 6;
export const NO_MEMORY = 7;

/** Ends with an error: the caller throws it. */
// @ts-ignore: decorator
@external("decoder", "fail")
export declare function fail(problem: i32): void;

let top: usize = (__heap_base + 15) & ~15;

/** Room for so many bytes, all 0, which is never given back. */
export function allot(bytes: usize): usize {
  const address = top;
  top = (top + bytes + 15) & ~15;
  const pages = <i32>((top + 0xffff) >> 16) - memory.size();
  if (pages > 0 && memory.grow(pages) < 0) fail(NO_MEMORY);
  return address;
}
