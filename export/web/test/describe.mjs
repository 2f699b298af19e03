/** What a decoded scene holds, bit for bit, as JSON: numbers, and the SHA-256 of each array. */

const digest = async (array) => {
  if (array === null) return null;
  const hash = await crypto.subtle.digest("SHA-256", new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
  return Array.from(new Uint8Array(hash), (byte) => byte.toString(16).padStart(2, "0")).join("");
};

export async function describeScene(scene) {
  const { height, width, channels, count, layers, complete, regions } = scene;
  const { means, cholesky, colors, positions } = scene;
  return {
    ...{ height, width, channels, count, layers, complete },
    means: await digest(means),
    cholesky: await digest(cholesky),
    colors: await digest(colors),
    positions: await digest(positions),
    regions: regions && {
      labels: await digest(regions.labels),
      ids: await digest(regions.ids),
      softness: regions.softness,
      pairs: regions.pairs.map(({ a, b, width }) => [a, b, width]),
    },
  };
}

/** What a call gives, or the error that it throws. */
export async function attempt(call) {
  try {
    return await call();
  } catch (error) {
    const partial = error.partial ? await describeScene(error.partial) : null;
    return { error: error.name, message: error.message, partial };
  }
}

/** Push a file so many bytes at a time; the layers of the scenes on the way, and the last one. */
export async function stream(decoder, bytes, step) {
  const layers = [];
  for (let start = 0; start < bytes.length; start += step) {
    const scene = decoder.push(bytes.subarray(start, start + step));
    if (scene) layers.push(scene.layers);
  }
  return { layers, last: await attempt(async () => describeScene(decoder.finish())) };
}
