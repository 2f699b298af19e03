import { fileURLToPath } from "node:url";

import { defineConfig } from "vite";

import { packed } from "../decoder/packed.ts";

const path = (name: string): string => fileURLToPath(new URL(name, import.meta.url));

// The element with renderer and decoder: a module of a package, or, with `--mode page`, the script of the page that
// `kcgs export` and `kcgs view` write, which the Python package holds.
export default defineConfig(({ mode }) => ({
  root: path("."),
  publicDir: false,
  plugins: [packed()],
  build: {
    target: "es2022",
    outDir: mode === "page" ? path("../../../kcgs/page") : path("dist"),
    emptyOutDir: mode !== "page",
    modulePreload: false,
    rolldownOptions: {
      input: mode === "page" ? path("page.ts") : path("index.ts"),
      ...(mode !== "page" && { preserveEntrySignatures: "strict" as const }),
      output: { entryFileNames: mode === "page" ? "page.js" : "kcgs-image.js" },
    },
  },
}));
