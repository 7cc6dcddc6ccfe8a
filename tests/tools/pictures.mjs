// Takes pictures of the page of a recording in headless Chromium: one of a moment, and a row of them for an animation.
//
//   node tests/tools/pictures.mjs MODULES URL AT STILL.png FROM TO STEP FOLDER     times in s of the run; 000.png, 001.png, ... in FOLDER
import { spawn } from "node:child_process";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";

const [modules, url, at, still, from, to, step, folder] = process.argv.slice(2);
const { WebSocket } = createRequire(join(resolve(modules), "node_modules", "x.js"))("ws");
// The page of the animation is higher, so that the robot is large; only its left part is shown, smaller.
const [STILL, MOVING, SCALE] = [[1400, 900], [1400, 1080], 0.8];
const pause = (ms) => new Promise((done) => setTimeout(done, ms));

const profile = mkdtempSync(join(tmpdir(), "profile-"));
const rendering = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
const browser = spawn("chromium", ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", ...rendering,
  `--user-data-dir=${profile}`, "--remote-debugging-port=0", "about:blank"]);
try {
  let said = "";
  const address = await new Promise((found) => browser.stderr.on("data", (part) => {
    const listening = /ws:\/\/([^/]+)\//.exec(said += part);
    if (listening) found(listening[1]);
  }));
  const pages = await (await fetch(`http://${address}/json`)).json();
  const socket = new WebSocket(pages.find(({ type }) => type === "page").webSocketDebuggerUrl);
  await new Promise((open) => socket.on("open", open));
  const waiting = new Map();
  socket.on("message", (bytes) => { const { id, result } = JSON.parse(bytes); waiting.get(id)?.(result); });
  let calls = 0;
  const call = (method, params) => new Promise((done) => {
    waiting.set(++calls, done);
    socket.send(JSON.stringify({ id: calls, method, params }));
  });
  const value = async (expression) => (await call("Runtime.evaluate", { expression, returnByValue: true })).result.value;
  async function until(expression) {
    while (!(await value(expression))) await pause(20);
  }
  const size = ([width, height]) => call("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile: false });
  async function take(file, clip) {
    const { data } = await call("Page.captureScreenshot", { format: "png", ...(clip ? { clip } : {}) });
    writeFileSync(file, Buffer.from(data, "base64"));
  }
  // Goes to a moment, and waits until its picture has been drawn in full resolution.
  async function go(seconds) {
    await value(`location.hash = "at=${seconds.toFixed(3)}"`);
    await until(`Math.abs(Number(document.querySelector("#time input[type=range]")?.value) - ${seconds}) < 0.02`);
    await until(`(() => { const { width, clientWidth } = document.getElementById("picture"); return width === 2 * clientWidth; })()`);
    const frames = await value("window.skinbus.frames");
    await until(`window.skinbus.frames > ${frames} || (window.waited = (window.waited ?? 0) + 1) % 30 === 0`);
  }

  await call("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: "dark" }] });
  await size(STILL);
  await call("Page.navigate", { url });
  await until("window.skinbus?.frames > 0");
  await until(`!document.querySelector("#time .faint")?.textContent.includes("read")`);
  await go(Number(at));
  await take(still);
  await size(MOVING);
  await go(Number(from));
  // The camera looks at the first touch, and keeps its direction.
  await value("window.skinbus.camera.steers = false");
  const clip = JSON.parse(await value(`(() => {
    const { x, y, width } = document.getElementById("view").getBoundingClientRect(), end = document.getElementById("time").getBoundingClientRect();
    return JSON.stringify({ x, y, width, height: end.y - y, scale: ${SCALE} });
  })()`));
  let count = 0;
  for (let seconds = Number(from); seconds < Number(to) + 1e-9; seconds += Number(step)) {
    await go(seconds);
    await take(join(folder, `${String(count++).padStart(3, "0")}.png`), clip);
  }
} finally {
  browser.kill();
  await new Promise((ended) => browser.on("exit", ended));
  rmSync(profile, { recursive: true, force: true });
}
process.exit(0);
