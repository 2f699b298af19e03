/** The image of a scene as a file: its size, and its bytes. */

import type { Size } from "./view.ts";

export interface ImageOptions {
  width?: number;
  height?: number;
  type?: string;
  quality?: number;
}

/** The size of an image; what is left out is that of the scene, or keeps its proportions. */
export function imageSize(scene: Size, width?: number, height?: number): Size {
  for (const [name, length] of Object.entries({ width, height })) {
    if (length === undefined || (Number.isInteger(length) && length > 0)) continue;
    throw new RangeError(`${name} must be a whole number of pixels, 1 or more; got ${length}`);
  }
  const ratio = scene.height / scene.width;
  const across = width ?? (height === undefined ? scene.width : Math.max(1, Math.round(height / ratio)));
  return { width: across, height: height ?? Math.max(1, Math.round(across * ratio)) };
}

export function imageFile(canvas: HTMLCanvasElement, type: string, quality?: number): Promise<Blob> {
  return new Promise((resolve, reject) => {
    const settle = (blob: Blob | null): void =>
      blob === null ? reject(new Error(`no image of ${canvas.width} x ${canvas.height} can be made`)) : resolve(blob);
    canvas.toBlob(settle, type, quality);
  });
}
