// Copies two scenes of the zoo beside the page, and lists them.
import { copyFileSync, existsSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";

const NAMES = ["chelsea-500", "chart-pie"];
const models = new URL("../../models/", import.meta.url);
const target = new URL("public/examples/", import.meta.url);

const manifest = new URL("manifest.json", models);
const entries = existsSync(manifest) ? JSON.parse(readFileSync(manifest, "utf8")).entries : [];
rmSync(target, { recursive: true, force: true });
mkdirSync(target, { recursive: true });
const listed = NAMES.flatMap((name) => {
  const entry = entries.find((candidate) => candidate.name === name);
  if (!entry?.decoder) return [];
  copyFileSync(new URL(entry.decoder, models), new URL(`${name}.onnx`, target));
  const original = ["original.jpg", "original.webp"].find((file) => existsSync(new URL(`${name}/${file}`, models)));
  if (original) copyFileSync(new URL(`${name}/${original}`, models), new URL(`${name}-${original}`, target));
  return [{ name, decoder: `${name}.onnx`, original: original ? `${name}-${original}` : "", note: entry.title }];
});
writeFileSync(new URL("index.json", target), JSON.stringify(listed, null, 1) + "\n");
