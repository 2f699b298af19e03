/** Label maps and Gaussians in a GPU's memory. */

import { texture } from "./gl.ts";
import type { Membership } from "./membership.ts";
import { SHARED } from "./membership.ts";
import { SLOTS_OF_A_LAYER } from "./shaders.ts";
import { mostRegions } from "./slots.ts";
import type { Prepared } from "./software.ts";

/** As many regions of a pixel are kept; of more, those with the largest shares. */
const MAX_LAYERS = 4;
const LIST_WIDTH = 1 << 12;
const VISIBLE_WIDTH = 1 << 8;
// mean, factor, colour, radius, region, bounds
const SIZES = [2, 3, 4, 1, 1, 4];
const REGION = 4;
const STRIDE = SIZES.reduce((sum, size) => sum + size);

export interface MapTextures {
  readonly layers: number;
  readonly heads: WebGLTexture;
  readonly lists: WebGLTexture;
  readonly visible: WebGLTexture;
  readonly variances: WebGLTexture;
  readonly bounds: Float32Array; // of regions in scene pixels: left, top, right, bottom
  show(visible: Uint8Array): void;
  free(): void;
}

export function uploadMembership(gl: WebGL2RenderingContext, membership: Membership, regions: number): MapTextures {
  const { width, height, heads, lists, variances } = membership;
  const integers = (data: Uint32Array, across: number): WebGLTexture => {
    const resources = texture(gl);
    const down = Math.ceil(data.length / across);
    const padded = data.length === across * down ? data : new Uint32Array(across * down);
    if (padded !== data) padded.set(data);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, across, down, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, padded);
    return resources;
  };
  const resources = {
    heads: integers(heads, width),
    lists: integers(lists, LIST_WIDTH),
    visible: texture(gl),
    variances: texture(gl),
  };
  const squares = variances ?? new Float32Array(1);
  gl.bindTexture(gl.TEXTURE_2D, resources.variances);
  const size = variances === null ? ([1, 1] as const) : ([width, height] as const);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, ...size, 0, gl.RED, gl.FLOAT, squares);
  const maxRegions = mostRegions(membership, MAX_LAYERS * SLOTS_OF_A_LAYER);
  return {
    ...resources,
    layers: Math.ceil(maxRegions / SLOTS_OF_A_LAYER),
    bounds: boundsOf(membership, regions),
    show: (visible) => {
      const padded = new Uint8Array(Math.ceil(visible.length / VISIBLE_WIDTH) * VISIBLE_WIDTH);
      padded.set(visible);
      gl.bindTexture(gl.TEXTURE_2D, resources.visible);
      const down = padded.length / VISIBLE_WIDTH;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8UI, VISIBLE_WIDTH, down, 0, gl.RED_INTEGER, gl.UNSIGNED_BYTE, padded);
    },
    free: () => Object.values(resources).forEach((resource) => gl.deleteTexture(resource)),
  };
}

/** The boxes outside of which regions have no weight. */
function boundsOf({ width, height, heads, lists }: Membership, regions: number): Float32Array {
  const bounds = new Float32Array(4 * regions);
  for (let r = 0; r < regions; r++) bounds.set([Infinity, Infinity, -Infinity, -Infinity], 4 * r);
  const note = (region: number, x: number, y: number): void => {
    const start = 4 * region;
    if (x < bounds[start]!) bounds[start] = x;
    if (y < bounds[start + 1]!) bounds[start + 1] = y;
    if (x > bounds[start + 2]!) bounds[start + 2] = x;
    if (y > bounds[start + 3]!) bounds[start + 3] = y;
  };
  for (let y = 0, start = 0; y < height; y++) {
    for (let x = 0; x < width; x++, start++) {
      const head = heads[start]!;
      if (head < SHARED) note(head, x, y);
      else for (let entry = head - SHARED; lists[entry] !== 0; entry++) note(lists[entry]! >>> 16, x, y);
    }
  }
  // a pixel, at most one of the scene, that has a part in weights that reach to the next cell; the border is held
  const ends = [width, height].map((cells) => cells - 1);
  return bounds.map((value, i) => {
    const low = i % 4 < 2;
    if (low ? value === 0 : value === ends[i % 2]!) return low ? -Infinity : Infinity;
    return low ? value - 1.5 : value + 2.5;
  });
}

export interface GaussianBuffer {
  readonly count: number;
  readonly array: WebGLVertexArrayObject;
  free(): void;
}

export function uploadGaussians(gl: WebGL2RenderingContext, { gaussians }: Prepared, map: MapTextures): GaussianBuffer {
  const { count, channels, means, cholesky, colors, radii, regions } = gaussians;
  const floats = new Float32Array(count * STRIDE);
  const whole = new Uint32Array(floats.buffer);
  for (let i = 0, start = 0; i < count; i++, start += STRIDE) {
    floats.set(means.subarray(2 * i, 2 * i + 2), start);
    floats.set(cholesky.subarray(3 * i, 3 * i + 3), start + 2);
    floats.set(colors.subarray(channels * i, channels * (i + 1)), start + 5);
    floats[start + 9] = radii[i]!;
    whole[start + 10] = regions[i]!;
    floats.set(map.bounds.subarray(4 * regions[i]!, 4 * regions[i]! + 4), start + 11);
  }
  const array = gl.createVertexArray();
  const buffer = gl.createBuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, floats, gl.STATIC_DRAW);
  let offset = 0;
  SIZES.forEach((size, place) => {
    gl.enableVertexAttribArray(place);
    gl.vertexAttribDivisor(place, 1);
    if (place === REGION) gl.vertexAttribIPointer(place, size, gl.UNSIGNED_INT, 4 * STRIDE, offset);
    else gl.vertexAttribPointer(place, size, gl.FLOAT, false, 4 * STRIDE, offset);
    offset += 4 * size;
  });
  gl.bindVertexArray(null);
  const free = (): void => {
    gl.deleteVertexArray(array);
    gl.deleteBuffer(buffer);
  };
  return { count, array, free };
}
