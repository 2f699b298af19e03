/** The divider between original and decoded picture: a slider for pointer and keyboard. */

const STEP = 1;
const LARGE_STEP = 10;

export class Divider {
  private percent = 50;

  constructor(
    private readonly element: HTMLElement,
    private readonly frame: HTMLElement,
    private readonly moved: () => void,
  ) {
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      element.setPointerCapture(event.pointerId);
      element.focus();
      event.preventDefault();
    });
    element.addEventListener("pointermove", (event) => {
      if (!element.hasPointerCapture(event.pointerId)) return;
      const box = this.frame.getBoundingClientRect();
      this.set(((event.clientX - box.left) / box.width) * 100);
    });
    element.addEventListener("keydown", (event) => this.key(event));
    this.show();
  }

  get shown(): boolean {
    return !this.element.hidden;
  }

  set shown(shown: boolean) {
    this.element.hidden = !shown;
  }

  /** Fraction of the width that lies to the left of the divider. */
  get fraction(): number {
    return this.percent / 100;
  }

  set(percent: number): void {
    this.percent = Math.min(Math.max(percent, 0), 100);
    this.show();
    this.moved();
  }

  private show(): void {
    const rounded = Math.round(this.percent);
    this.element.setAttribute("aria-valuenow", String(rounded));
    this.element.setAttribute("aria-valuetext", `${rounded} % original`);
    this.element.style.left = `${this.percent}%`;
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? LARGE_STEP : STEP;
    const to: Record<string, number> = {
      ArrowLeft: this.percent - step,
      ArrowDown: this.percent - step,
      ArrowRight: this.percent + step,
      ArrowUp: this.percent + step,
      PageDown: this.percent - LARGE_STEP,
      PageUp: this.percent + LARGE_STEP,
      Home: 0,
      End: 100,
    };
    const percent = to[event.key];
    if (percent === undefined) return;
    event.preventDefault();
    this.set(percent);
  }
}
