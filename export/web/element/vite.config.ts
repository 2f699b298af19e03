import { fileURLToPath } from "node:url";

import { defineConfig, type Plugin } from "vite";

import { packed } from "../decoder/packed.ts";

const path = (name: string): string => fileURLToPath(new URL(name, import.meta.url));

/** Shaders are text, which no minifier shortens: leaves out indents, comments and spaces about operators. */
const shaders: Plugin = {
  name: "shaders",
  enforce: "pre",
  transform: (code, id) =>
    id.endsWith("/renderer/shaders.ts") ? code.replace(/^ +| *\/\/ .*$| (?=[)}])| ?([=<>*(,;?&|{]) ?/gm, "$1") : null,
};

// The element with renderer and decoder: a module of a package, or, with `--mode page`, the script of the page that
// `kcgs export` and `kcgs view` write, which the Python package holds.
export default defineConfig(({ mode }) => ({
  root: path("."),
  publicDir: false,
  plugins: [packed(), shaders],
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
