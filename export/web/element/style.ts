/** The element's style. Style sheets made by script work under any Content-Security-Policy. */

const STYLE = `
:host { display: inline-block; max-width: 100%; vertical-align: bottom; outline-offset: 2px; }
:host([hidden]) { display: none; }
canvas { display: block; width: 100%; height: 100%; }
canvas[hidden], slot[hidden] { display: none; }
:host([zoom]) canvas { cursor: zoom-in; touch-action: pan-x pan-y; }
:host([zoom]) canvas.near { cursor: grab; touch-action: none; }
:host([zoom]) canvas.dragged { cursor: grabbing; }
:host([regions]:not([zoom])) canvas { cursor: pointer; }
`;

let shared: CSSStyleSheet | null = null;

export function elementStyle(): CSSStyleSheet {
  if (shared === null) {
    shared = new CSSStyleSheet();
    shared.replaceSync(STYLE);
  }
  return shared;
}

/** As large as an image element would be, unless the page says otherwise. */
export function sizeStyle(width: number, height: number): string {
  return `:host { width: ${width}px; aspect-ratio: ${width} / ${height}; }`;
}
