/** Numbers to which more are added. */
export class GrowingArray<T extends Uint8Array | Float32Array | Int32Array> {
  length = 0;

  constructor(private numbers: T) {}

  add(values: T): void {
    const length = this.length + values.length;
    if (length > this.numbers.length) {
      const larger = new (this.numbers.constructor as new (length: number) => T)(Math.max(length, 2 * this.length));
      larger.set(this.all());
      this.numbers = larger;
    }
    this.numbers.set(values, this.length);
    this.length = length;
  }

  /** All numbers, until more are added. */
  all(): T {
    return this.numbers.subarray(0, this.length) as T;
  }
}
