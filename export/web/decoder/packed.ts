/** Files of the decoder as text in its bundle: a quarter smaller than base64 once they are compressed. */

import { readFileSync } from "node:fs";

import type { Plugin } from "vite";

import { FIRST, MIDDLE, SECOND, SPLIT } from "./packed_text.ts";

/** Resolves imports of `file?packed`, which `unpack` takes. */
export function packed(): Plugin {
  return {
    name: "packed",
    enforce: "pre",
    load(id) {
      if (!id.endsWith("?packed")) return null;
      const text = Array.from(readFileSync(id.slice(0, -"?packed".length)), (byte) => {
        const value = (byte + MIDDLE) & 255;
        return String.fromCharCode(value < SPLIT ? value + FIRST : value - SPLIT + SECOND);
      }).join("");
      // a page may have the bundle inside
      if (/<\/script|<!--/i.test(text)) throw new Error(`${id} must not hold the end of a script as text`);
      return `export default ${JSON.stringify(text)}`;
    },
  };
}
