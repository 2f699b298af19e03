import { fileURLToPath } from "node:url";

import { defineConfig, type Plugin } from "vite";

import { packed } from "./decoder/packed.ts";

const path = (name: string): string => fileURLToPath(new URL(name, import.meta.url));

/** Shaders are text, which no minifier shortens: leaves out indents, comments and spaces about operators. */
const shaders: Plugin = {
  name: "shaders",
  enforce: "pre",
  transform: (code, id) =>
    id.endsWith("/renderer/shaders.ts") ? code.replace(/^ +| *\/\/ .*$| (?=[)}])| ?([=<>*(,;?&|{]) ?/gm, "$1") : null,
};

// for each mode the module that is built, its folder and its name: the decoder alone, the element with renderer and
// decoder, or what the page that `kcgs export` and `kcgs view` write adds to the element
const BUNDLES: Record<string, readonly [input: string, folder: string, name: string]> = {
  decoder: ["decoder/index.ts", "build", "decoder"],
  element: ["element/index.ts", "element/dist", "kcgs-image"],
  page: ["element/page.ts", "../../kcgs/page", "page"],
};

export default defineConfig(({ mode }) => {
  const [input, folder, name] = BUNDLES[mode]!;
  return {
    root: path("."),
    publicDir: false,
    plugins: [packed(), shaders],
    build: {
      target: "es2022",
      outDir: path(folder),
      emptyOutDir: false,
      modulePreload: false,
      rolldownOptions: {
        input: path(input),
        ...(mode !== "page" && { preserveEntrySignatures: "strict" as const }),
        output: { entryFileNames: `${name}.js` },
      },
    },
  };
});
