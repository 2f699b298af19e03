/** Elements of the page. */

/** Make an element with properties and children. */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Partial<HTMLElementTagNameMap[K]>,
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

export function button(text: string, title: string, press: () => void): HTMLButtonElement {
  return make("button", { type: "button", title, ariaLabel: title, onclick: press }, text);
}
