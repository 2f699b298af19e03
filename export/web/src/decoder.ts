/** A decoder's onnxruntime-web session: creating it, running it, and going on in WASM where WebGPU fails. */

import type { InferenceSession, Tensor } from "onnxruntime-web";

import type { Picture } from "./pixels.ts";
import type { Provider, RenderRequest, Running } from "./protocol.ts";
import type { Runtime } from "./runtime.ts";
import { loadRuntime } from "./runtime.ts";

const LOG_ERRORS = 3;

interface Session {
  ort: Runtime;
  session: InferenceSession;
}

export class Decoder {
  private constructor(
    private readonly bytes: Uint8Array,
    private readonly regions: number,
    private running: Session,
    public provider: Provider,
    private notice: string | undefined,
  ) {}

  /** Create a session and draw a few pixels with it: a model that loads may still fail to run. */
  static async open(bytes: Uint8Array, regions: number, provider: Provider): Promise<Decoder> {
    let decoder: Decoder;
    try {
      decoder = new Decoder(bytes, regions, await createSession(bytes, provider), provider, undefined);
    } catch (error) {
      if (provider === "wasm") throw error;
      decoder = new Decoder(bytes, regions, await createSession(bytes, "wasm"), "wasm", fallbackNotice(error));
    }
    try {
      await decoder.run({ size: [4, 4] });
    } catch (error) {
      await decoder.release();
      throw error;
    }
    return decoder;
  }

  get inputs(): readonly string[] {
    return this.running.session.inputNames;
  }

  /** Which provider runs, with the notice of a change exactly once. */
  takeRunning(): Running {
    const { provider, notice } = this;
    this.notice = undefined;
    return notice === undefined ? { provider } : { provider, notice };
  }

  async run(request: RenderRequest): Promise<Picture & { milliseconds: number }> {
    let start = performance.now();
    let output: Tensor | undefined;
    try {
      output = (await this.running.session.run(this.feeds(request))).image;
    } catch (error) {
      if (this.provider === "wasm") throw new Error(`it could not be run: ${reason(error)}`);
      const broken = this.running.session;
      this.running = await createSession(this.bytes, "wasm");
      this.provider = "wasm";
      this.notice = fallbackNotice(error);
      void broken.release().catch(() => undefined);
      start = performance.now();
      output = (await this.running.session.run(this.feeds(request))).image;
    }
    const milliseconds = performance.now() - start;
    if (output?.type !== "float32" || output.dims.length !== 4) {
      throw new Error("its output is not a float32 `image` of shape (1, C, H, W).");
    }
    return { data: output.data as Float32Array, dims: output.dims, milliseconds };
  }

  async release(): Promise<void> {
    await this.running.session.release();
  }

  private feeds(request: RenderRequest): Record<string, Tensor> {
    const { ort } = this.running;
    const feeds: Record<string, Tensor> = {
      size: new ort.Tensor("int64", BigInt64Array.from(request.size.map((n) => BigInt(Math.round(n)))), [2]),
    };
    for (const name of ["view", "visible"] as const) {
      const given = request[name];
      if (this.inputs.includes(name)) {
        const values = Float32Array.from(given ?? (name === "view" ? [0, 0, 1, 1] : Array(this.regions).fill(1)));
        feeds[name] = new ort.Tensor("float32", values, [values.length]);
      } else if (given !== undefined) {
        throw new Error(`this decoder has no input \`${name}\`; it was exported without --interactive.`);
      }
    }
    return feeds;
  }
}

async function createSession(bytes: Uint8Array, provider: Provider): Promise<Session> {
  const ort = await loadRuntime(provider);
  const options = { executionProviders: [provider], logSeverityLevel: LOG_ERRORS } as const;
  const session = await ort.InferenceSession.create(bytes, options).catch((error) => {
    throw new Error(`it could not be loaded: ${reason(error)}`);
  });
  if (!session.inputNames.includes("size") || !session.outputNames.includes("image")) {
    await session.release();
    throw new Error("it lacks the input `size` or the output `image` of a kcgs decoder.");
  }
  return { ort, session };
}

function fallbackNotice(error: unknown): string {
  return `WebGPU could not run this decoder, so WASM draws it (${reason(error)}).`;
}

/** What an error says, without where in onnxruntime's sources it was raised. */
function reason(error: unknown): string {
  const text = error instanceof Error ? error.message : String(error);
  return text.replace(/^.*ERROR_MESSAGE: /s, "").split("\n", 1)[0]!.replace(/^\/.* was false\. /, "").trim();
}
