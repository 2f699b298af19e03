/** One inference at a time: of the views asked for, the newest; other work only when no view waits. */

/** Longest a frame may take while the picture moves, in milliseconds: about 25 frames a second. */
const MOVING_BUDGET = 40;
const MAX_DIVISOR = 8;
const KEPT_TIMES = 10;

export class FrameQueue {
  private wanted = false;
  private readonly tasks: (() => Promise<void>)[] = [];
  private urgent = 0;
  private running = false;
  private readonly waiting: (() => void)[] = [];

  /** `draw` draws the view of the moment when it is called: views that came and went meanwhile cost nothing. */
  constructor(private readonly draw: () => Promise<void>) {}

  want(): void {
    this.wanted = true;
    void this.pump();
  }

  /** Run work of another kind when no view waits; urgent work goes before other work. */
  task<T>(work: () => Promise<T>, urgent = false): Promise<T> {
    return new Promise((resolve, reject) => {
      const task = (): Promise<void> => work().then(resolve, reject);
      // Urgent tasks among themselves keep their order: of two files opened at once the last one stays.
      if (urgent) this.tasks.splice(this.urgent++, 0, task);
      else this.tasks.push(task);
      void this.pump();
    });
  }

  /** Wait until nothing runs and nothing waits. */
  idle(): Promise<void> {
    return this.running ? new Promise((resolve) => this.waiting.push(resolve)) : Promise.resolve();
  }

  private async pump(): Promise<void> {
    if (this.running) return;
    this.running = true;
    for (;;) {
      if (this.wanted) {
        this.wanted = false;
        await this.draw();
      } else {
        const task = this.tasks.shift();
        if (task === undefined) break;
        this.urgent = Math.max(0, this.urgent - 1);
        await task();
      }
    }
    this.running = false;
    for (const resolve of this.waiting.splice(0)) resolve();
  }
}

/** How long frames take, and by how much to divide their resolution while the picture moves. */
export class FrameTimes {
  private times: number[] = [];
  private costPerPixel = 0;

  constructor(private readonly budget = MOVING_BUDGET) {}

  add(milliseconds: number, pixels: number): void {
    this.times = [...this.times, milliseconds].slice(-KEPT_TIMES);
    const cost = milliseconds / pixels;
    this.costPerPixel = this.costPerPixel === 0 ? cost : (this.costPerPixel + cost) / 2;
  }

  clear(): void {
    this.times = [];
    this.costPerPixel = 0;
  }

  get median(): number | null {
    if (this.times.length === 0) return null;
    const sorted = this.times.toSorted((a, b) => a - b);
    const middle = sorted.length >> 1;
    return sorted.length % 2 ? sorted[middle]! : (sorted[middle - 1]! + sorted[middle]!) / 2;
  }

  divisorFor(pixels: number): number {
    const wanted = Math.ceil(Math.sqrt((pixels * this.costPerPixel) / this.budget));
    return Math.min(Math.max(wanted, 1), MAX_DIVISOR);
  }
}
