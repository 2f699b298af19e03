/** The open decoder and what is drawn of it: state, and which picture to ask for next. */

import { Client } from "./client.ts";
import { FrameQueue, FrameTimes } from "./frames.ts";
import type { SceneMetadata } from "./metadata.ts";
import { readSceneMetadata } from "./metadata.ts";
import type { Original } from "./original.ts";
import { psnr } from "./pixels.ts";
import type { FrameResult, ImageResult, Provider, RenderRequest, Running } from "./protocol.ts";
import { Stage } from "./stage.ts";
import type { Frame } from "./stage.ts";
import type { Anchor, Part, Size, Transform } from "./view.ts";
import { anchorAt, clamp, fit, pan, visiblePart, wholeSize, zoomAbout } from "./view.ts";

/** How long the view must rest, in milliseconds, before it is drawn at full resolution. */
const SETTLE = 140;
const BACKDROP_SIDE = 512;
const THUMBNAIL_SIDE = 48;
const MAX_THUMBNAILS = 100;

/** Most pixels of a whole picture from a decoder without the input `view`. */
export const MAX_WHOLE_PIXELS = 16_000_000;

export interface Scene {
  metadata: SceneMetadata;
  bytes: Uint8Array;
  hasView: boolean;
  hasVisible: boolean;
}

export interface Listener {
  /** Facts other than the view changed. */
  changed(): void;
  /** The view changed. */
  moved(): void;
  /** A view is being drawn, or no longer. */
  drawing(drawing: boolean): void;
  notice(text: string): void;
  failed(text: string): void;
  thumbnail(region: number, bitmap: ImageBitmap): void;
}

export class Viewer {
  readonly stage: Stage;
  readonly times = new FrameTimes();
  scene: Scene | null = null;
  visible: number[] = [];
  provider: Provider | null = null;
  original: Original | null = null;
  /** PSNR in dB against the original; null while there is none, or none of the scene's size. */
  psnr: number | null = null;
  transform: Transform = { x: 0, y: 0, scale: 1 };
  maxWholePixels = MAX_WHOLE_PIXELS;

  private readonly client = new Client();
  private readonly queue = new FrameQueue(() => this.drawView());
  private frame: (Frame & { key: string }) | null = null;
  private backdrop: (Frame & { key: string }) | null = null;
  private fitted = true;
  private moving = false;
  private settling: ReturnType<typeof setTimeout> | undefined;

  constructor(
    canvas: HTMLCanvasElement,
    private readonly divider: () => number | null,
    private readonly listener: Listener,
  ) {
    this.stage = new Stage(canvas, () => this.scenery(), () => this.resized());
  }

  /** Open a decoder, its first frame still to be drawn; if that fails, whatever was open stays open. */
  async open(bytes: Uint8Array, provider: Provider): Promise<void> {
    const metadata = readSceneMetadata(bytes);
    const regions = metadata.regionIds.length;
    await this.queue.task(async () => {
      const opened = await this.client.send<"open">({ kind: "open", bytes, regions, provider });
      const has = (name: string): boolean => opened.inputs.includes(name);
      this.scene = { metadata, bytes, hasView: has("view"), hasVisible: has("visible") };
      this.visible = metadata.regionIds.map(() => 1);
      this.maxWholePixels = Math.max(MAX_WHOLE_PIXELS, metadata.width * metadata.height);
      this.original = null;
      this.psnr = null;
      this.forget();
      this.times.clear();
      this.provider = null;
      this.take(opened);
    }, true);
    this.fit();
    this.listener.changed();
  }

  async switchTo(provider: Provider): Promise<void> {
    if (this.scene === null) return;
    this.take(await this.queue.task(() => this.client.send<"switch">({ kind: "switch", provider }), true));
    this.forget();
    this.queue.want();
  }

  /** Decode one picture, apart from what is on the canvas. */
  render(request: RenderRequest): Promise<ImageResult> {
    return this.queue.task(async () => {
      const image = await this.client.send<"image">({ kind: "image", request });
      this.take(image);
      return image;
    });
  }

  setOriginal(original: Original | null): void {
    this.original = original;
    this.psnr = null;
    this.stage.paint();
    this.listener.changed();
    void this.measurePsnr();
  }

  setVisible(visible: number[]): void {
    this.visible = visible;
    this.backdrop?.bitmap.close();
    this.backdrop = null;
    this.queue.want();
  }

  /** Draw each region alone, and small, when nothing else is to be drawn. */
  drawThumbnails(): void {
    const { scene } = this;
    if (!scene?.hasVisible || this.visible.length > MAX_THUMBNAILS) return;
    const { metadata } = scene;
    for (const region of metadata.regionIds.keys()) {
      void this.queue.task(async () => {
        if (this.scene !== scene) return;
        const alone = metadata.regionIds.map((_, other) => Number(other === region));
        const size = boxed(metadata, THUMBNAIL_SIDE * devicePixelRatio);
        const { bitmap } = await this.draw(size, [0, 0, metadata.width, metadata.height], alone);
        this.listener.thumbnail(region, bitmap);
      }).catch(() => undefined); // A row without its thumbnail is still a row.
    }
  }

  anchorAt(x: number, y: number): Anchor {
    return anchorAt(this.transform, x, y, this.stage.size);
  }

  zoom(factor: number, anchor: Anchor): void {
    this.move((scene, canvas) => zoomAbout(this.transform, factor, anchor, scene, canvas));
  }

  pan(dx: number, dy: number): void {
    this.move((scene, canvas) => pan(this.transform, dx, dy, scene, canvas));
  }

  /** One pixel of the canvas to a pixel of the scene. */
  native(): void {
    this.move((scene, canvas) => clamp({ ...this.transform, scale: 1 }, scene, canvas));
  }

  fit(): void {
    this.move(fit);
    this.fitted = true;
  }

  /** The canvas pixels that show the scene, and what they show. */
  part(): Part | null {
    return this.scene === null ? null : visiblePart(this.transform, this.scene.metadata, this.stage.size);
  }

  /** Wait until the view is at rest and all that it needs has been drawn. */
  async settled(): Promise<void> {
    do {
      await new Promise((resolve) => setTimeout(resolve, this.moving ? SETTLE : 0));
      await this.queue.idle();
    } while (this.moving);
    this.stage.paintNow();
  }

  paint(): void {
    this.stage.paint();
  }

  private forget(): void {
    this.frame?.bitmap.close();
    this.backdrop?.bitmap.close();
    this.frame = this.backdrop = null;
  }

  private move(next: (scene: Size, canvas: Size) => Transform): void {
    if (this.scene === null) return;
    this.transform = next(this.scene.metadata, this.stage.size);
    this.fitted = false;
    this.moving = true;
    clearTimeout(this.settling);
    this.settling = setTimeout(() => {
      this.moving = false;
      this.queue.want();
    }, SETTLE);
    this.stage.paint();
    this.queue.want();
    this.listener.moved();
  }

  private resized(): void {
    if (this.scene === null) return;
    if (this.fitted) this.fit();
    else this.move((scene, canvas) => clamp(this.transform, scene, canvas));
  }

  private scenery(): ReturnType<ConstructorParameters<typeof Stage>[1]> {
    if (this.scene === null) return null;
    return {
      scene: this.scene.metadata,
      transform: this.transform,
      backdrop: this.backdrop,
      frame: this.frame,
      original: this.original?.bitmap ?? null,
      divider: this.divider(),
    };
  }

  private async drawView(): Promise<void> {
    if (this.scene === null) return;
    const wanted = this.scene.hasView ? this.wantedPart(this.scene) : this.wantedWhole(this.scene);
    const key = JSON.stringify([wanted, this.visible]);
    if (key === this.frame?.key) return;
    this.listener.drawing(true);
    try {
      const { bitmap, milliseconds } = await this.draw(wanted.size, wanted.rect);
      this.times.add(milliseconds, bitmap.width * bitmap.height);
      this.frame?.bitmap.close();
      this.frame = { bitmap, rect: wanted.rect, key };
    } catch (error) {
      await this.failed(error as Error, wanted.size);
      return;
    } finally {
      this.listener.drawing(false);
    }
    this.stage.paint();
    this.listener.changed();
    if (this.scene.hasView && !this.moving) void this.drawBackdrop();
  }

  private wantedPart(scene: Scene): { size: [number, number]; rect: Part["rect"] } {
    const part = visiblePart(this.transform, scene.metadata, this.stage.size);
    const divisor = this.moving ? this.times.divisorFor(part.width * part.height) : 1;
    return { size: [Math.ceil(part.height / divisor), Math.ceil(part.width / divisor)], rect: part.rect };
  }

  private wantedWhole(scene: Scene): { size: [number, number]; rect: Part["rect"] } {
    const { metadata } = scene;
    const rect: Part["rect"] = [0, 0, metadata.width, metadata.height];
    // Drawing all of a large picture at every step of a zoom would keep its end waiting.
    const bitmap = this.moving ? this.frame?.bitmap : undefined;
    const size = bitmap ?? wholeSize(metadata, this.transform.scale, this.maxWholePixels);
    return { size: [size.height, size.width], rect };
  }

  private async drawBackdrop(): Promise<void> {
    const rect: Part["rect"] = [0, 0, this.scene!.metadata.width, this.scene!.metadata.height];
    const drawn = this.queue.task(async () => {
      const key = JSON.stringify(this.visible);
      if (key === this.backdrop?.key || this.scene === null) return;
      const { bitmap } = await this.draw(boxed(this.scene.metadata, BACKDROP_SIDE), rect);
      // Regions may have been toggled, or another decoder opened, while this was drawn.
      if (key !== JSON.stringify(this.visible)) return bitmap.close();
      this.backdrop?.bitmap.close();
      this.backdrop = { bitmap, rect, key };
      this.stage.paint();
    });
    await drawn.catch(() => undefined); // The view itself was drawn; nothing is missing but a preview.
  }

  private async draw(size: [number, number], rect: Part["rect"], visible = this.visible): Promise<FrameResult> {
    const request: RenderRequest = {
      size,
      ...(this.scene?.hasView && { view: rect }),
      ...(this.scene?.hasVisible && { visible }),
    };
    const result = await this.client.send<"frame">({ kind: "frame", request });
    this.take(result);
    return result;
  }

  private async measurePsnr(): Promise<void> {
    const { scene, original } = this;
    if (scene === null || original === null) return;
    const { width, height } = scene.metadata;
    if (original.bitmap.width !== width || original.bitmap.height !== height) return;
    try {
      const picture = await this.render({
        size: [height, width],
        ...(scene.hasView && { view: [0, 0, width, height] }),
        ...(scene.hasVisible && { visible: this.visible.map(() => 1) }),
      });
      if (this.original !== original) return;
      this.psnr = psnr(picture, original.pixels);
      this.listener.changed();
    } catch (error) {
      this.listener.failed(`The PSNR could not be measured: ${(error as Error).message}`);
    }
  }

  private take(running: Running): void {
    if (this.provider !== running.provider) this.times.clear();
    this.provider = running.provider;
    if (running.notice !== undefined) this.listener.notice(running.notice);
    this.listener.changed();
  }

  /** A whole picture may be too large for the browser's memory: go on at the size that worked, in a fresh worker. */
  private async failed(error: Error, [height, width]: [number, number]): Promise<void> {
    const { scene, frame, provider } = this;
    const smaller = frame === null ? 0 : frame.bitmap.width * frame.bitmap.height;
    if (scene === null || provider === null || scene.hasView || smaller === 0 || smaller >= height * width) {
      this.listener.failed(`The picture could not be drawn: ${error.message}`);
      return;
    }
    this.maxWholePixels = smaller;
    this.client.stop("the decoder was started anew.");
    const { bytes, metadata } = scene;
    try {
      this.take(await this.client.send<"open">({ kind: "open", bytes, regions: metadata.regionIds.length, provider }));
      this.listener.notice(`There is no memory to draw ${width} × ${height}; the picture is enlarged instead.`);
    } catch (again) {
      this.listener.failed(`The picture could not be drawn: ${(again as Error).message}`);
    }
  }
}

function boxed(scene: Size, side: number): [height: number, width: number] {
  const scale = Math.min(1, side / Math.max(scene.width, scene.height));
  return [Math.max(1, Math.round(scene.height * scale)), Math.max(1, Math.round(scene.width * scale))];
}
