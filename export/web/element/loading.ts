/** Scenes from an address, as their bytes arrive. */

import { type DecodeError, ProgressiveDecoder, type Scene } from "../decoder/index.ts";

/** Read an address; `onScene` takes each scene of more whole layers. Damage is an error, after the whole layers. */
export async function load(src: string, signal: AbortSignal, onScene: (scene: Scene) => void): Promise<void> {
  const decoder = new ProgressiveDecoder();
  for await (const bytes of chunks(src, signal)) {
    const scene = decoder.push(bytes);
    if (signal.aborted) return;
    if (scene !== null) onScene(scene);
    if (decoder.error !== null) throw decoder.error satisfies DecodeError;
  }
  decoder.finish();
}

async function* chunks(src: string, signal: AbortSignal): AsyncGenerator<Uint8Array> {
  const url = new URL(src, document.baseURI);
  // not fetched, so that a page may forbid all connections
  if (url.protocol === "data:") return yield dataBytes(url.href);
  const response = await fetch(url, { signal });
  if (!response.ok) throw new Error(`the server answers ${response.status} ${response.statusText}`.trim());
  const reader = response.body!.getReader();
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      yield value;
    }
  } finally {
    // of a file that is damaged the rest is not asked for
    reader.cancel().catch(() => {});
  }
}

function dataBytes(address: string): Uint8Array {
  const comma = address.indexOf(",");
  if (!address.slice(0, comma).endsWith(";base64")) throw new Error("a data: address must be base64");
  return Uint8Array.from(atob(decodeURIComponent(address.slice(comma + 1))), (character) => character.charCodeAt(0));
}
