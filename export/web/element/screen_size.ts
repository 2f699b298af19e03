/** The pixels of the screen that a canvas covers: measured now, and whenever they change. */

// whether the browser reports these pixels itself
const REPORTED = "devicePixelContentBoxSize" in ResizeObserverEntry.prototype;

export class ScreenSize {
  private readonly observer = new ResizeObserver((entries) => this.measure(entries.at(-1)!));
  private density: AbortController | null = null; // of the listener to the screen's pixels per CSS pixel

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly onResize: (width: number, height: number) => void,
  ) {}

  observe(): void {
    this.disconnect();
    this.density = new AbortController();
    const { signal } = this.density;
    matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", () => this.observe(), { signal });
    this.observer.observe(this.canvas, { box: REPORTED ? "device-pixel-content-box" : "content-box" });
  }

  disconnect(): void {
    this.density?.abort();
    this.observer.disconnect();
  }

  private measure(entry: ResizeObserverEntry): void {
    if (this.canvas.hidden) return;
    const [size, exact] = [entry.contentBoxSize[0]!, REPORTED ? entry.devicePixelContentBoxSize[0]! : null];
    const pixels = (length: number, reported = NaN): number => {
      const estimate = length * devicePixelRatio;
      // a browser that emulates another screen reports the pixels of its own
      return Math.max(1, Math.abs(reported - estimate) < 1 ? reported : Math.round(estimate));
    };
    this.onResize(pixels(size.inlineSize, exact?.inlineSize), pixels(size.blockSize, exact?.blockSize));
  }
}
