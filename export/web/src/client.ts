/** The page's end of the worker: commands out, promises back. */

import type { Command, Reply, Results } from "./protocol.ts";

interface Waiting {
  resolve(result: unknown): void;
  reject(error: Error): void;
}

export class Client {
  private worker: Worker | null = null;
  private readonly waiting = new Map<number, Waiting>();
  private nextId = 0;

  send<K extends Command["kind"]>(command: Extract<Command, { kind: K }>): Promise<Results[K]> {
    this.worker ??= this.start();
    const id = this.nextId++;
    const { worker } = this;
    return new Promise<Results[K]>((resolve, reject) => {
      this.waiting.set(id, { resolve: (result) => resolve(result as Results[K]), reject });
      worker.postMessage({ id, ...command });
    });
  }

  /** Leave a worker whose runtime ran out of memory behind; the next command starts a fresh one. */
  stop(reason: string): void {
    this.worker?.terminate();
    this.worker = null;
    for (const { reject } of this.waiting.values()) reject(new Error(reason));
    this.waiting.clear();
  }

  private start(): Worker {
    const worker = new Worker(new URL("./worker.ts", import.meta.url), { type: "module" });
    worker.onmessage = ({ data }: MessageEvent<Reply>) => {
      const waiting = this.waiting.get(data.id);
      this.waiting.delete(data.id);
      if ("error" in data) waiting?.reject(new Error(data.error));
      else waiting?.resolve(data.result);
    };
    worker.onerror = (event) => {
      this.stop(event.message || "the decoder's worker could not be started; reload the page.");
    };
    return worker;
  }
}
