/** Check the value of an attribute; the browser reports the error on the console and goes on. */
export function oneOf<T extends string>(name: string, value: string, values: readonly T[]): T {
  const choice = values.find((one) => one === value);
  if (choice === undefined) throw new RangeError(`${name} must be one of ${values.join(", ")}; got ${value}`);
  return choice;
}
