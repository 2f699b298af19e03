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

// The element with renderer and decoder: a module of a package, or, with `--mode page` and `--mode clip`, the scripts of
// the pages of a scene and of a clip that `kcgs export` and `kcgs view` write, which the Python package holds.
const PAGES = ["page", "clip"];

export default defineConfig(({ mode }) => ({
  root: path("."),
  publicDir: false,
  plugins: [packed(), shaders],
  build: {
    target: "es2022",
    outDir: PAGES.includes(mode) ? path("../../../kcgs/page") : path("dist"),
    emptyOutDir: !PAGES.includes(mode),
    modulePreload: false,
    rolldownOptions: {
      input: path(PAGES.includes(mode) ? `${mode}.ts` : "index.ts"),
      ...(!PAGES.includes(mode) && { preserveEntrySignatures: "strict" as const }),
      output: { entryFileNames: PAGES.includes(mode) ? `${mode}.js` : "kcgs-image.js" },
    },
  },
}));
