/** Plays a clip in an element, by the clock, with a button and a slider. */

import { type Clip, DecodeError, isClip, openClip } from "../decoder/clips/index.ts";
import { Growing } from "../decoder/growing.ts";
import { button, make } from "./controls.ts";
import type { KcgsImage } from "./index.ts";
import { chunks } from "./loading.ts";

// seconds that a clip goes on by at most, however long the last frame took: then it plays more slowly
const LONGEST = 0.2;

export async function loadClip(address: string): Promise<Clip> {
  const bytes = new Growing<Uint8Array>(new Uint8Array(0));
  for await (const more of chunks(address, new AbortController().signal)) bytes.add(more);
  if (!isClip(bytes.all())) throw new DecodeError("the file is no clip");
  return openClip(bytes.all());
}

export class Player {
  readonly button = button("▶", "Play", () => this.toggle());
  readonly slider: HTMLInputElement;
  readonly time = make("output", {});
  private position = 0; // in frames
  private last = 0; // when it was changed by the clock, in milliseconds
  private playing = false;

  constructor(
    private readonly image: KcgsImage,
    private readonly clip: Clip,
  ) {
    const max = String(clip.frames - 1);
    this.slider = make("input", { type: "range", max, value: "0", ariaLabel: "Frame" });
    this.slider.oninput = () => this.show(Number(this.slider.value));
  }

  /** Show a frame, from 0. */
  show(number: number): void {
    this.position = number;
    try {
      this.image.show(this.clip.frame(number));
    } catch (error) {
      this.set(false);
      const { message } = error as Error;
      this.image.dispatchEvent(new ErrorEvent("error", { error, message }));
    }
    this.slider.value = String(number);
    this.time.value = `${(number / this.clip.frameRate).toFixed(2)} s`;
  }

  /** Play, from the beginning if it is at the end; or pause. */
  toggle(): void {
    if (!this.playing && this.position >= this.clip.frames - 1) this.show(0);
    this.set(!this.playing);
  }

  private set(playing: boolean): void {
    this.playing = playing;
    const title = playing ? "Pause" : "Play";
    Object.assign(this.button, { textContent: playing ? "❚❚" : "▶", title, ariaLabel: title });
    if (!playing) return;
    this.last = performance.now();
    requestAnimationFrame(() => this.tick());
  }

  private tick(): void {
    if (!this.playing) return;
    const now = performance.now();
    const end = this.clip.frames - 1;
    const next = Math.min(this.position + Math.min((now - this.last) / 1000, LONGEST) * this.clip.frameRate, end);
    this.last = now;
    if (Math.floor(next) > Math.floor(this.position)) this.show(Math.floor(next));
    this.position = next;
    if (next >= end) this.set(false);
    else if (this.playing) requestAnimationFrame(() => this.tick());
  }
}
