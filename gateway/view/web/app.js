// The page: keeps the newest messages, and draws when something has changed.

import { Bench, nameOf } from "./bench.js";
import { Camera } from "./camera.js";
import { SHOWS, css, ramp } from "./colours.js";
import { hold } from "./frames.js";
import { shapes } from "./legend.js";
import { Link } from "./link.js";
import { point, project } from "./math.js";
import { Painter } from "./pace.js";
import { Picture } from "./picture.js";
import { Plots, number } from "./plots.js";
import { TimeBar } from "./time.js";
import { extent, frames } from "./robot.js";
import { listen, pick } from "./touch.js";
import { wires } from "./wires.js";
import * as words from "./words.js";

const $ = (id) => document.getElementById(id);
const canvas = $("picture"), camera = new Camera();
let picture = null, scene = null, plots = null, snapshot = null, said = null, all = null, trees = [], chosen = -1, pressed = -1;
// For browser tests.
window.skinbus = { frames: 0, snapshots: 0, where, joints: () => snapshot?.joints.map((joint) => joint.position) ?? [] };

function message(text) {
  $("message").textContent = text;
  $("message").hidden = !text;
}

try {
  picture = new Picture(canvas);
} catch (error) {
  message(`The picture cannot be drawn: ${error.message}. The tables still work.`);
}

const view = () => camera.matrix(canvas.clientWidth, canvas.clientHeight);

const painter = new Painter(picture?.software ?? false, draw);
$("software").hidden = !picture?.software;
const redraw = () => painter.redraw();

function draw(ratio) {
  if (!scene || !snapshot) return { drew: false, worked: false };
  const news = said;
  if (news) {
    said = null;
    words.say(scene, news, ask);
    bench.say(scene, news.bench, chosen);
    trees = news.buses.map((bus) => bus.tree);
    $("tree-switch").hidden = trees.every((tree) => !tree);
    drawTree();
    plots.draw();
    camera.fit(extent(scene, all));
  }
  picture?.update(snapshot.cells, SHOWS[$("shows").value], chosen);
  const drew = picture?.draw(view(), all, ratio) ?? false;
  if (drew || news) window.skinbus.frames++;
  return { drew, worked: news !== null };
}

const name = (i) => (i < 0 ? "" : nameOf(scene, scene.cells[i]));

function choose(i) {
  if (i === chosen) return;
  chosen = i;
  words.chosen(name(i));
  $("search").value = name(i);
  $("hold").disabled = i < 0 || !scene.may_press;
  link.send(i < 0 ? { do: "unchoose" } : { do: "choose", cell: name(i) });
  redraw();
}

function press(i) {
  choose(i);
  if (!scene.may_press) return;
  pressed = i;
  link.send({ do: "press", cell: name(i), force_n: Number($("force").value) });
}

function release() {
  if (pressed < 0) return;
  pressed = -1;
  $("hold").setAttribute("aria-pressed", "false");
  link.send({ do: "release" });
}

// The centre of a cell on the screen, in CSS pixels of the picture; null unless its front is visible.
function where(i) {
  const { width, height } = canvas.getBoundingClientRect(), cell = scene.cells[i];
  const at = project(view(), point(all[scene.buses[cell.bus].chain][cell.row], cell.position), width, height)?.slice(0, 2);
  return at && pick(scene, all, camera, view(), width, height, ...at) === i ? at : null;
}

const bench = new Bench((command) => link.send(command));
function drawTree() {
  picture?.ribbons($("tree").checked ? wires(scene, trees) : []);
}

// Loads the robot's surface; cylinders are drawn until then.
async function surface(of) {
  const answer = await fetch(`/surface${location.search}`);
  const corners = new Float32Array(await answer.arrayBuffer());
  if (answer.ok && scene === of) picture.surface(corners);
  redraw();
}

const link = new Link({
  scene(it) {
    scene = it;
    [chosen, pressed, snapshot, said, camera.box] = [-1, -1, null, null, null];
    document.title = `${scene.name}: skinbus view`;
    $("name").textContent = scene.name;
    plots = new Plots($("torques"), scene.joints);
    words.chosen("");
    words.link("connected");
    for (const id of ["halt", "resume"]) $(id).disabled = !scene.may_press;
    words.buses(scene);
    picture?.set(scene);
    if (picture && scene.shells.length) surface(scene);
  },
  snapshot(it) {
    snapshot = it;
    all = frames(scene, it.joints.map((joint) => joint.position));
    plots.push(it.time, it.joints);
    window.skinbus.snapshots++;
    redraw();
  },
  history(it) { plots.replace(it); },
  said(it) {
    said = it;
    time.say(it.playback);
    redraw();
  },
  closed(refusal) {
    pressed = -1;
    words.link(`not connected: ${refusal || "the bench has ended, or is not reachable"}`, true);
  },
});

const time = new TimeBar($("time"), (command) => link.send(command));

// Requests the explanation of the torque in a frame of the chosen cell.
function ask(frame) {
  link.send({ do: "choose", cell: name(chosen), frame });
}

listen(canvas, {
  at: (x, y) => (scene && all ? pick(scene, all, camera, view(), canvas.clientWidth, canvas.clientHeight, x, y) : -1),
  press,
  release,
  turn(dx, dy) { camera.turn(dx, dy); redraw(); },
  zoom(by) { camera.nearer(by); redraw(); },
  next(step) { if (scene) choose((chosen + step + scene.cells.length) % scene.cells.length); },
  pressChosen() { if (chosen >= 0) press(chosen); },
});

$("force").oninput = () => {
  $("newtons").textContent = `${Number($("force").value).toFixed(1)} N`;
  if (pressed >= 0) press(pressed);
};
$("hold").onclick = () => {
  if (pressed >= 0) return release();
  press(chosen);
  $("hold").setAttribute("aria-pressed", "true");
};
$("search").onchange = () => {
  const text = $("search").value.trim();
  const found = scene ? scene.cells.findIndex((cell, i) => name(i) === text || String(cell.node) === text) : -1;
  $("search").setAttribute("aria-invalid", String(found < 0 && text !== ""));
  if (found >= 0) choose(found);
};
$("hold-frames").onclick = () => hold($("hold-frames").getAttribute("aria-pressed") !== "true");
$("halt").onclick = () => link.send({ do: "halt" });
$("resume").onclick = () => link.send({ do: "resume" });
window.addEventListener("blur", release);
window.addEventListener("resize", redraw);

function legend() {
  const shows = SHOWS[$("shows").value];
  $("scale").hidden = shows.isBus ?? false;
  $("bus-colours").hidden = !shows.isBus;
  if (shows.isBus) return redraw();
  const pen = $("ramp").getContext("2d"), { width, height } = $("ramp");
  $("low").textContent = number(shows.low).replace(/\.0+$/, "");
  $("high").textContent = `${number(shows.high).replace(/\.0+$/, "")} ${shows.unit}`;
  for (let x = 0; x < width; x++) {
    pen.fillStyle = `rgb(${ramp(x / (width - 1)).join(" ")})`;
    pen.fillRect(x, 0, 1, height);
  }
  redraw();
}
$("shows").onchange = legend;
$("tree").onchange = () => { drawTree(); redraw(); };
legend();
shapes($("shapes"), css);
matchMedia("(prefers-color-scheme: dark)").onchange = () => { if (scene) picture?.colours(); shapes($("shapes"), css); redraw(); };
