/** Wires the page: files and addresses in, gestures to the viewer, the viewer's news to the page. */

import "./panel.css";

import { Divider } from "./compare.ts";
import { listen, zoomAtMiddle } from "./gestures.ts";
import type { SceneMetadata } from "./metadata.ts";
import { readOriginal } from "./original.ts";
import { FactsPanel, RegionsPanel } from "./panel.ts";
import type { Provider, RenderRequest } from "./protocol.ts";
import { fetchBlob, fileName, readExamples, sameOrigin } from "./sources.ts";
import type { Example } from "./sources.ts";
import type { Part } from "./view.ts";
import { Viewer } from "./viewer.ts";

/** What a script, or a test, may do with the page. */
interface Api {
  ready: Promise<void>;
  open(source: Uint8Array | ArrayBuffer | string): Promise<void>;
  render(request: RenderRequest): Promise<{ data: Float32Array; dims: readonly number[] }>;
  settled(): Promise<void>;
  readonly metadata: SceneMetadata | null;
  readonly scale: number;
  readonly part: Part | null;
  readonly psnr: number | null;
}

declare global {
  interface Window {
    kcgs: Api;
  }
}

const get = <T extends HTMLElement>(id: string): T => document.getElementById(id) as T;
const stage = get("stage");
const canvas = get<HTMLCanvasElement>("picture");
const providers = get<HTMLSelectElement>("provider");
const compare = get<HTMLInputElement>("compare");
const originalFile = get<HTMLInputElement>("original-file");

const divider = new Divider(get("divider"), stage, () => viewer.paint());
const facts = new FactsPanel(get("facts"), get("left-out"), get("whole-note"));
const regions = new RegionsPanel(get("regions"), get("regions-note"), get("regions-buttons"), (visible) =>
  viewer.setVisible(visible),
);
const viewer = new Viewer(canvas, () => (divider.shown ? divider.fraction : null), {
  changed: showFacts,
  moved: showZoom,
  drawing: (drawing) => stage.classList.toggle("drawing", drawing),
  notice: (text) => (get("status").textContent = text),
  failed: showAlert,
  thumbnail: (region, bitmap) => regions.thumbnail(region, bitmap),
});
const glide = listen(canvas, (event) => viewer.stage.at(event), viewer);

/** Counts what was asked to be opened: of several that load at once, the last one stays. */
let turn = 0;

async function openDecoder(name: string, read: () => Promise<Blob | Uint8Array>): Promise<void> {
  const mine = ++turn;
  stage.classList.add("opening");
  try {
    const source = await read();
    const bytes = source instanceof Blob ? new Uint8Array(await source.arrayBuffer()) : source;
    if (mine !== turn) return;
    get("status").textContent = "";
    await viewer.open(bytes, providers.value as Provider);
    hideAlert();
    showScene(name);
  } catch (error) {
    const message = `Could not open ${name}: ${(error as Error).message}`;
    showAlert(message);
    throw new Error(message);
  } finally {
    if (mine === turn) stage.classList.remove("opening");
  }
}

async function openOriginal(name: string, read: () => Promise<Blob>): Promise<void> {
  const { scene } = viewer;
  try {
    const original = await readOriginal(await read(), name);
    if (scene === null || scene !== viewer.scene) return;
    viewer.setOriginal(original);
    compare.checked = true;
    showCompare();
  } catch (error) {
    showAlert(`Could not open ${name}: ${(error as Error).message}`);
  }
}

/** Open both by address. The decoder's failure is told already, and without it there is nothing to compare. */
async function openAddresses(decoder: string, original: string | null): Promise<void> {
  await openDecoder(decoder, () => fetchBlob(sameOrigin(decoder)));
  if (original !== null) await openOriginal(original, () => fetchBlob(sameOrigin(original)));
}

async function openFiles(files: Iterable<File>): Promise<void> {
  const [images, others] = [[], []] as [File[], File[]];
  for (const file of files) (file.type.startsWith("image/") ? images : others).push(file);
  if (others[0] !== undefined) await openDecoder(others[0].name, () => Promise.resolve(others[0]!));
  if (images[0] === undefined) return;
  if (viewer.scene === null) showAlert(`Open a decoder first: ${images[0].name} is an original to compare it with.`);
  else await openOriginal(images[0].name, () => Promise.resolve(images[0]!));
}

const told = (): undefined => undefined; // The alert already says it.

function showScene(name: string): void {
  get("scene-name").textContent = name;
  document.title = `${name} · kcgs`;
  get("welcome").hidden = true;
  originalFile.disabled = false;
  for (const hidden of document.querySelectorAll<HTMLElement>("[data-with-scene]")) hidden.hidden = false;
  for (const button of document.querySelectorAll("#examples button")) button.removeAttribute("aria-current");
  regions.show(viewer);
  viewer.drawThumbnails();
  showFacts();
  showCompare();
}

let factsDue = false;
function showFacts(): void {
  if (factsDue) return;
  factsDue = true;
  requestAnimationFrame(() => {
    factsDue = false;
    facts.show(viewer);
  });
}

function showZoom(): void {
  const { scale } = viewer.transform;
  get("zoom").textContent = `${scale >= 100 ? scale.toFixed(0) : scale.toPrecision(scale >= 1 ? 3 : 2)}×`;
}

function showCompare(): void {
  get("compare-section").hidden = viewer.original === null;
  divider.shown = viewer.original !== null && compare.checked;
  viewer.paint();
}

function showAlert(text: string): void {
  get("alert").hidden = false;
  get("alert-text").textContent = text;
}

function hideAlert(): void {
  get("alert").hidden = true;
  get("alert-text").textContent = "";
}

async function chooseProvider(): Promise<void> {
  const adapter = await navigator.gpu?.requestAdapter().catch(() => null);
  if (adapter == null) return;
  const option = providers.options[0]!;
  option.disabled = false;
  // A processor that acts as a GPU is slower than the same processor with WASM.
  const software = adapter.info?.isFallbackAdapter === true;
  option.textContent = software ? "WebGPU (in software)" : "WebGPU";
  if (!software) providers.value = "webgpu";
}

function listExamples(examples: Example[]): void {
  if (examples.length > 0) get("panel").hidden = get("examples-section").hidden = false;
  for (const example of examples) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = example.name;
    const note = document.createElement("small");
    note.textContent = example.note;
    button.append(note);
    button.addEventListener("click", () => void openExample(example, button).catch(told));
    const item = document.createElement("li");
    item.append(button);
    get("examples").append(item);
  }
}

async function openExample(example: Example, button: HTMLElement): Promise<void> {
  await openDecoder(example.name, () => fetchBlob(sameOrigin(example.decoder)));
  button.setAttribute("aria-current", "true");
  const { original } = example;
  if (original !== null) await openOriginal(fileName(new URL(original)), () => fetchBlob(sameOrigin(original)));
}

async function start(): Promise<void> {
  const [examples] = await Promise.all([readExamples(), chooseProvider()]);
  listExamples(examples);
  const query = new URLSearchParams(location.search);
  const decoder = query.get("decoder");
  if (decoder !== null) await openAddresses(decoder, query.get("original")).catch(told);
  else if (examples[0] !== undefined) {
    await openExample(examples[0], document.querySelector<HTMLElement>("#examples button")!).catch(told);
  }
}

function pick(input: HTMLInputElement): void {
  input.addEventListener("change", () => {
    void openFiles([...(input.files ?? [])]).catch(told);
    input.value = ""; // So that choosing the same file again is a change.
  });
}

function listenToDrops(): void {
  addEventListener("dragover", (event) => {
    event.preventDefault();
    stage.classList.add("dragging");
  });
  addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) stage.classList.remove("dragging");
  });
  addEventListener("drop", (event) => {
    event.preventDefault();
    stage.classList.remove("dragging");
    void openFiles(event.dataTransfer?.files ?? []).catch(told);
  });
}

pick(get("decoder-file"));
pick(originalFile);
listenToDrops();
get("dismiss").addEventListener("click", hideAlert);
get("zoom-in").addEventListener("click", () => zoomAtMiddle(canvas, glide, 2));
get("zoom-out").addEventListener("click", () => zoomAtMiddle(canvas, glide, 0.5));
get("fit").addEventListener("click", () => viewer.fit());
get("native").addEventListener("click", () => viewer.native());
compare.addEventListener("change", showCompare);
providers.addEventListener("change", () => {
  get("status").textContent = "";
  viewer.switchTo(providers.value as Provider).catch((error: Error) => showAlert(error.message));
});

window.kcgs = {
  ready: start(),
  open: async (source) => {
    if (typeof source === "string") await openAddresses(source, null);
    else await openDecoder("the given bytes", () => Promise.resolve(new Uint8Array(source)));
    await viewer.settled();
  },
  render: (request) => viewer.render(request),
  settled: () => viewer.settled(),
  get metadata() {
    return viewer.scene?.metadata ?? null;
  },
  get scale() {
    return viewer.transform.scale;
  },
  get part() {
    return viewer.part();
  },
  get psnr() {
    return viewer.psnr;
  },
};
