/** Inference off the page's thread: one command at a time, in the order in which they come. */

import { Decoder } from "./decoder.ts";
import { toRgba } from "./pixels.ts";
import type { Command, Message, Reply, Results } from "./protocol.ts";

// The DOM's types know a worker's own scope only as a window.
const scope = self as unknown as {
  onmessage: ((event: MessageEvent<Message>) => void) | null;
  postMessage(reply: Reply, transfer: Transferable[]): void;
};

let decoder: Decoder | null = null;
let opened: Extract<Command, { kind: "open" }> | null = null;
let last: Promise<void> = Promise.resolve();

scope.onmessage = ({ data }) => {
  last = last.then(() => answer(data));
};

async function answer(message: Message): Promise<void> {
  try {
    const result = await obey(message);
    const transfer: Transferable[] = [];
    if ("bitmap" in result) transfer.push(result.bitmap);
    if ("data" in result) transfer.push(result.data.buffer);
    scope.postMessage({ id: message.id, result }, transfer);
  } catch (error) {
    scope.postMessage({ id: message.id, error: error instanceof Error ? error.message : String(error) }, []);
  }
}

async function obey(command: Command): Promise<Results[keyof Results]> {
  switch (command.kind) {
    case "open": {
      const next = await Decoder.open(command.bytes, command.regions, command.provider);
      await replace(next);
      opened = command;
      return { ...next.takeRunning(), inputs: next.inputs };
    }
    case "switch": {
      if (opened === null) throw new Error("no decoder is open.");
      const next = await Decoder.open(opened.bytes, opened.regions, command.provider);
      await replace(next);
      return next.takeRunning();
    }
    case "frame": {
      const open = current();
      const picture = await open.run(command.request);
      const bitmap = await createImageBitmap(toRgba(picture));
      return { ...open.takeRunning(), bitmap, milliseconds: picture.milliseconds };
    }
    case "image": {
      const open = current();
      const { data, dims, milliseconds } = await open.run(command.request);
      return { ...open.takeRunning(), data: Float32Array.from(data), dims, milliseconds };
    }
  }
}

function current(): Decoder {
  if (decoder === null) throw new Error("no decoder is open.");
  return decoder;
}

async function replace(next: Decoder): Promise<void> {
  const before = decoder;
  decoder = next;
  await before?.release();
}
