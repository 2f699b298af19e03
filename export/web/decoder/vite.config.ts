import { fileURLToPath } from "node:url";

import { defineConfig } from "vite";

import { packed } from "./packed.ts";

const path = (name: string): string => fileURLToPath(new URL(name, import.meta.url));

// The decoder alone: decoder.js for scenes, labels.js for label maps, and what both need.
export default defineConfig({
  root: path("."),
  publicDir: false,
  plugins: [packed()],
  build: {
    target: "es2022",
    outDir: path("../build"),
    emptyOutDir: true,
    modulePreload: false,
    rolldownOptions: {
      input: { decoder: path("index.ts"), labels: path("labels.ts") },
      preserveEntrySignatures: "strict",
      output: { entryFileNames: "[name].js", chunkFileNames: "shared.js" },
    },
  },
});
