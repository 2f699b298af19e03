/**
 * The page that `kcgs export` and `kcgs view` write: the element in a window of its own, with buttons around it. It runs
 * before the element is defined, so that no event is missed.
 */

import type { KcgsImage } from "./index.ts";

const image = document.querySelector("kcgs-image") as KcgsImage;
const bar = document.querySelector<HTMLElement>("#bar")!;
const list = document.querySelector<HTMLElement>("#regions")!;
const note = document.querySelector<HTMLElement>("#note")!;
const zoom = document.createElement("output");

/** Make an element with properties and children. */
function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Partial<HTMLElementTagNameMap[K]>,
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

function button(text: string, title: string, press: () => void): HTMLButtonElement {
  return make("button", { type: "button", title, ariaLabel: title, onclick: press }, text);
}

// within another page the wheel scrolls that one
if (window.top !== window) image.setAttribute("zoom", "ctrl");
bar.append(
  button("−", "Zoom out (−)", () => image.zoomBy(0.5)),
  zoom,
  button("+", "Zoom in (+)", () => image.zoomBy(2)),
  button("Fit", "Show all (0)", () => image.zoomBy(0)),
);
image.addEventListener("viewchange", () => {
  const { scale } = image.view;
  zoom.value = `${scale < 10 ? scale.toFixed(2) : Math.round(scale)}×`;
});
image.addEventListener("error", ({ message }) => {
  note.textContent = `The scene could not be shown${image.scene === null ? "" : " in full"}: ${message}`;
});
image.addEventListener("load", () => {
  const { scene, regionIds } = image;
  const regions = regionIds.length > 1 ? `, ${regionIds.length} regions` : "";
  note.textContent = `${scene!.width} × ${scene!.height}, ${scene!.count} Gaussians${regions}`;
  if (regionIds.length > 1) listRegions(shares());
});

/** The share of the image that each region has. */
function shares(): Map<number, number> {
  const { labels, ids } = image.scene!.regions!;
  const counts = new Float64Array(ids.length);
  for (const label of labels) counts[label]!++;
  return new Map(Array.from(ids, (id, place) => [id, counts[place]! / labels.length]));
}

function listRegions(areas: Map<number, number>): void {
  const boxes = new Map<number, HTMLInputElement>();
  for (const [id, area] of [...areas].sort((a, b) => b[1] - a[1])) {
    const box = make("input", { type: "checkbox", checked: true, onchange: () => image.hide(id, !box.checked) });
    boxes.set(id, box);
    list.append(make("label", {}, box, `Region ${id} `, make("small", {}, `${(100 * area).toFixed(1)} %`)));
  }
  const toggle = button("Regions", "List the regions, to hide some", () => {
    list.hidden = !list.hidden;
    toggle.ariaExpanded = String(!list.hidden);
  });
  toggle.ariaExpanded = "false";
  bar.append(toggle);
  image.addEventListener("regionclick", ({ detail }) => {
    if (list.hidden) toggle.click();
    boxes.get(detail.id)?.focus();
  });
}
