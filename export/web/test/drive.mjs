/**
 * Drives one headless Chromium for a test in another language: a line of JSON in, a line of JSON out.
 *
 *     node drive.mjs CHROMIUM
 *     {"do": "open", "url": "http://127.0.0.1:8000/"}    ->  {"value": null}  or  {"error": "..."}
 *
 * `evaluate` takes an expression; a Float32Array inside what it gives comes back as {"float32": base64}.
 */

import { createInterface } from "node:readline";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";

import { chromium } from "playwright-core";

const FLAGS = [
  "--headless",
  "--no-sandbox",
  "--disable-gpu",
  "--disable-quic",
  "--no-first-run",
  "--disable-background-networking",
  "--disable-component-update",
  "--disable-sync",
];
const TIMEOUT = 300_000;

const profile = mkdtempSync(join(tmpdir(), "kcgs-web-"));
const context = await chromium.launchPersistentContext(profile, {
  executablePath: process.argv[2],
  headless: true,
  args: FLAGS,
  viewport: { width: 1000, height: 700 },
  hasTouch: true,
  timeout: TIMEOUT,
});
context.setDefaultTimeout(TIMEOUT);
const page = context.pages()[0] ?? (await context.newPage());
const requests = [];
const problems = [];
let dense = null;
page.on("request", (request) => requests.push(request.url()));
page.on("pageerror", (error) => problems.push(String(error)));
page.on("console", (message) => message.type() === "error" && problems.push(message.text()));

const encode = (source) => `(async () => {
  const pack = (value) => {
    if (value instanceof Float32Array) {
      const bytes = new Uint8Array(value.buffer, value.byteOffset, value.byteLength);
      let text = "";
      for (let i = 0; i < bytes.length; i += 0x8000) text += String.fromCharCode(...bytes.subarray(i, i + 0x8000));
      return { float32: btoa(text) };
    }
    if (Array.isArray(value)) return value.map(pack);
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, pack(item)]));
  };
  return pack(await (${source}));
})()`;

const actions = {
  open: async ({ url }) => {
    requests.length = problems.length = 0;
    await page.goto(url);
  },
  evaluate: ({ expression }) => page.evaluate(encode(expression)),
  press: ({ key, on }) => (on ? page.press(on, key) : page.keyboard.press(key)),
  click: ({ on }) => page.click(on),
  text: ({ on }) => page.innerText(on),
  // Not page.waitForFunction, which evaluates in a way that the page's Content-Security-Policy forbids.
  wait: async ({ expression }) => {
    const end = Date.now() + TIMEOUT;
    while (!(await page.evaluate(expression))) {
      if (Date.now() > end) throw new Error(`still not true: ${expression}`);
      await new Promise((resolve) => setTimeout(resolve, 20));
    }
  },
  wheel: async ({ x, y, delta }) => {
    await page.mouse.move(x, y);
    await page.mouse.wheel(0, delta);
  },
  drag: async ({ from, to }) => {
    await page.mouse.move(...from);
    await page.mouse.down();
    await page.mouse.move(...to, { steps: 5 });
    await page.mouse.up();
  },
  pinch: async ({ at: [x, y], from, to }) => {
    const session = await context.newCDPSession(page);
    const touch = (type, points) => session.send("Input.dispatchTouchEvent", { type, touchPoints: points });
    const fingers = (apart) => [
      { x: x - apart / 2, y },
      { x: x + apart / 2, y },
    ];
    await touch("touchStart", fingers(from));
    for (let step = 1; step <= 5; step++) await touch("touchMove", fingers(from + ((to - from) * step) / 5));
    await touch("touchEnd", []);
    await session.detach();
  },
  look: async ({ width, height, scheme, motion }) => {
    await page.emulateMedia({ colorScheme: scheme ?? "light", reducedMotion: motion ?? "reduce" });
    await page.setViewportSize({ width: width ?? 1000, height: height ?? 700 });
  },
  // Until another call with ratio 1, the screen has so many pixels for each of CSS.
  density: async ({ ratio }) => {
    await dense?.detach();
    dense = ratio === 1 ? null : await context.newCDPSession(page);
    const { width, height } = page.viewportSize();
    const metrics = { width, height, deviceScaleFactor: ratio, mobile: false };
    await dense?.send("Emulation.setDeviceMetricsOverride", metrics);
    if (dense === null) await page.setViewportSize({ width: width + 1, height });
  },
  // Roles and names as a screen reader is told them.
  accessible: async () => {
    const session = await context.newCDPSession(page);
    const { nodes } = await session.send("Accessibility.getFullAXTree");
    await session.detach();
    return nodes.filter((node) => !node.ignored).map((node) => [node.role?.value, node.name?.value ?? ""]);
  },
  requests: () => requests,
  problems: () => problems,
};

for await (const line of createInterface({ input: process.stdin })) {
  const command = JSON.parse(line);
  let answer;
  try {
    answer = { value: (await actions[command.do](command)) ?? null };
  } catch (error) {
    answer = { error: String(error) };
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
await context.close();
rmSync(profile, { recursive: true, force: true });
