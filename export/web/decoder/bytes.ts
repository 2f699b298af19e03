import { DecodeError } from "./scene.ts";

/** More bytes than there are were asked for; a stream may bring them yet. */
export class EndOfBytes extends DecodeError {}

/** Takes bytes and varints from the front. */
export class ByteReader {
  position = 0;

  /** `Early`: what is thrown where more is asked for; of bytes that are all there, that is damage. */
  constructor(
    readonly data: Uint8Array,
    private readonly Early: typeof DecodeError = DecodeError,
  ) {}

  get remaining(): number {
    return this.data.length - this.position;
  }

  take(count: number): Uint8Array {
    if (count > this.remaining) throw new this.Early(`the file ends early: it has ${this.data.length} bytes`);
    this.position += count;
    return this.data.subarray(this.position - count, this.position);
  }

  /** A whole number of so many bytes, the highest first. */
  number(bytes: number): number {
    return this.take(bytes).reduce((value, byte) => value * 256 + byte, 0);
  }

  /** The next varint, which must be in [low, high]. */
  varint(name: string, low: number, high: number): number {
    let value = 0;
    for (let shift = 0; ; shift += 7) {
      const byte = this.number(1);
      value += (byte & 127) * 2 ** shift;
      if (byte < 128) break;
      if (shift >= 28) throw new DecodeError(`${name} must be in [${low}, ${high}]; got a number of more than 35 bits`);
    }
    if (value < low || value > high) throw new DecodeError(`${name} must be in [${low}, ${high}]; got ${value}`);
    return value;
  }
}
