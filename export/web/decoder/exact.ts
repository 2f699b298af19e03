/** Powers and angles with the same bits on every machine: sums, products and quotients alone (docs/format.md). */

const LN2 = 0.6931471805599453;

const factorial = (n: number): bigint => (n ? BigInt(n) * factorial(n - 1) : 1n);
const coefficients = (count: number, of: (i: number) => number): Float64Array =>
  new Float64Array(count).map((_, i) => of(i));
const EXP = coefficients(15, (i) => 1 / Number(factorial(i)));
const SIN = coefficients(13, (i) => (i % 2 ? -1 : 1) / Number(factorial(2 * i + 1)));
const COS = coefficients(13, (i) => (i % 2 ? -1 : 1) / Number(factorial(2 * i)));

// powers of two, which engines' own pow may miss by a bit
const POWERS = new Float64Array(512);
for (let n = 0, up = 1, down = 1; n < 256; n++, up *= 2, down /= 2) {
  POWERS[256 + n] = up;
  POWERS[256 - n] = down;
}

function polynomial(coefficients: Float64Array, x: number): number {
  let total = coefficients[coefficients.length - 1]!;
  for (let i = coefficients.length - 2; i >= 0; i--) total = total * x + coefficients[i]!;
  return total;
}

/** 2**x, |x| below 255. */
export function exp2(x: number): number {
  const n = Math.floor(x + 0.5);
  return POWERS[256 + n]! * polynomial(EXP, (x - n) * LN2);
}

/** The cosine of pi times `share`, which is in [0, 1]. */
export function cosine(share: number): number {
  const z = (share - 0.5) * Math.PI;
  return -z * polynomial(SIN, z * z);
}

export function sine(share: number): number {
  const z = (share - 0.5) * Math.PI;
  return polynomial(COS, z * z);
}
