/**
 * Decodes for a test in another language: a line of JSON in, a line of JSON out.
 *
 *     node --expose-gc decode.mjs FOLDER-OF-THE-BUILT-DECODER
 *     {"do": "scene", "path": "a.kcgs"}    ->  {"height": 24, ..., "memory": bytes at most so far}
 */

import { existsSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

import { attempt, describeScene, stream } from "./describe.mjs";

const { decode, ProgressiveDecoder } = await import(pathToFileURL(join(process.argv[2], "decoder.js")).href);

const actions = {
  scene: async (bytes) => describeScene(decode(bytes)),
  stream: async (bytes, { step }) => stream(new ProgressiveDecoder(), bytes, step),
};

/** The most memory that this process had. Linux counts that of the program that started it in maxRSS, so not by that. */
function peak() {
  const status = "/proc/self/status";
  const found = existsSync(status) && /VmHWM:\s+(\d+) kB/.exec(readFileSync(status, "utf8"));
  return 1024 * (found ? Number(found[1]) : process.resourceUsage().maxRSS);
}

for await (const line of createInterface({ input: process.stdin })) {
  const command = JSON.parse(line);
  const bytes = new Uint8Array(readFileSync(command.path));
  // or the memory would be that of many files, as the collector happens to run
  gc();
  const answer = await attempt(() => actions[command.do](bytes, command));
  answer.memory = peak();
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
