/** Renders scenes onto canvases: on the GPU where there is one, else on the CPU. */

import { renderSoftware } from "./software.ts";
import type { Prepared } from "./software.ts";
import type { View } from "./sampling.ts";
import { WebGl } from "./webgl.ts";

/** What renders: auto takes a real GPU or else the CPU; webgl2 takes an emulated GPU too. */
export type Device = "auto" | "webgl2" | "cpu";

const contexts = new Map<boolean, WebGl | null>();

function openGpu(emulated: boolean): WebGl | null {
  const webGl = contexts.get(emulated);
  if (webGl === undefined || webGl?.lost) contexts.set(emulated, WebGl.open(emulated));
  return contexts.get(emulated) ?? null;
}

/** Render a view onto a canvas at (x, y); says what rendered it: "webgl2 float32", "webgl2 float16" or "cpu". */
export function paint(
  context: CanvasRenderingContext2D,
  x: number,
  y: number,
  scene: Prepared,
  view: View,
  visible: Uint8Array,
  device: Device,
): string {
  const gpu = device === "cpu" ? null : openGpu(device === "webgl2");
  if (gpu?.takes(scene, view) && renders(gpu, scene, view, visible, device)) {
    context.clearRect(x, y, view.width, view.height);
    context.drawImage(gpu.canvas, 0, 0, view.width, view.height, x, y, view.width, view.height);
    return `webgl2 ${gpu.precision}`;
  }
  if (device === "webgl2") throw new Error("this browser cannot render with WebGL2, or not a scene or an image of this size.");
  context.putImageData(renderSoftware(scene, view, visible), x, y);
  return "cpu";
}

/** Try a GPU; of one that fails, where the CPU may do it too, the console is told, and it is not tried again. */
function renders(gpu: WebGl, scene: Prepared, view: View, visible: Uint8Array, device: Device): boolean {
  try {
    gpu.render(scene, view, visible);
  } catch (error) {
    if (device !== "auto") throw error;
    console.warn(`kcgs-image: the CPU renders, because ${(error as Error).message}`);
    contexts.set(false, null);
    return false;
  }
  return !gpu.lost;
}
