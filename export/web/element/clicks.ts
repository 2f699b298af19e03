/** Clicks on the image, and the key Enter, as positions on the canvas. */

import type { Locate } from "./gestures.ts";

// a press that moves farther, in CSS pixels, is no click
const CLICK = 5;

/** Report each click; Enter, where `keyboard` has the focus, is one in the middle. */
export function listenToClicks(
  canvas: HTMLCanvasElement,
  locate: Locate,
  keyboard: HTMLElement,
  onClick: (x: number, y: number) => void,
): void {
  let press: [number, number] = [0, 0];
  canvas.addEventListener("pointerdown", (event) => (press = [event.clientX, event.clientY]));
  canvas.addEventListener("click", (event) => {
    if (Math.hypot(event.clientX - press[0], event.clientY - press[1]) < CLICK) onClick(...locate(event));
  });
  keyboard.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target === keyboard) onClick(canvas.width / 2, canvas.height / 2);
  });
}
