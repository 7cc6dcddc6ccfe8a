"use strict";
const skin = JSON.parse(document.getElementById("skin").textContent);
const $ = (id) => document.getElementById(id);
const canvas = $("view"), pen = canvas.getContext("2d");
// Okabe and Ito, without black: told apart by people with any colour vision.
const COLOURS = ["#56b4e9", "#e69f00", "#009e73", "#f0e442", "#cc79a7", "#d55e00", "#0072b2"];
const colour = (bus) => COLOURS[bus % COLOURS.length];
// From this radius in pixels on, a hexagon has its number.
const LEGIBLE = 13;
const dark = (bus) => [5, 6].includes(bus % COLOURS.length);
const name = (cell) => `${skin.buses[cell.bus] ?? cell.bus}:${cell.node}`;
const add = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };

const cells = skin.cells;
const byName = new Map(cells.map((cell, at) => [cell.bus + ":" + cell.node, at]));
for (const cell of cells) {
  const n = cell.normal;
  const s = unit(cross(n, Math.abs(n[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0])), t = cross(n, s);
  cell.corners = [0, 1, 2, 3, 4, 5].map((k) => {
    const [a, r] = [k * Math.PI / 3, skin.pitch * 0.53];
    return add(add(cell.position, s, r * Math.cos(a)), t, r * Math.sin(a));
  });
}
const wires = [];
cells.forEach((cell, at) => cell.neighbors.forEach((node) => {
  const other = byName.get(cell.bus + ":" + node);
  if (other > at) wires.push([at, other]);
}));
const triangles = skin.triangles.map((corners) => {
  const [a, b, c] = corners;
  return { corners, normal: unit(cross(add(b, a, -1), add(c, a, -1))) };
});

// The middle and size of the skin, or without cells of what else there is.
const points = cells.length ? cells.map((cell) => cell.position) : [...skin.segments.flat(), ...skin.triangles.flat()];
const low = [0, 1, 2].map((i) => points.reduce((m, p) => Math.min(m, p[i]), Infinity));
const high = [0, 1, 2].map((i) => points.reduce((m, p) => Math.max(m, p[i]), -Infinity));
const middle = points.length ? low.map((v, i) => (v + high[i]) / 2) : [0, 0, 0];
const size = points.length ? Math.hypot(...high.map((v, i) => v - low[i])) + 2 * skin.pitch || 1 : 1;

const view = { yaw: -0.9, pitch: 0.35, zoom: 1, at: middle };
let chosen = null, items = [], due = false, frame = null;

function axes() {
  const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
  const to = [cp * cy, cp * sy, sp]; // towards the viewer
  const right = [-sy, cy, 0];
  return { to, right, up: cross(to, right) };
}
function redraw() {
  if (!due) { due = true; requestAnimationFrame(draw); }
}
const style = (key) => getComputedStyle(document.documentElement).getPropertyValue(key).trim();
function shade(hex, light) {
  const v = parseInt(hex.slice(1), 16), f = (c) => Math.round(Math.min(255, c * light));
  return `rgb(${f(v >> 16)},${f((v >> 8) & 255)},${f(v & 255)})`;
}

function draw() {
  due = false;
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const [w, h] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const { to, right, up } = axes();
  const scale = 1.05 * Math.min(box.width, box.height) / size * view.zoom;
  frame = { right, up, scale };
  const flat = (p) => {
    const d = add(p, view.at, -1);
    return [box.width / 2 + dot(d, right) * scale, box.height / 2 - dot(d, up) * scale, dot(d, to)];
  };
  const [mesh, edge, wire, pick] = ["--mesh", "--edge", "--wire", "--pick"].map(style);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, box.width, box.height);
  pen.lineJoin = pen.lineCap = "round";

  // From far to near; cells and wires a little above what they lie on.
  items = [];
  for (const triangle of triangles) {
    const path = triangle.corners.map(flat);
    const depth = (path[0][2] + path[1][2] + path[2][2]) / 3;
    items.push({ kind: "triangle", depth, path, light: Math.abs(dot(triangle.normal, to)) });
  }
  for (const [a, b] of skin.segments) {
    const path = [flat(a), flat(b)];
    items.push({ kind: "segment", depth: (path[0][2] + path[1][2]) / 2 - skin.pitch, path });
  }
  const fronts = cells.map((cell) => dot(cell.normal, to));
  cells.forEach((cell, at) => {
    if (fronts[at] < 0.03 && at !== chosen) return;
    const middle = flat(cell.position);
    const depth = middle[2] + skin.pitch * (fronts[at] > 0 ? 0.7 : -0.2);
    items.push({ kind: "cell", depth, at, middle, path: cell.corners.map(flat), light: fronts[at] });
  });
  for (const [a, b] of wires) {
    if (fronts[a] < 0.03 || fronts[b] < 0.03) continue;
    const lift = skin.pitch * 0.08;
    const ends = [a, b].map((at) => add(cells[at].position, cells[at].normal, lift));
    const along = add(ends[1], ends[0], -1);
    // Short of the middles, where the numbers are.
    const path = [0.33, 0.67].map((share) => flat(add(ends[0], along, share)));
    items.push({ kind: "wire", depth: (path[0][2] + path[1][2]) / 2 + skin.pitch * 0.75, path });
  }
  items.sort((a, b) => a.depth - b.depth);

  const radius = skin.pitch * 0.53 * scale;
  const trace = (path, closed) => {
    pen.beginPath();
    path.forEach(([x, y], i) => i ? pen.lineTo(x, y) : pen.moveTo(x, y));
    if (closed) pen.closePath();
  };
  for (const item of items) {
    if (item.kind === "triangle") {
      trace(item.path, true);
      pen.fillStyle = pen.strokeStyle = shade(mesh, 0.72 + 0.28 * item.light);
      pen.lineWidth = 0.7;
      pen.fill(); pen.stroke();
    } else if (item.kind === "segment") {
      trace(item.path); pen.strokeStyle = wire; pen.lineWidth = 4; pen.globalAlpha = 0.35; pen.stroke(); pen.globalAlpha = 1;
    } else if (item.kind === "wire") {
      trace(item.path); pen.strokeStyle = wire; pen.lineWidth = Math.min(5, Math.max(1, radius * 0.14)); pen.stroke();
    } else {
      hexagon(item, radius, trace, edge);
    }
  }
  if (chosen !== null) {
    const item = items.find((item) => item.at === chosen);
    trace(item.path, true);
    pen.strokeStyle = pick; pen.lineWidth = 3.5;
    pen.setLineDash(item.light < 0 ? [5, 5] : []); pen.stroke(); pen.setLineDash([]);
    const [x, y] = item.middle;
    pen.beginPath(); pen.arc(x, y, Math.max(radius * 1.7, 16), 0, 7); pen.lineWidth = 2; pen.stroke();
  }
}

function hexagon(item, radius, trace, edge) {
  const cell = cells[item.at], [x, y] = item.middle;
  trace(item.path, true);
  pen.fillStyle = shade(colour(cell.bus), 0.72 + 0.28 * Math.max(item.light, 0));
  pen.strokeStyle = edge; pen.lineWidth = Math.min(2, Math.max(0.5, radius * 0.06));
  pen.fill(); pen.stroke();
  const ink = dark(cell.bus) ? "#ffffff" : "#101416";
  if (cell.root) {
    // A second hexagon within: seen without colour, and beside a number.
    trace(item.path.map(([a, b]) => [x + (a - x) * 0.72, y + (b - y) * 0.72]), true);
    pen.strokeStyle = ink; pen.lineWidth = Math.max(1.2, radius * 0.11); pen.stroke();
    if (radius < LEGIBLE) {
      trace(item.path.map(([a, b]) => [x + (a - x) * 0.4, y + (b - y) * 0.4]), true);
      pen.fillStyle = ink; pen.fill();
    }
  }
  if (radius >= LEGIBLE && item.light > 0.45) {
    pen.fillStyle = ink; pen.textAlign = "center"; pen.textBaseline = "middle";
    const share = cell.node > 99 ? 0.62 : 0.75;
    pen.font = `600 ${Math.min(28, radius * share)}px system-ui, sans-serif`;
    pen.fillText(String(cell.node), x, y);
  }
}

function inside([x, y], path) {
  let odd = false;
  for (let i = 0, j = path.length - 1; i < path.length; j = i++) {
    const [a, b] = [path[i], path[j]];
    if ((a[1] > y) !== (b[1] > y) && x < (b[0] - a[0]) * (y - a[1]) / (b[1] - a[1]) + a[0]) odd = !odd;
  }
  return odd;
}
function cellAt(point) {
  for (let i = items.length - 1; i >= 0; i--) {
    const item = items[i];
    if ((item.kind === "cell" || item.kind === "triangle") && inside(point, item.path)) {
      return item.kind === "cell" ? item.at : null;
    }
  }
  return null;
}

function element(tag, text, parent) {
  const made = document.createElement(tag);
  if (text !== null) made.textContent = text;
  parent.append(made);
  return made;
}
function choose(at, turn) {
  chosen = at;
  const box = $("cell");
  box.replaceChildren();
  if (at === null) {
    element("h2", "No cell chosen", box);
    element("p", "Drag to turn, wheel or two fingers to zoom, shift and drag to move. Choose a cell to see its details.", box);
  } else {
    const cell = cells[at];
    element("h2", cell.label ? `${name(cell)}, ${cell.label}` : name(cell), box);
    const list = element("dl", null, box);
    const row = (key, value) => { element("dt", key, list); element("dd", value, list); };
    row("Bus", skin.buses[cell.bus] ?? String(cell.bus));
    row("Node", String(cell.node));
    row("Root", cell.root ? "yes, wired to the gateway" : "no");
    row("Position", cell.position.map((v) => (v * 1000).toFixed(1)).join(", ") + " mm");
    row("Normal", cell.normal.map((v) => v.toFixed(3)).join(", "));
    cell.details.forEach(([key, value]) => row(key, value));
    element("h3", "Wired to", box);
    const others = element("div", null, box);
    others.id = "wires";
    const known = cell.neighbors.map((node) => byName.get(cell.bus + ":" + node)).filter((other) => other !== undefined);
    for (const other of known) {
      const button = element("button", String(cells[other].node), others);
      button.onclick = () => choose(other, true);
    }
    if (!known.length) element("span", "no other cell", others);
    $("wanted").value = name(cell);
    if (turn) face(cell);
  }
  redraw();
}
function face(cell) {
  view.yaw = Math.atan2(cell.normal[1], cell.normal[0]) + 0.25;
  view.pitch = Math.max(-1.5, Math.min(1.5, Math.asin(Math.max(-1, Math.min(1, cell.normal[2]))) + 0.15));
  view.at = cell.position;
  const width = Math.min(canvas.clientWidth, canvas.clientHeight) || 1;
  view.zoom = Math.max(view.zoom, 20 / (skin.pitch * 0.53 * 1.05 * width / size));
}
function found(text) {
  const wanted = text.trim().toLowerCase();
  if (!wanted) return null;
  const is = (test) => { const at = cells.findIndex(test); return at < 0 ? null : at; };
  return is((cell) => name(cell).toLowerCase() === wanted) ?? is((cell) => cell.bus + ":" + cell.node === wanted)
    ?? is((cell) => String(cell.node) === wanted) ?? is((cell) => cell.label.toLowerCase() === wanted);
}
$("search").onsubmit = (event) => {
  event.preventDefault();
  const at = found($("wanted").value);
  if (at !== null) return choose(at, true);
  choose(null);
  element("p", `There is no cell ${$("wanted").value}.`, $("cell")).className = "error";
};

function zoom(by, x, y) {
  const before = view.zoom;
  view.zoom = Math.min(60, Math.max(0.3, view.zoom * by));
  if (frame && x !== undefined) {
    // What is below the pointer stays there.
    const k = (1 - before / view.zoom) / frame.scale;
    const [dx, dy] = [x - canvas.clientWidth / 2, canvas.clientHeight / 2 - y];
    view.at = add(add(view.at, frame.right, dx * k), frame.up, dy * k);
  }
  redraw();
}
function turn(dx, dy) {
  view.yaw -= dx;
  view.pitch = Math.min(1.55, Math.max(-1.55, view.pitch + dy));
  redraw();
}
function move(dx, dy) {
  view.at = add(add(view.at, frame.right, -dx / frame.scale), frame.up, dy / frame.scale);
  redraw();
}
const held = new Map();
let moved = 0;
const place = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  if (!held.size) moved = 0;
  held.set(event.pointerId, place(event));
  canvas.classList.add("held");
};
canvas.onpointermove = (event) => {
  const from = held.get(event.pointerId);
  if (!from) return;
  const to = place(event), [dx, dy] = [to[0] - from[0], to[1] - from[1]];
  moved += Math.hypot(dx, dy);
  const others = [...held].filter(([id]) => id !== event.pointerId);
  if (others.length) {
    const [, other] = others[0];
    const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
    move(dx / 2, dy / 2);
    zoom(apart(to) / apart(from), (to[0] + other[0]) / 2, (to[1] + other[1]) / 2);
  } else if (event.shiftKey || event.buttons > 1) move(dx, dy);
  else turn(dx * 0.008, dy * 0.008);
  held.set(event.pointerId, to);
};
canvas.onpointerup = canvas.onpointercancel = (event) => {
  const alone = held.size === 1;
  held.delete(event.pointerId);
  if (!held.size) canvas.classList.remove("held");
  if (event.type === "pointerup" && alone && moved < 5) choose(cellAt(place(event)));
};
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event));
}, { passive: false });
canvas.oncontextmenu = (event) => event.preventDefault();
canvas.onkeydown = (event) => {
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
  if (keys[event.key]) turn(...keys[event.key]);
  else if (event.key === "+" || event.key === "=") zoom(1.2);
  else if (event.key === "-") zoom(1 / 1.2);
  else return;
  event.preventDefault();
};
$("in").onclick = () => zoom(1.4);
$("out").onclick = () => zoom(1 / 1.4);
$("all").onclick = () => { view.zoom = 1; view.at = middle; redraw(); };

const used = [...new Set(cells.map((cell) => cell.bus))].sort((a, b) => a - b);
const count = (number, word) => `${number} ${word}${number === 1 ? "" : word.endsWith("s") ? "es" : "s"}`;
$("sum").textContent = `${count(cells.length, "cell")}, ${count(used.length, "bus")}, ${count(wires.length, "wire")}`;
const svg = (fill, mark) => {
  const at = (r) => [0, 1, 2, 3, 4, 5].map((k) => [11 + r * Math.cos(k * Math.PI / 3), 11 + r * Math.sin(k * Math.PI / 3)].map((v) => v.toFixed(1)).join(",")).join(" ");
  const make = (tag, keys) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    Object.entries(keys).forEach(([key, value]) => made.setAttribute(key, value));
    return made;
  };
  const drawn = make("svg", { width: 22, height: 22, "aria-hidden": "true" });
  drawn.append(make("polygon", { points: at(10), fill, stroke: "#3b4246" }));
  if (mark) drawn.append(make("polygon", { points: at(6.5), fill: "none", stroke: "currentColor", "stroke-width": 2 }));
  return drawn;
};
for (const bus of used) {
  const line = element("li", null, $("buses"));
  const on = cells.filter((cell) => cell.bus === bus);
  const roots = on.filter((cell) => cell.root).length;
  line.append(svg(colour(bus), false), `${skin.buses[bus] ?? bus}: ${count(on.length, "cell")}, ${count(roots, "root")}`);
}
const line = element("li", null, $("buses"));
line.append(svg("transparent", true), "a root has a second hexagon");
new ResizeObserver(redraw).observe(canvas);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
const asked = found(decodeURIComponent(location.hash.slice(1)));
choose(asked, asked !== null);
