import { defineConfig } from "vite";

// Some static servers know no type for .mjs, and a browser refuses a module without one.
const assetName = (names: string[]): string =>
  names.some((name) => name.endsWith(".mjs")) ? "assets/[name]-[hash].js" : "assets/[name]-[hash][extname]";

export default defineConfig({
  base: "./",
  // The builds of onnxruntime-web whose glue and .wasm are files of their own: threads start from the glue's URL,
  // which must not be that of our worker.
  resolve: { conditions: ["onnxruntime-web-use-extern-wasm", "module", "browser", "development|production"] },
  worker: {
    format: "es",
    rolldownOptions: { output: { assetFileNames: (asset) => assetName(asset.names) } },
  },
  build: {
    target: "es2022",
    assetsInlineLimit: 0,
    chunkSizeWarningLimit: 1000,
    rolldownOptions: { output: { assetFileNames: (asset) => assetName(asset.names) } },
  },
});
