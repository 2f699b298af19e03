/**
 * Where the scene lies on the canvas. Scene and canvas are measured in their own pixels, pixel i sampled at i + 0.5.
 */

import type { Rect } from "../renderer/sampling.ts";

export interface Size {
  width: number;
  height: number;
}

export interface Transform {
  /** The point of the scene in the middle of the canvas. */
  x: number;
  y: number;
  /** Canvas pixels to a pixel of the scene. */
  scale: number;
}

/** A block of whole canvas pixels and the part of the scene that it shows. */
export interface Part {
  x: number;
  y: number;
  width: number;
  height: number;
  rect: Rect;
}

export const MAX_SCALE = 200;

export function fitScale(scene: Size, canvas: Size): number {
  return Math.min(canvas.width / scene.width, canvas.height / scene.height);
}

export function fit(scene: Size, canvas: Size): Transform {
  return { x: scene.width / 2, y: scene.height / 2, scale: fitScale(scene, canvas) };
}

/** Keep the scale within its limits and the canvas covered: a scene smaller than the canvas stays in its middle. */
export function clamp(transform: Transform, scene: Size, canvas: Size): Transform {
  const whole = fitScale(scene, canvas);
  const scale = limit(transform.scale, Math.min(whole, 1), Math.max(MAX_SCALE, whole));
  const along = (center: number, length: number, window: number): number => {
    const half = window / scale / 2;
    return 2 * half >= length ? length / 2 : limit(center, half, length - half);
  };
  return {
    x: along(transform.x, scene.width, canvas.width),
    y: along(transform.y, scene.height, canvas.height),
    scale,
  };
}

/** A position on the canvas and the point of the scene that belongs there. */
export interface Anchor {
  canvas: readonly [x: number, y: number];
  scene: readonly [x: number, y: number];
}

export function anchorAt(transform: Transform, x: number, y: number, canvas: Size): Anchor {
  const { scale } = transform;
  return {
    canvas: [x, y],
    scene: [transform.x + (x - canvas.width / 2) / scale, transform.y + (y - canvas.height / 2) / scale],
  };
}

/** Zoom by a factor with a point of the scene held where it is on the canvas, as far as the limits let it. */
export function zoomAbout(transform: Transform, factor: number, anchor: Anchor, scene: Size, canvas: Size): Transform {
  const { scale } = clamp({ ...transform, scale: transform.scale * factor }, scene, canvas);
  const x = anchor.scene[0] - (anchor.canvas[0] - canvas.width / 2) / scale;
  const y = anchor.scene[1] - (anchor.canvas[1] - canvas.height / 2) / scale;
  return clamp({ x, y, scale }, scene, canvas);
}

/** Move the scene by (dx, dy) canvas pixels. */
export function pan(transform: Transform, dx: number, dy: number, scene: Size, canvas: Size): Transform {
  const { x, y, scale } = transform;
  return clamp({ x: x - dx / scale, y: y - dy / scale, scale }, scene, canvas);
}

/**
 * Canvas position of the scene's corner (0, 0), in whole pixels: at scale 1 the canvas then samples the scene exactly
 * at its pixel centres.
 */
export function origin(transform: Transform, canvas: Size): [x: number, y: number] {
  return [
    Math.round(canvas.width / 2 - transform.x * transform.scale),
    Math.round(canvas.height / 2 - transform.y * transform.scale),
  ];
}

/** The canvas pixels whose centres lie in the scene. */
export function visiblePart(transform: Transform, scene: Size, canvas: Size): Part {
  const [ox, oy] = origin(transform, canvas);
  const { scale } = transform;
  const along = (start: number, length: number, window: number): [number, number] => {
    const first = Math.max(0, start);
    return [first, Math.max(first + 1, Math.min(window, Math.ceil(start + length * scale - 0.5)))];
  };
  const [x0, x1] = along(ox, scene.width, canvas.width);
  const [y0, y1] = along(oy, scene.height, canvas.height);
  return {
    x: x0,
    y: y0,
    width: x1 - x0,
    height: y1 - y0,
    rect: [(x0 - ox) / scale, (y0 - oy) / scale, (x1 - ox) / scale, (y1 - oy) / scale],
  };
}

function limit(value: number, low: number, high: number): number {
  return Math.min(Math.max(value, low), high);
}
