// A skin at rest: the page contains all data and needs no server.

import { Camera } from "./camera.js";
import { SHOWS, css, onScheme } from "./colours.js";
import { element, table } from "./dom.js";
import { busKey, drawRamp, shapes } from "./legend.js";
import { direction, point, project } from "./math.js";
import { Painter } from "./pace.js";
import { Picture } from "./picture.js";
import { frames, indices, outline, placed } from "./robot.js";
import { number } from "./scale.js";
import { resting } from "./snapshot.js";
import { listen, pick } from "./touch.js";
import { MOVED, wired } from "./wires.js";

const $ = (id) => document.getElementById(id);
const { scene, positions, details, moved, surface, shades, findings } = JSON.parse($("skin").textContent);
const canvas = $("picture"), camera = new Camera(), { cells } = scene, at = indices(scene);
// The robot does not move, and the cells have no values.
const all = frames(scene, positions), words = resting(cells.length), wires = wired(scene);
// Cells have the colour of a value, if the page has one, or of their bus.
const order = new Map(cells.map((cell, i) => [cell, i]));
const shows = shades ? { of: (_, cell) => shades.values[order.get(cell)], low: 0, high: shades.high, rest: (v) => v === null } : SHOWS.bus;
// The minimum radius on the screen of a cell that the camera faces, in pixels.
const FACED = 24;
let picture = null, chosen = -1;

const size = () => [canvas.clientWidth, canvas.clientHeight];
const view = () => camera.matrix(...size());
const frame = ({ bus, row }) => all[scene.buses[bus].chain][row];
const name = (cell) => `${scene.buses[cell.bus].name}:${cell.node}`;
const found = (x, y) => pick(scene, all, camera, view(), ...size(), x, y);

const corners = scene.shells.length ? new Float32Array(Uint8Array.from(atob(surface), (letter) => letter.charCodeAt(0)).buffer) : null;

try {
  picture = new Picture(canvas, true);
  picture.set(scene);
  if (corners) picture.surface(corners);
  picture.ribbons([...wires, ...moved.map(({ cell, ...from }) => ({ from, to: cell, kind: MOVED }))]);
} catch (error) {
  picture = null;
  $("message").textContent = `The picture cannot be drawn: ${error.message}. The tables still work.`;
  $("message").hidden = false;
}
const pose = placed(outline(scene, corners), all);
camera.choose(cells.map((cell) => [direction(frame(cell), cell.normal), 1]));

const painter = new Painter(picture?.software ?? false, (ratio) => {
  const first = camera.fresh;
  camera.follow(pose, pose, 0, 0, ...size());
  if (first && camera.auto) {
    camera.closest = Math.min(camera.closest, scene.pitch / camera.size);
    picture?.lay(camera.size, Math.min(0, pose.reduce((low, v, i) => (i % 3 === 2 ? Math.min(low, v) : low), Infinity)));
  }
  picture?.update(words, shows, chosen);
  const drew = picture?.draw(view(), all, ratio) ?? false;
  if (drew) window.skinbus.frames++;
  return { drew, worked: false };
});
const redraw = () => painter.redraw();

// For browser tests: the position of a cell in the picture, in pixels of the page; null unless its front is visible.
window.skinbus = {
  frames: 0,
  where(i) {
    const [x, y] = project(view(), point(frame(cells[i]), cells[i].position), ...size()) ?? [];
    return x !== undefined && found(x, y) === i ? [x, y] : null;
  },
};

function choose(i, turn = false) {
  chosen = i;
  $("cell-title").textContent = i < 0 ? "No cell chosen" : name(cells[i]);
  $("cell").replaceChildren(...(i < 0 ? [element("p", "Click a cell, or search for one.", "faint")] : about(i)));
  if (i >= 0) $("search").value = name(cells[i]);
  $("search").setAttribute("aria-invalid", "false");
  if (turn) camera.face(point(frame(cells[i]), cells[i].position), direction(frame(cells[i]), cells[i].normal), scene.pitch * 0.56, FACED, ...size());
  redraw();
}

function about(i) {
  const cell = cells[i], m = frame(cell), minus = (text) => text.replace(/-/g, "−");
  const known = cell.neighbors.map((node) => at.get(cell.bus * 256 + node)).filter((other) => other !== undefined);
  const row = element("div", undefined, "row wires");
  row.append(...(known.length ? known.map((other) => {
    const button = element("button", String(cells[other].node));
    button.type = "button";
    button.setAttribute("aria-label", `Show ${name(cells[other])}`);
    button.onclick = () => choose(other, true);
    return button;
  }) : [element("span", "no other cell", "faint")]));
  return [
    table([
      ["Bus", scene.buses[cell.bus].name],
      ["Node", String(cell.node)],
      ["Root", cell.root ? "yes, wired to the gateway" : "no"],
      ["Position, mm", minus(point(m, cell.position).map((v) => (v * 1000).toFixed(1)).join(", "))],
      ["Normal", minus(direction(m, cell.normal).map((v) => v.toFixed(3)).join(", "))],
      ...details[i],
    ]),
    element("h3", "Wired to"), row,
  ];
}

// The index of the cell that a text names by its bus and node id, or by the node id alone; -1 without one.
function named(text) {
  const searched = text.trim().toLowerCase(), is = (of) => cells.findIndex((cell) => of(cell).toLowerCase() === searched);
  return [name, (cell) => `${cell.bus}:${cell.node}`, (cell) => String(cell.node)].map(is).find((i) => i >= 0) ?? -1;
}

// Chooses the cell named after `#` in the address, if it exists.
function follow() {
  const i = named(decodeURIComponent(location.hash.slice(1)));
  choose(i, i >= 0);
}

$("find").onsubmit = (event) => {
  event.preventDefault();
  const text = $("search").value, i = named(text);
  choose(i, i >= 0);
  if (i >= 0) return;
  $("search").setAttribute("aria-invalid", "true");
  $("cell").replaceChildren(element("p", `There is no cell ${text}.`, "bad"));
};

function fit() {
  camera.fit();
  camera.follow(pose, pose, 0, 0, ...size());
  redraw();
}

// Zooms, by default around the middle.
function zoom(by, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {
  camera.nearer(by, [x - canvas.clientWidth / 2, y - canvas.clientHeight / 2], ...size());
  redraw();
}

listen(canvas, {
  at: found,
  choose: (i) => choose(i),
  turn(dx, dy) { camera.turn(dx, dy); redraw(); },
  move(dx, dy) { camera.move(dx, dy, ...size()); redraw(); },
  zoom,
  fit,
  next(step) { if (cells.length) choose((chosen + step + cells.length) % cells.length, true); },
  pressChosen() {},
  release() {},
});
$("in").onclick = () => zoom(1.4);
$("out").onclick = () => zoom(1 / 1.4);
$("whole").onclick = fit;
new ResizeObserver(redraw).observe(canvas);
window.addEventListener("hashchange", follow);

const count = (number, word, many = `${word}s`) => `${number} ${number === 1 ? word : many}`;
$("sum").textContent = [count(cells.length, "cell"), count(scene.buses.length, "bus", "buses"), count(wires.length, "wire")].join(", ");
$("buses").replaceChildren(...scene.buses.map((bus, index) => {
  const item = element("li"), own = cells.filter((cell) => cell.bus === index), roots = own.filter((cell) => cell.root).length;
  item.append(...(shades ? [] : [busKey(index)]), element("span", `${bus.name}: ${count(own.length, "cell")}, ${count(roots, "root")}`));
  return item;
}));
const marks = [{ name: "root", mark: "root" }, { name: shades ? shades.unknown : "other cell", mark: "" }];
if (moved.length) marks.push({ name: "moved from its place in the skin", mark: "way" });
// What a page has found out, with cells as links to them.
$("findings").hidden = !findings.length;
$("findings").append(...findings.map(({ text, isCell }) => {
  if (!isCell) return text;
  const link = element("a", text);
  link.href = `#${encodeURIComponent(text)}`;
  return link;
}));
if (shades) {
  $("shades").hidden = false;
  $("shades-title").textContent = shades.caption;
  $("low").textContent = "0";
  $("high").textContent = `${shades.more ? "≥ " : ""}${number(shades.high)} ${shades.unit}`;
}
function legend() {
  shapes($("shapes"), css, marks);
  if (shades) drawRamp($("ramp"));
}
legend();
onScheme(() => { picture?.colours(); legend(); redraw(); });
follow();
