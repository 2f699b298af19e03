/**
 * onnxruntime-web, in the build that a provider needs. The build with WebGPU could run WASM too, but it is twice as
 * large and lacks operators on doubles and 16-bit integers; so each provider loads its own, and only when it is used.
 */

import type * as Ort from "onnxruntime-web";
import gpuGlue from "onnxruntime-web/ort-wasm-simd-threaded.asyncify.mjs?url";
import gpuWasm from "onnxruntime-web/ort-wasm-simd-threaded.asyncify.wasm?url";
import wasmGlue from "onnxruntime-web/ort-wasm-simd-threaded.mjs?url";
import wasmWasm from "onnxruntime-web/ort-wasm-simd-threaded.wasm?url";

import type { Provider } from "./protocol.ts";

export type Runtime = typeof Ort;

const MAX_THREADS = 4;

export async function loadRuntime(provider: Provider): Promise<Runtime> {
  if (provider === "webgpu") return configured(await import("onnxruntime-web/webgpu"), gpuGlue, gpuWasm);
  return configured(await import("onnxruntime-web/wasm"), wasmGlue, wasmWasm);
}

function configured(ort: Runtime, glue: string, wasm: string): Runtime {
  // Relative to this module, so that the page may lie in any folder of a server.
  ort.env.wasm.wasmPaths = { mjs: new URL(glue, import.meta.url).href, wasm: new URL(wasm, import.meta.url).href };
  // Threads need shared memory, which a browser grants only to isolated pages.
  ort.env.wasm.numThreads = globalThis.crossOriginIsolated ? Math.min(MAX_THREADS, navigator.hardwareConcurrency) : 1;
  ort.env.logLevel = "error";
  return ort;
}
