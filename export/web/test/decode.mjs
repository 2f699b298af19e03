/**
 * Decodes for a test in another language: a line of JSON in, a line of JSON out.
 *
 *     node --expose-gc decode.mjs FOLDER-OF-THE-BUILT-DECODER
 *     {"do": "scene", "path": "a.kcgs"}    ->  {"height": 24, ..., "memory": bytes at most so far}
 */

import { readFileSync } from "node:fs";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

import { attempt, describeLabels, describeScene, stream } from "./describe.mjs";

const load = (name) => import(pathToFileURL(join(process.argv[2], name)).href);
const { decode, ProgressiveDecoder } = await load("decoder.js");
const { decodeLabels } = await load("labels.js");

const actions = {
  scene: async (bytes) => describeScene(decode(bytes)),
  labels: async (bytes) => describeLabels(decodeLabels(bytes)),
  stream: async (bytes, { step }) => stream(new ProgressiveDecoder(), bytes, step),
};

for await (const line of createInterface({ input: process.stdin })) {
  const command = JSON.parse(line);
  const bytes = new Uint8Array(readFileSync(command.path));
  // or the memory would be that of many files, as the collector happens to run
  gc();
  const answer = await attempt(() => actions[command.do](bytes, command));
  answer.memory = process.resourceUsage().maxRSS * 1024;
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
