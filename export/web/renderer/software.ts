/** The renderer without a GPU. */

import { areaMean } from "./area.ts";
import { runsOf } from "./contours.ts";
import type { Runs } from "./contours.ts";
import type { Gaussians } from "./gaussians.ts";
import type { Membership } from "./membership.ts";
import { fineAxis } from "./sampling.ts";
import type { FineAxis, View } from "./sampling.ts";
import { sumGaussians } from "./spans.ts";

export interface Prepared {
  readonly width: number; // of the scene
  readonly height: number;
  readonly gaussians: Gaussians;
  readonly membership: Membership;
}

/** Render to straight RGBA; what hidden regions covered is transparent. */
export function renderSoftware(scene: Prepared, view: View, visible: Uint8Array): ImageData {
  const [left, top, right, bottom] = view.rect;
  const { gaussians, membership } = scene;
  const size: [number, number] = [view.height, view.width];
  const across = fineAxis(left, right, view.width, scene.width, view.draft);
  const down = fineAxis(top, bottom, view.height, scene.height, view.draft);
  const runs = runsOf(membership, across, down, visible);
  const { channels } = gaussians;
  const colors = areaMean(sumGaussians(gaussians, runs, across, down), channels, across, down, size);
  const hides = visible.includes(0);
  const alpha = hides ? areaMean(coverage(runs, across, down), 1, across, down, size) : null;
  return toImage(colors, channels, alpha, view);
}

function coverage(runs: Runs, across: FineAxis, down: FineAxis): Float32Array {
  const alpha = new Float32Array(across.count * down.count);
  for (let i = 0; i < runs.rows.length; i++) {
    const line = runs.rows[i]! * across.count;
    for (let x = runs.from[i]!; x < runs.to[i]!; x++) {
      alpha[line + x]! += runs.weights[i]! < 0 ? 1 : runs.shares[runs.weights[i]! + x - runs.from[i]!]!;
    }
  }
  return alpha;
}

/** Clip to 8 bits; colours of partly covered pixels are sums that their coverage divides. */
function toImage(colors: Float32Array, channels: number, alpha: Float32Array | null, view: View): ImageData {
  const image = new ImageData(view.width, view.height);
  const { data } = image;
  const step = channels === 1 ? 0 : 1;
  for (let i = 0, offset = 0; offset < data.length; i++, offset += 4) {
    const cover = alpha === null ? 1 : Math.max(alpha[i]!, 1e-6);
    const from = i * channels;
    // a clamped array rounds and clips by itself
    for (let c = 0; c < 3; c++) data[offset + c] = (colors[from + c * step]! / cover) * 255;
    data[offset + 3] = Math.min(1, alpha?.[i] ?? 1) * (channels === 4 ? colors[from + 3]! / cover : 1) * 255;
  }
  return image;
}
