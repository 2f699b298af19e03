/** The canvas of an element: what it shows of a scene, and when it renders. */

import type { Scene } from "../decoder/scene.ts";
import { paint } from "../renderer/painter.ts";
import type { Device } from "../renderer/painter.ts";
import { PreparedScene } from "../renderer/prepare.ts";
import type { View } from "../renderer/sampling.ts";
import type { Viewport } from "./gestures.ts";
import { anchorAt, clamp, fit, pan, visiblePart, zoomAbout } from "./view.ts";
import type { Anchor, Size, Transform } from "./view.ts";

// a view is settled when it has not moved for so many milliseconds
const SETTLE = 150;
// the longest that a frame may take while the view moves, in milliseconds; a GPU's are as long as those of the screen
const CPU_BUDGET = 40;
const GPU_BUDGET = 20;
const MAX_DIVISOR = 8; // of the resolution, along each side, while the view moves

export class Stage implements Viewport {
  transform: Transform = { x: 0, y: 0, scale: 1 };
  device: Device = "auto";
  /** What rendered last: "webgl2 float32", "webgl2 float16", "cpu", or "" before anything did. */
  renderer = "";
  private scene: PreparedScene | null = null;
  private visible = new Uint8Array(0);
  private measured = false; // whether the canvas has its size on the screen
  private fitted = true;
  private moving = false;
  private settling = 0;
  private frame = 0;
  private lastFrame = 0;
  private divisor = 1; // of the resolution of the last frame
  private cost = 0; // milliseconds per pixel; 0: not known
  private scratch: HTMLCanvasElement | null = null;
  private readonly context: CanvasRenderingContext2D;

  constructor(
    readonly canvas: HTMLCanvasElement,
    private readonly onChange: () => void,
    private readonly onError: (error: Error) => void,
  ) {
    this.context = canvas.getContext("2d")!;
  }

  get size(): Size {
    return { width: this.canvas.width, height: this.canvas.height };
  }

  /** Show a scene; `hidden` are positions of regions that are not shown. */
  show(scene: Scene | null, hidden: ReadonlySet<number>): void {
    const first = this.scene === null;
    this.scene = scene === null ? null : new PreparedScene(scene);
    this.hide(hidden, scene?.regions?.ids.length ?? 1);
    if (first && this.scene !== null) this.fit();
    else this.requestRender();
  }

  hide(hidden: ReadonlySet<number>, regions = this.visible.length): void {
    this.visible = new Uint8Array(regions).map((_, place) => Number(!hidden.has(place)));
    this.requestRender();
  }

  /** Set the canvas to the pixels that it has on the screen. */
  resize(width: number, height: number): void {
    this.measured = true;
    if (width === this.canvas.width && height === this.canvas.height) return;
    this.canvas.width = width;
    this.canvas.height = height;
    if (this.scene === null) return;
    if (this.fitted) this.fit();
    else this.move((scene, canvas) => clamp(this.transform, scene, canvas));
    // a canvas is emptied when it is resized; now there is no flash
    this.render();
  }

  /** Canvas position of a pointer. */
  locate(event: { clientX: number; clientY: number }): [x: number, y: number] {
    const box = this.canvas.getBoundingClientRect();
    const ratio = this.canvas.width / Math.max(1, box.width);
    return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
  }

  anchorAt(x: number, y: number): Anchor {
    return anchorAt(this.transform, x, y, this.size);
  }

  zoom(factor: number, anchor: Anchor): void {
    this.move((scene, canvas) => zoomAbout(this.transform, factor, anchor, scene, canvas));
  }

  pan(dx: number, dy: number): void {
    this.move((scene, canvas) => pan(this.transform, dx, dy, scene, canvas));
  }

  native(): void {
    this.move((scene, canvas) => clamp({ ...this.transform, scale: 1 }, scene, canvas));
  }

  fit(): void {
    this.move(fit);
    this.fitted = true;
  }

  /** Wait until the view no longer moves and is rendered. */
  async settled(): Promise<void> {
    while (this.moving || this.frame !== 0) await new Promise((resolve) => setTimeout(resolve, 20));
  }

  /** Render all of the scene at a size, apart from what is on the canvas. */
  image(width: number, height: number): HTMLCanvasElement {
    if (this.scene === null) throw new Error("there is no scene yet");
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const view: View = { rect: [0, 0, this.scene.width, this.scene.height], width, height };
    const context = canvas.getContext("2d")!;
    // a canvas that is too large keeps no pixels, without an error
    context.fillRect(0, 0, 1, 1);
    if (context.getImageData(0, 0, 1, 1).data[3] === 0) throw new Error(`no image of ${width} x ${height} can be made`);
    paint(context, 0, 0, this.scene.at(view), view, this.visible, this.device);
    return canvas;
  }

  /** Render in the next frame. */
  requestRender(): void {
    if (this.frame !== 0 || !this.measured) return;
    this.frame = requestAnimationFrame((now) => {
      this.frame = 0;
      const elapsed = now - this.lastFrame;
      const pixels = (this.canvas.width * this.canvas.height) / this.divisor ** 2;
      if (this.moving && this.renderer !== "cpu" && elapsed < 1000) this.recordCost(elapsed / pixels);
      this.lastFrame = now;
      this.render();
    });
  }

  private recordCost(cost: number): void {
    this.cost = this.cost === 0 ? cost : (this.cost + cost) / 2;
  }

  /** By how much to divide the resolution of so many pixels while the view moves. */
  private divisorFor(pixels: number): number {
    const divisor = Math.sqrt((pixels * this.cost) / (this.renderer === "cpu" ? CPU_BUDGET : GPU_BUDGET));
    return Math.min(Math.max(Math.ceil(divisor), 1), MAX_DIVISOR);
  }

  private move(next: (scene: Size, canvas: Size) => Transform): void {
    if (this.scene === null) return;
    this.transform = next(this.scene, this.size);
    this.fitted = false;
    this.moving = true;
    clearTimeout(this.settling);
    this.settling = window.setTimeout(() => {
      this.moving = false;
      if (this.divisor > 1) this.requestRender();
    }, SETTLE);
    this.requestRender();
    this.onChange();
  }

  private render(): void {
    const { scene, context, canvas } = this;
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (scene === null) return;
    const part = visiblePart(this.transform, scene, this.size);
    this.divisor = this.moving ? this.divisorFor(part.width * part.height) : 1;
    const [width, height] = [Math.ceil(part.width / this.divisor), Math.ceil(part.height / this.divisor)];
    const view = { rect: part.rect, width, height, draft: this.divisor > 1 };
    const start = performance.now();
    const before = this.renderer;
    try {
      if (this.divisor === 1) this.renderer = paint(context, part.x, part.y, scene.at(view), view, this.visible, this.device);
      else {
        this.scratch ??= document.createElement("canvas");
        Object.assign(this.scratch, { width, height });
        this.renderer = paint(this.scratch.getContext("2d")!, 0, 0, scene.at(view), view, this.visible, this.device);
        context.drawImage(this.scratch, part.x, part.y, part.width, part.height);
      }
    } catch (error) {
      this.onError(error as Error);
      return;
    }
    if (before !== this.renderer) this.cost = 0;
    if (this.renderer === "cpu") this.recordCost((performance.now() - start) / (width * height));
  }
}
