/** The custom element `<kcgs-image>`: an image from a `.kcgs` file. The README beside it says what it takes. */

import type { Scene } from "../decoder/scene.ts";
import type { Device } from "../renderer/painter.ts";
import { listen, zoomAtMiddle } from "./gestures.ts";
import type { Glide } from "./gestures.ts";
import type { Transform } from "./view.ts";
import { oneOf } from "./attribute.ts";
import { listenToClicks } from "./clicks.ts";
import { move, recolor } from "./edits.ts";
import type { Channels, Edit } from "./edits.ts";
import { imageFile, imageSize } from "./image_file.ts";
import type { ImageOptions } from "./image_file.ts";
import { load } from "./loading.ts";
import { ScreenSize } from "./screen_size.ts";
import { Stage } from "./stage.ts";
import { elementStyle, sizeStyle } from "./style.ts";

/** An id of a region, or several. */
export type Ids = number | Iterable<number>;

export interface RegionClick {
  readonly id: number;
  readonly x: number; // in pixels of the scene
  readonly y: number;
}

export class KcgsImage extends HTMLElement {
  static readonly observedAttributes = ["src", "alt", "zoom", "regions", "renderer"];

  private readonly stage: Stage;
  private readonly sizes = new CSSStyleSheet();
  private readonly internals = this.attachInternals();
  private readonly fallback = document.createElement("slot");
  private readonly screenSize: ScreenSize;
  private loaded: Scene | null = null; // as the file has it
  private current: Scene | null = null; // with edits
  private edits: Edit[] = [];
  private readonly hiddenRegions = new Set<number>(); // positions among the ids of regions
  private unread = true; // whether `src` is to be read when the element is part of a page
  private loading: AbortController | null = null;
  private gestures: AbortController | null = null;
  private glide: Glide | null = null;

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    const canvas = document.createElement("canvas");
    canvas.hidden = true;
    root.append(canvas, this.fallback);
    root.adoptedStyleSheets = [elementStyle(), this.sizes];
    this.stage = new Stage(
      canvas,
      () => this.viewChanged(),
      (error) => this.fail(error, false),
    );
    this.screenSize = new ScreenSize(canvas, (width, height) => this.stage.resize(width, height));
    listenToClicks(
      canvas,
      (event) => this.stage.locate(event),
      this,
      (x, y) => this.reportRegion(x, y),
    );
  }

  connectedCallback(): void {
    this.screenSize.observe();
    if (this.unread) this.start();
  }

  disconnectedCallback(): void {
    this.screenSize.disconnect();
    // an interrupted load begins again when the element comes back
    this.unread ||= this.loading !== null;
    this.loading?.abort();
    this.loading = null;
  }

  attributeChangedCallback(name: string, before: string | null, value: string | null): void {
    if (before === value) return;
    if (name === "src") {
      this.unread = true;
      if (this.isConnected) this.start();
    } else if (name === "alt") this.describe();
    else if (name === "zoom") this.listenToGestures();
    else if (name === "regions") this.describe();
    else if (name === "renderer") this.setDevice(value ?? "auto");
  }

  /** The scene that is shown, edits included; one that is set is shown in place of that of `src`. */
  get scene(): Scene | null {
    return this.current;
  }

  set scene(scene: Scene | null) {
    this.unread = false;
    this.loading?.abort();
    this.loading = null;
    this.clear();
    if (scene !== null) this.display(scene);
  }

  /** What rendered last: "webgl2 float32", "webgl2 float16", "cpu", or "" before anything did. */
  get renderer(): string {
    return this.stage.renderer;
  }

  /** The ids of the regions, rising. */
  get regionIds(): number[] {
    return Array.from(this.current?.regions?.ids ?? []);
  }

  /** The point of the scene in the middle of the canvas, and canvas pixels to a pixel of the scene. */
  get view(): Transform {
    return { ...this.stage.transform };
  }

  /** Hide regions, or show them again: what they covered is transparent. */
  hide(ids: Ids, hidden = true): void {
    for (const region of this.positionsOf(ids)) {
      if (hidden) this.hiddenRegions.add(region);
      else this.hiddenRegions.delete(region);
    }
    this.stage.hide(this.hiddenRegions);
  }

  /** Move regions by pixels of the scene, whole ones; what they leave falls to the nearest other region. */
  move(ids: Ids, dx: number, dy: number): void {
    this.edit(move(this.positionsOf(ids), dx, dy));
  }

  /** Multiply the colours of regions by `gain`, a number or one for each channel, and add `bias`. */
  recolor(ids: Ids, gain: Channels, bias: Channels | null = null): void {
    this.edit(recolor(this.positionsOf(ids), gain, bias));
  }

  /** Show the scene as the file has it: nothing hidden, moved or recoloured. */
  reset(): void {
    this.edits = [];
    this.hiddenRegions.clear();
    if (this.loaded !== null) this.display(this.loaded);
  }

  /** Zoom about the middle; 0 shows all. */
  zoomBy(factor: number): void {
    if (!(factor >= 0 && factor < Infinity)) throw new RangeError(`factor must be 0 or more; got ${factor}`);
    if (factor === 0) this.stage.fit();
    else if (this.glide !== null) zoomAtMiddle(this.stage.canvas, this.glide, factor);
    else this.stage.zoom(factor, this.stage.anchorAt(this.stage.size.width / 2, this.stage.size.height / 2));
  }

  /** The id of the region at a point, in pixels of the scene; null where there is none. */
  regionAt(x: number, y: number): number | null {
    const scene = this.current;
    if (scene === null || scene.regions === null) return null;
    if (!(x >= 0 && y >= 0 && x < scene.width && y < scene.height)) return null;
    const { labels, ids } = scene.regions;
    return ids[labels[Math.floor(y) * scene.width + Math.floor(x)]!]!;
  }

  /** The whole image as a file, at its own size or another. */
  async toBlob({ width, height, type = "image/png", quality }: ImageOptions = {}): Promise<Blob> {
    const { current } = this;
    if (current === null) throw new Error("there is no scene yet");
    const size = imageSize(current, width, height);
    return imageFile(this.stage.image(size.width, size.height), type, quality);
  }

  /** Wait until the view no longer moves and is rendered. */
  settled(): Promise<void> {
    return this.stage.settled();
  }

  private start(): void {
    this.unread = false;
    this.loading?.abort();
    this.loading = null;
    this.clear();
    const src = this.getAttribute("src");
    if (src === null || src === "") return;
    const loading = new AbortController();
    this.loading = loading;
    const finish = (notify: () => void): void => {
      if (loading.signal.aborted) return;
      this.loading = null;
      notify();
    };
    load(src, loading.signal, (scene) => this.display(scene)).then(
      () => finish(() => this.dispatchEvent(new Event("load"))),
      (error: unknown) => finish(() => this.fail(error as Error, this.current !== null)),
    );
  }

  private clear(): void {
    this.loaded = this.current = null;
    this.edits = [];
    this.hiddenRegions.clear();
    this.stage.show(null, this.hiddenRegions);
    this.stage.canvas.hidden = true;
    this.fallback.hidden = false;
  }

  /** Display a scene, or one of more layers, with the edits made so far. */
  private display(scene: Scene): void {
    const edited = this.edits.reduce((before, edit) => edit(before), scene);
    this.stage.show(edited, this.hiddenRegions);
    this.loaded = scene;
    this.current = edited;
    this.sizes.replaceSync(sizeStyle(scene.width, scene.height));
    this.stage.canvas.hidden = false;
    this.fallback.hidden = true;
    this.describe();
    this.dispatchEvent(new Event("progress"));
  }

  private edit(edit: Edit): void {
    if (this.current === null) throw new Error("there is no scene yet");
    const edited = edit(this.current);
    this.stage.show(edited, this.hiddenRegions);
    this.current = edited;
    this.edits.push(edit);
  }

  /** Where ids are among those of the scene. */
  private positionsOf(ids: Ids): Set<number> {
    const positions = new Map(this.regionIds.map((id, position) => [id, position]));
    const find = (id: number): number => {
      const position = positions.get(id);
      if (position === undefined) throw new RangeError(`ids must be of the scene's regions; got ${id}`);
      return position;
    };
    return new Set(Array.from(typeof ids === "number" ? [ids] : ids, find));
  }

  private setDevice(value: string): void {
    this.stage.device = oneOf("renderer", value, ["auto", "webgl2", "cpu"] satisfies Device[]);
    this.stage.requestRender();
  }

  /** Dispatch an error; where there is nothing to be seen, show what is inside of the element. */
  private fail(error: Error, shown: boolean): void {
    this.stage.canvas.hidden = !shown;
    this.fallback.hidden = shown;
    const { message } = error;
    this.dispatchEvent(new ErrorEvent("error", { error, message }));
  }

  private describe(): void {
    const alt = this.getAttribute("alt");
    this.internals.role = alt === "" ? "presentation" : "img";
    this.internals.ariaLabel = alt === "" ? null : alt;
    const active = this.hasAttribute("zoom") || this.hasAttribute("regions");
    if (active && !this.hasAttribute("tabindex")) this.tabIndex = 0;
  }

  private listenToGestures(): void {
    this.gestures?.abort();
    this.gestures = this.glide = null;
    this.describe();
    if (!this.hasAttribute("zoom")) return;
    this.gestures = new AbortController();
    const { signal } = this.gestures;
    const wheelNeedsCtrl = this.getAttribute("zoom") === "ctrl";
    const { stage } = this;
    this.glide = listen(stage.canvas, (event) => stage.locate(event), stage, { keyboard: this, wheelNeedsCtrl, signal });
  }

  /** Dispatch `regionclick` for the region at a position on the canvas. */
  private reportRegion(x: number, y: number): void {
    if (!this.hasAttribute("regions")) return;
    const [sceneX, sceneY] = this.stage.anchorAt(x, y).scene;
    const id = this.regionAt(sceneX, sceneY);
    if (id === null) return;
    const detail: RegionClick = { id, x: sceneX, y: sceneY };
    this.dispatchEvent(new CustomEvent("regionclick", { detail, bubbles: true, composed: true }));
  }

  private viewChanged(): void {
    const { canvas, transform } = this.stage;
    const whole = this.current === null || transform.scale * this.current.width <= canvas.width * 1.001;
    // one finger scrolls the page as long as all of the image is there
    canvas.classList.toggle("near", !whole);
    this.dispatchEvent(new Event("viewchange"));
  }
}
