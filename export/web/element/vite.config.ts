import { fileURLToPath } from "node:url";

import { defineConfig } from "vite";

const path = (name: string): string => fileURLToPath(new URL(name, import.meta.url));

// The element with renderer and decoder, one module; and the script of the page that `kcgs export` and `kcgs view` make.
export default defineConfig({
  root: path("."),
  publicDir: false,
  build: {
    target: "es2022",
    outDir: path("dist"),
    emptyOutDir: true,
    modulePreload: false,
    rolldownOptions: {
      input: path("index.ts"),
      preserveEntrySignatures: "strict",
      output: { entryFileNames: "kcgs-image.js" },
    },
  },
});
