/// <reference path="./packed.d.ts" />

// A byte is a printable character: those from -40 to 51, the most frequent ones, of ASCII, the others of U+00A1 on.
export const MIDDLE = 40;
export const SPLIT = 92;
export const FIRST = 35;
export const SECOND = 161;

/** The bytes of a file that is imported as text. */
export function unpack(text: string): Uint8Array<ArrayBuffer> {
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; i++) {
    const letter = text.charCodeAt(i);
    bytes[i] = (letter < SECOND ? letter - FIRST : letter - SECOND + SPLIT) - MIDDLE;
  }
  return bytes;
}
