/** The panel beside the picture: facts, regions, what the export left out. */

import type { Viewer } from "./viewer.ts";

const EM_DASH = "—";

export class FactsPanel {
  private shown = "";

  constructor(
    private readonly list: HTMLElement,
    private readonly leftOut: HTMLElement,
    private readonly wholeNote: HTMLElement,
  ) {}

  show(viewer: Viewer): void {
    const { scene, original } = viewer;
    if (scene === null) return;
    const { metadata, bytes } = scene;
    const pixels = metadata.width * metadata.height;
    const median = viewer.times.median;
    const facts: [term: string, detail: string, hint?: string][] = [
      ["Gaussians", metadata.numGaussians.toLocaleString("en")],
      ["Regions", regions(metadata.numRegions, metadata.contours)],
      ["Scene", `${metadata.width} × ${metadata.height}`],
      ["File", fileSize(bytes.length), `${bytes.length.toLocaleString("en")} bytes`],
      ["Bits per pixel", ((8 * bytes.length) / pixels).toFixed(2), "of the whole file"],
      ["PSNR", decibel(viewer), viewer.psnr === null ? "" : "at the scene's size"],
      ["Drawn by", viewer.provider === "webgpu" ? "WebGPU" : threads()],
      ["Per frame", median === null ? EM_DASH : `${significant(median)} ms`, "median of the last 10"],
      ["Precision", metadata.precision || EM_DASH],
    ];
    if (metadata.recipe !== "") facts.splice(2, 0, ["Recipe", metadata.recipe]);
    if (original !== null) facts.push(["Original", `${original.bitmap.width} × ${original.bitmap.height}`, original.name]);
    const limit = scene.hasView ? null : viewer.maxWholePixels;
    const shown = JSON.stringify([facts, metadata.leftOut, limit]);
    // Rows that did not change stay, so that their text can be selected while frames are drawn.
    if (shown === this.shown) return;
    this.shown = shown;
    this.list.replaceChildren(...facts.flatMap(([term, detail, hint]) => row(term, detail, hint)));
    this.wholeNote.hidden = limit === null;
    if (limit !== null) {
      this.wholeNote.textContent =
        `This decoder draws whole pictures only, here up to ${(limit / 1e6).toLocaleString("en", { maximumFractionDigits: 1 })} megapixels; beyond that they ` +
        "are enlarged. An interactive export draws any part at full resolution.";
    }
    this.leftOut.replaceChildren(
      ...(metadata.leftOut.length === 0 ? ["Nothing."] : metadata.leftOut).map((text) => element("li", text)),
    );
  }
}

export class RegionsPanel {
  private boxes: HTMLInputElement[] = [];
  private thumbnails: HTMLCanvasElement[] = [];

  constructor(
    private readonly list: HTMLElement,
    private readonly note: HTMLElement,
    private readonly buttons: HTMLElement,
    private readonly toggled: (visible: number[]) => void,
  ) {
    buttons.querySelector("[data-show=all]")!.addEventListener("click", () => this.setAll(true));
    buttons.querySelector("[data-show=none]")!.addEventListener("click", () => this.setAll(false));
  }

  /** List the regions of a decoder that has just been opened, all of them visible. */
  show(viewer: Viewer): void {
    const { scene } = viewer;
    const able = scene?.hasVisible === true;
    this.note.hidden = able;
    this.buttons.hidden = !able;
    this.boxes = [];
    this.thumbnails = [];
    this.list.replaceChildren();
    if (scene === null || !able) return;
    for (const id of scene.metadata.regionIds) {
      const label = element("label", "");
      const box = element("input", "");
      box.type = "checkbox";
      box.checked = true;
      box.addEventListener("change", () => this.tell());
      const thumbnail = element("canvas", "");
      thumbnail.setAttribute("aria-hidden", "true");
      label.append(box, thumbnail, element("span", `Region ${id}`));
      const item = element("li", "");
      item.append(label);
      this.list.append(item);
      this.boxes.push(box);
      this.thumbnails.push(thumbnail);
    }
  }

  thumbnail(region: number, bitmap: ImageBitmap): void {
    const canvas = this.thumbnails[region];
    if (canvas === undefined) return;
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    canvas.getContext("2d")!.drawImage(bitmap, 0, 0);
    bitmap.close();
  }

  private setAll(checked: boolean): void {
    for (const box of this.boxes) box.checked = checked;
    this.tell();
  }

  private tell(): void {
    this.toggled(this.boxes.map((box) => Number(box.checked)));
  }
}

function decibel({ psnr, original, scene }: Viewer): string {
  if (psnr !== null) return psnr === Infinity ? "∞ (equal)" : `${psnr.toFixed(2)} dB`;
  if (original === null) return "needs the original";
  const same = original.bitmap.width === scene!.metadata.width && original.bitmap.height === scene!.metadata.height;
  return same ? "…" : "original has another size";
}

function threads(): string {
  return crossOriginIsolated ? "WASM, threads" : "WASM, one thread";
}

function regions(count: number, contours: string): string {
  return count === 1 && contours === "none" ? "1" : `${count.toLocaleString("en")}, ${contours} contours`;
}

function fileSize(bytes: number): string {
  if (bytes < 1000) return `${bytes} B`;
  return bytes < 1e6 ? `${significant(bytes / 1e3)} kB` : `${significant(bytes / 1e6)} MB`;
}

function significant(value: number): string {
  return value >= 100 ? Math.round(value).toLocaleString("en") : value.toPrecision(2 + Number(value >= 10));
}

function row(term: string, detail: string, hint?: string): HTMLElement[] {
  const definition = element("dd", detail);
  if (hint) definition.append(element("small", hint));
  return [element("dt", term), definition];
}

function element<K extends keyof HTMLElementTagNameMap>(name: K, text: string): HTMLElementTagNameMap[K] {
  const node = document.createElement(name);
  node.textContent = text;
  return node;
}
