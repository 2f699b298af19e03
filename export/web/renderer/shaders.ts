/** The three passes on a GPU: whose each pixel is, the sum of Gaussians, and what is shown of it. */

import { LEAST_BLUR, PIXEL, WHOLE } from "./membership.ts";

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp usampler2DArray;
`;

/** A slot is region << 16 | share of 65535; an empty one has the region 0xffff. A texel holds four. */
export const SLOTS_OF_A_LAYER = 4;
const EMPTY = "0xffff0000u";

export const FULLSCREEN = `${HEAD}
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

/** Finds the regions of a pixel and their shares, as `contours.ts` does; columns and rows say where cells lie. */
export function contourShader(layers: number, pairs: boolean): string {
  const slots = layers * SLOTS_OF_A_LAYER;
  const outputs = Array.from({ length: layers }, (_, i) => `layout(location = ${i}) out uvec4 slots${i};`).join("\n");
  const written = Array.from({ length: layers }, (_, i) => `slots${i} = pack(${i * SLOTS_OF_A_LAYER});`).join("\n  ");
  return `${HEAD}
uniform usampler2D heads, lists, visible;
uniform sampler2D columns, rows, variances;
uniform float uniformVariance, ratio; // pixels of the output per cell; 0: weights stay as they are
${outputs}
uint regions[${slots}];
float shares[${slots}];
int count = 0;

void add(uint region, float share) {
  int least = 0;
  for (int i = 0; i < count; i++) {
    if (regions[i] == region) {
      shares[i] += share;
      return;
    }
    if (shares[i] < shares[least]) least = i;
  }
  if (count < ${slots}) least = count++;
  else if (shares[least] >= share) return;
  regions[least] = region;
  shares[least] = share;
}

uvec4 pack(int first) {
  uvec4 packed = uvec4(${EMPTY});
  for (int i = 0; i < 4; i++) {
    int at = first + i;
    if (at >= count) break;
    ivec2 place = ivec2(int(regions[at] & 0xffu), int(regions[at] >> 8));
    if (texelFetch(visible, place, 0).r == 0u) continue;
    packed[i] = regions[at] << 16 | uint(shares[at] * 65535.0 + 0.5);
  }
  return packed;
}

uint read(vec2 cell) { return texelFetch(heads, ivec2(cell), 0).r; }

${weighing(pairs)}

void main() {
  weigh(ivec2(gl_FragCoord.xy));
  ${written}
}`;
}

function weighing(pairs: boolean): string {
  const variance = pairs
    ? `float upper = mix(texelFetch(variances, ivec2(column.x, row.x), 0).r,
                    texelFetch(variances, ivec2(column.y, row.x), 0).r, column.z);
  float lower = mix(texelFetch(variances, ivec2(column.x, row.y), 0).r,
                    texelFetch(variances, ivec2(column.y, row.y), 0).r, column.z);
  float variance = mix(upper, lower, row.z);`
    : "float variance = uniformVariance;";
  const sharpness = `ratio == 0.0 ? 1.0
    : sqrt((max(variance, ${LEAST_BLUR ** 2}) + ${PIXEL}) * ratio / (max(variance - ${PIXEL}, 0.0) * ratio + ${PIXEL}))`;
  return `
void spread(uint head, float share) {
  if (share <= 0.0) return;
  if (head < 0x80000000u) { add(head, share); return; }
  for (uint at = head & 0x7fffffffu; ; at++) {
    uint entry = texelFetch(lists, ivec2(int(at & 0xfffu), int(at >> 12)), 0).r;
    if (entry == 0u) break;
    add(entry >> 16, share * float(entry & 0xffffu) / ${WHOLE}.0);
  }
}
void weigh(ivec2 pixel) {
  vec3 column = texelFetch(columns, ivec2(pixel.x, 0), 0).xyz;
  vec3 row = texelFetch(rows, ivec2(pixel.y, 0), 0).xyz;
  uvec4 four = uvec4(read(vec2(column.x, row.x)), read(vec2(column.y, row.x)),
                     read(vec2(column.x, row.y)), read(vec2(column.y, row.y)));
  if (four.x < 0x80000000u && all(equal(four, four.xxxx))) { add(four.x, 1.0); return; }
  float i = column.z, j = row.z;
  spread(four.x, (1.0 - i) * (1.0 - j));
  spread(four.y, i * (1.0 - j));
  spread(four.z, (1.0 - i) * j);
  spread(four.w, i * j);
  ${variance}
  float power = ${sharpness};
  float most = 0.0, total = 0.0;
  for (int k = 0; k < count; k++) most = max(most, shares[k]);
  for (int k = 0; k < count; k++) {
    shares[k] = pow(shares[k] / most, power);
    total += shares[k];
  }
  for (int k = 0; k < count; k++) shares[k] /= total;
}`;
}

/** Places a Gaussian's parallelogram, or the box of it and its region where that is smaller. */
export const SPLAT_VERTEX = `${HEAD}
layout(location = 0) in vec2 mean;
layout(location = 1) in vec3 cholesky;
layout(location = 2) in vec4 color;
layout(location = 3) in float radius;
layout(location = 4) in uint region;
layout(location = 5) in vec4 bounds;
uniform vec4 part; // of the scene: left, top, right, bottom
uniform vec2 pixels; // of the render for each of the scene's
flat out vec2 middle; // all in pixels of the render
flat out vec3 inverse;
flat out vec4 paint;
flat out uint owner;

void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  float l11 = cholesky.x, l21 = cholesky.y, l22 = cholesky.z;
  vec2 reach = radius * vec2(l11, length(cholesky.yz));
  vec2 low = max(max(mean - reach, bounds.xy), part.xy);
  vec2 high = min(min(mean + reach, bounds.zw), part.zw);
  paint = color;
  owner = region;
  middle = (mean - part.xy) * pixels;
  inverse = vec3(1.0 / (l11 * pixels.x), l21 * pixels.y, 1.0 / (l22 * pixels.y));
  vec2 whitened = (2.0 * corner - 1.0) * radius;
  vec2 point = mean + vec2(l11 * whitened.x, l21 * whitened.x + l22 * whitened.y);
  vec2 sides = high - low;
  if (sides.x <= 0.0 || sides.y <= 0.0) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  if (sides.x * sides.y < 4.0 * radius * radius * l11 * l22) point = mix(low, high, corner);
  gl_Position = vec4((point - part.xy) / (part.zw - part.xy) * 2.0 - 1.0, 0.0, 1.0);
}`;

/** A Gaussian's weight at a pixel, times the share that its region has of it. */
export function splatShader(layers: number): string {
  const more =
    layers === 1
      ? ""
      : `
  for (int layer = 1; layer < ${layers} && share == 0.0 && slots.w != ${EMPTY}; layer++) {
    slots = texelFetch(contours, ivec3(pixel, layer), 0);
    share = find(slots);
  }`;
  return `${HEAD}
uniform usampler2DArray contours;
flat in vec2 middle;
flat in vec3 inverse;
flat in vec4 paint;
flat in uint owner;
out vec4 sum;

float find(uvec4 slots) {
  vec4 same = vec4(equal(slots >> 16, uvec4(owner)));
  return dot(same, vec4(slots & 0xffffu)) / 65535.0;
}

void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  uvec4 slots = texelFetch(contours, ivec3(pixel, 0), 0);
  float share = find(slots);${more}
  if (share == 0.0) discard;
  // not interpolated: rasterizers round corners to a fraction of a pixel
  vec2 offset = gl_FragCoord.xy - middle;
  float first = offset.x * inverse.x, second = (offset.y - inverse.y * first) * inverse.z;
  sum = paint * (share * exp(-0.5 * (first * first + second * second)));
}`;
}

/** Takes area means of a scene that shrinks, clips, and puts the first row on top. */
export function showShader(layers: number, channels: number): string {
  return `${HEAD}
uniform sampler2D sums;
uniform usampler2DArray contours;
uniform vec4 spans; // where the first output pixel begins and how many pixels it spans, across and down; 0: one each
uniform ivec2 corner; // of this output in the framebuffer, and its height
uniform int height;
uniform bool hides;
out vec4 shown;

float covered(ivec2 pixel) {
  if (!hides) return 1.0;
  float total = 0.0;
  for (int layer = 0; layer < ${layers}; layer++)
    total += dot(vec4(texelFetch(contours, ivec3(pixel, layer), 0) & 0xffffu), vec4(1.0 / 65535.0));
  return total;
}

vec2 range(float from, float span, int i, int count) {
  if (span == 0.0) return vec2(i, i + 1);
  float begin = clamp(from + float(i) * span, 0.0, float(count) - 0.5 * span);
  return vec2(begin, min(from + float(i + 1) * span, float(count)));
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) - corner;
  at.y = height - 1 - at.y;
  ivec2 size = textureSize(sums, 0);
  vec2 across = range(spans.x, spans.y, at.x, size.x), down = range(spans.z, spans.w, at.y, size.y);
  vec4 sum = vec4(0.0);
  float cover = 0.0, total = 0.0;
  for (int y = int(down.x); float(y) < down.y; y++) {
    float tall = min(down.y, float(y + 1)) - max(down.x, float(y));
    for (int x = int(across.x); float(x) < across.y; x++) {
      float share = tall * (min(across.y, float(x + 1)) - max(across.x, float(x)));
      sum += share * texelFetch(sums, ivec2(x, y), 0);
      cover += share * covered(ivec2(x, y));
      total += share;
    }
  }
  cover = max(cover / total, 1e-6);
  vec4 color = clamp(sum / total / cover, 0.0, 1.0);
  float alpha = min(cover, 1.0)${channels === 4 ? " * color.a" : ""};
  shown = vec4(color.${channels === 1 ? "rrr" : "rgb"} * alpha, alpha);
}`;
}
