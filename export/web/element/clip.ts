/** The page of a clip: that of a scene, with a player. */

import { bar, describe, image, listRegions } from "./page.ts";
import { loadClip, Player } from "./player.ts";

try {
  const clip = await loadClip(image.dataset["clip"]!);
  const player = new Player(image, clip);
  bar.prepend(player.button, player.slider, player.time);
  image.addEventListener("progress", listRegions);
  player.show(0);
  if (image.scene !== null) {
    const whole = clip.frames === 1 ? "1 whole frame" : `${clip.frames} whole frames`;
    const early = clip.complete ? "" : ` (the clip ends early, after ${whole})`;
    describe(`${clip.frames} frames, ${Number(clip.frameRate.toFixed(3))} per second${early}`);
    if (clip.frames > 1 && !matchMedia("(prefers-reduced-motion: reduce)").matches) player.toggle();
  }
} catch (error) {
  image.dispatchEvent(new ErrorEvent("error", { error, message: (error as Error).message }));
}
