// The page: keeps the newest messages, and draws when something has changed.

import { arrows, axesOf, roundUp } from "./arrows.js";
import { Bench, nameOf } from "./bench.js";
import { AHEAD_S, Camera } from "./camera.js";
import { SHOWS, css, isDark, onScheme, shapeOf } from "./colours.js";
import { haltReason } from "./halted.js";
import { hold } from "./frames.js";
import { axes as axesSeen } from "./ground.js";
import { Health } from "./health.js";
import { drawRamp, shapes } from "./legend.js";
import { Link } from "./link.js";
import { direction, point, project } from "./math.js";
import { Painter } from "./pace.js";
import { Picture } from "./picture.js";
import { Plots } from "./plots.js";
import { cylinders, facing, frames, outline, placed } from "./robot.js";
import { number } from "./scale.js";
import { DEAD, cellOf } from "./snapshot.js";
import { stateOf } from "./state.js";
import { TimeBar } from "./time.js";
import { listen, pick } from "./touch.js";
import { wires } from "./wires.js";
import * as words from "./words.js";

const $ = (id) => document.getElementById(id);
const canvas = $("picture"), camera = new Camera(), health = new Health();
// What the picture shows of the scene: its outline, its links, its joints' axes; the pose, and the one to expect; the number
// of joints whose positions are unknown.
let parts = [], links = [], turning = [], pose = new Float64Array(), soon = pose, poses = [], drawnAt = 0, jumps = true, unplaced = 0, most = 1, shownArrows = null, shownAxes = "";
let picture = null, scene = null, plots = null, snapshot = null, said = null, all = null, trees = [], chosen = -1, pressed = -1, awaited = -1, isPressing = false;
// For browser tests.
window.skinbus = { frames: 0, snapshots: 0, where, camera, filled: () => filled(), joints: () => snapshot?.joints.map((joint) => joint.position) ?? [] };

function message(text) {
  $("message").textContent = text;
  $("message").hidden = !text;
}

try {
  picture = new Picture(canvas);
} catch (error) {
  message(`The picture cannot be drawn: ${error.message}. The tables still work.`);
}

const size = () => picture?.size ?? [canvas.clientWidth, canvas.clientHeight], view = () => camera.matrix(...size());

const painter = new Painter(picture?.software ?? false, draw);
$("software").hidden = !picture?.software;
const redraw = () => painter.redraw();

function draw(ratio) {
  if (!scene || !snapshot) return { drew: false, worked: false };
  const news = isPressing ? null : said;
  if (news) {
    said = null;
    words.link(stateOf({ connected: true, said: news }));
    words.say(scene, news, ask, health, hardest());
    bench.say(scene, news.bench, chosen);
    trees = news.buses.map((bus) => bus.tree);
    $("tree-switch").hidden = trees.every((tree) => !tree);
    drawTree();
  }
  plots.draw();
  follow();
  picture?.update(snapshot.cells, SHOWS[$("shows").value], chosen);
  point3d();
  const drew = picture?.draw(view(), all, ratio) ?? false;
  if (drew) triad();
  if (drew || news) window.skinbus.frames++;
  if (camera.moves) setTimeout(redraw);
  return { drew, worked: news !== null };
}

// Moves the camera to where the robot is now.
function follow() {
  const now = performance.now(), seconds = Math.min(2, (now - drawnAt) / 1000);
  drawnAt = now;
  // Without new snapshots the robot stands still.
  const stands = poses.length < 2 || now - poses[poses.length - 1].at > 400;
  camera.follow(pose, stands ? pose : soon, seconds, now, ...size(), jumps);
  if (jumps) picture?.lay(camera.size, floor());
  jumps = false;
}

// The height of the ground: that of the base, or of anything that is below it at first.
const floor = () => Math.min(0, pose.reduce((low, v, i) => (i % 3 === 2 ? Math.min(low, v) : low), Infinity));

// Keeps a new pose, and estimates the next one from how fast the joints move. Snapshots may arrive in bursts: their own
// times say how fast.
function placeRobot(joints, time) {
  poses.push({ at: performance.now(), time, joints });
  while (poses.length > 2 && time - poses[1].time > 0.06) poses.shift();
  const [before] = poses, passed = time - before.time;
  pose = placed(parts, all);
  soon = passed > 0.005 && passed < 1 ? placed(parts, frames(scene, joints.map((q, j) => q + (q - before.joints[j]) / passed * AHEAD_S))) : pose;
}

// Draws the arrows of a new snapshot.
function point3d() {
  const dark = isDark(), late = health.lateJoints(), state = `${snapshot.number} ${snapshot.time} ${dark} ${$("arrows").checked} ${[...late]}`;
  if (!picture || state === shownArrows) return;
  shownArrows = state;
  const shown = $("arrows").checked;
  most = Math.max(most, roundUp(Math.max(1, ...snapshot.joints.map((joint) => Math.abs(joint.distributed) || 0))));
  picture.point(arrows(scene, turning, all, snapshot, { dark, force: shown, torque: shown && picture.theme.torque, alarm: picture.theme.alarm, most, late }));
  const turn = `${Number(most.toPrecision(3))} ${scene.joints[0]?.torque_unit ?? "Nm"}`;
  // Setting a text has the browser lay out the page, even if it is the same.
  if ($("turn").textContent !== turn) $("turn").textContent = turn;
}

// Draws the axes of the robot's base in the corner.
function triad() {
  const at = axesSeen(camera.basis()), state = JSON.stringify(at.map(({ x, y, deep }) => [x, y, deep < 0]));
  if (state === shownAxes) return;
  shownAxes = state;
  for (const { name, x, y, deep } of at) {
    const line = $(`axis-${name}`), text = $(`name-${name}`);
    for (const [key, value] of [["x2", x * 22], ["y2", y * 22], ["opacity", deep < 0 ? 0.6 : 1]]) line.setAttribute(key, String(value));
    text.setAttribute("x", String(x * 30));
    text.setAttribute("y", String(y * 30 + 4));
  }
}

// The share of the picture that the robot's box fills along its larger side, and the farthest that it is outside, in
// pixels.
function filled() {
  const { clientWidth: w, clientHeight: h } = canvas, box = [Infinity, Infinity, -Infinity, -Infinity], m = view();
  for (let i = 0; i < pose.length; i += 3) {
    const [x, y] = project(m, pose.slice(i, i + 3), w, h) ?? [-w, -h];
    [x, y].forEach((v, k) => { box[k] = Math.min(box[k], v); box[k + 2] = Math.max(box[k + 2], v); });
  }
  return [Math.max((box[2] - box[0]) / w, (box[3] - box[1]) / h), Math.max(-box[0], -box[1], box[2] - w, box[3] - h)];
}

const name = (i) => (i < 0 ? "" : nameOf(scene, scene.cells[i]));

// The share of the view's choice that touched cells have, beside all others.
const TOUCHED = 30;

// Looks from where most of the skin is seen, and above all the cells that are touched.
function direct(words) {
  camera.choose(scene.cells.map((cell, i) => [direction(all[scene.buses[cell.bus].chain][cell.row], cell.normal), words[2 * i] >>> 16 ? TOUCHED : 1]));
}

// Turns to a cell whose front is not seen.
function turnTo(i) {
  const to = i >= 0 && all ? facing(scene, all, links, i, camera) : null;
  if (!to) return;
  camera.turnTo(to.yaw, to.pitch, matchMedia("(prefers-reduced-motion: reduce)").matches);
  redraw();
}

function choose(i, turns = true) {
  if (turns) turnTo(i);
  if (i === chosen) return;
  chosen = i;
  words.chosen(name(i));
  $("search").value = name(i);
  $("hold").disabled = i < 0 || !scene.may_press;
  plots.choose(i);
  if (i >= 0 && snapshot) words.tell(`Cell ${name(i)}: ${shapeOf(cellOf(snapshot.cells, i)).name}, ${forceOf(i)}`);
  link.send(i < 0 ? { do: "unchoose" } : { do: "choose", cell: name(i) });
  redraw();
}

function press(i, turns = false) {
  choose(i, turns);
  if (!scene.may_press) return;
  if (pressed !== i) awaited = i;
  pressed = i;
  link.send({ do: "press", cell: name(i), force_n: Number($("force").value) });
}

// The cell that is pressed hardest, as text; empty if none is.
function hardest() {
  const { cells } = snapshot;
  let at = -1, most = 0;
  for (let i = 0; i < scene.cells.length; i++) {
    const force = cells[2 * i] >>> 16;
    if (force > most && cellOf(cells, i).status !== DEAD) [at, most] = [i, force];
  }
  return at < 0 ? "" : `${name(at)}, ${forceOf(at)}`;
}

const forceOf = (i) => { const { force, status } = cellOf(snapshot.cells, i); return status === DEAD ? "no force known" : `${(force / 1000).toFixed(1)} N`; };

// Tells the result of a press when the cell answers with a force and the joints with torques.
function answerPress() {
  if (awaited < 0 || pressed !== awaited || !cellOf(snapshot.cells, awaited).force) return;
  const torques = snapshot.joints.map(({ distributed }, at) => [Math.abs(distributed) || 0, at]), [size, at] = torques.reduce((a, b) => (b[0] > a[0] ? b : a), [0, 0]);
  if (size < 1e-3) return;
  words.tell(`Cell ${name(awaited)} is pressed: ${forceOf(awaited)}; the largest torque is ${number(snapshot.joints[at].distributed)} ${scene.joints[at].torque_unit}, of ${scene.joints[at].name}`);
  awaited = -1;
}

function release() {
  if (pressed < 0) return;
  words.tell(`Cell ${name(pressed)} is released`);
  pressed = awaited = -1;
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
  if (answer.ok && scene === of) {
    picture.surface(corners);
    parts = outline(scene, corners);
    if (all) pose = soon = placed(parts, all);
    jumps = true;
  }
  redraw();
}

const link = new Link({
  scene(it) {
    scene = it;
    [chosen, pressed, snapshot, said, all, jumps, most, poses, shownArrows, unplaced] = [-1, -1, null, null, null, true, 1, [], null, 0];
    [parts, links, turning] = [outline(scene), cylinders(scene), axesOf(scene)];
    camera.fit();
    health.forget();
    document.title = `${scene.name}: skinbus view`;
    $("name").textContent = scene.name;
    plots = new Plots($("plots"), scene, { seek: (at) => time.go(at), redraw });
    words.chosen("");
    words.link(stateOf({}));
    for (const id of ["halt", "resume"]) $(id).disabled = !scene.may_press;
    words.buses(scene);
    picture?.set(scene);
    if (picture && scene.shells.length) surface(scene);
  },
  snapshot(it) {
    snapshot = it;
    // Links whose joints' positions are unknown are drawn as at 0. The first position of a joint is no motion.
    const joints = it.joints.map((joint) => joint.position || 0), first = !all;
    const missing = it.joints.filter((joint) => Number.isNaN(joint.position)).length;
    if (missing < unplaced) [jumps, poses] = [true, []];
    unplaced = missing;
    all = frames(scene, joints);
    placeRobot(joints, it.time);
    if (first || jumps && camera.auto && camera.steers) direct(it.cells);
    plots.push(it);
    answerPress();
    window.skinbus.snapshots++;
    redraw();
  },
  history(it) {
    plots.replace(it);
    [jumps, poses] = [true, []];
  },
  said(it) {
    said = it;
    health.begin(snapshot?.time ?? 0, it.playback ? 1 + it.playback.speed : Infinity);
    plots.say(it, haltReason(it), health.follow(scene, it.buses));
    time.say(it.playback);
    redraw();
  },
  closed(refusal) {
    pressed = -1;
    words.link(stateOf({ connected: false, refusal }));
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
  turn(dx, dy) { camera.turn(dx, dy, performance.now()); redraw(); },
  zoom(by) { camera.nearer(by); redraw(); },
  fit,
  next(step) { if (scene) choose((chosen + step + scene.cells.length) % scene.cells.length); },
  pressChosen() { if (chosen >= 0) press(chosen); },
});

function fit() {
  camera.fit();
  redraw();
}
$("fit").onclick = fit;
$("arrows").onchange = redraw;

$("force").oninput = () => {
  $("newtons").textContent = `${Number($("force").value).toFixed(1)} N`;
  if (pressed >= 0) press(pressed);
};
$("hold").onclick = ({ detail }) => {
  if (detail > 1) return;
  if (pressed >= 0) return release();
  press(chosen);
  $("hold").setAttribute("aria-pressed", "true");
};
$("search").onchange = () => {
  const text = $("search").value.trim();
  const found = scene ? scene.cells.findIndex((cell, i) => name(i) === text || String(cell.node) === text) : -1;
  $("search").setAttribute("aria-invalid", String(found < 0 && text !== ""));
  if (found >= 0) choose(found);
  else if (text) words.tell(`There is no cell ${text}: enter bus:node, as ${name(0)}`);
};
$("hold-frames").onclick = () => hold($("hold-frames").getAttribute("aria-pressed") !== "true");
$("halt").onclick = () => link.send({ do: "halt" });
$("resume").onclick = () => link.send({ do: "resume" });
window.addEventListener("blur", release);
for (const event of ["resize", "sized"]) window.addEventListener(event, () => { plots?.refresh(); redraw(); });
// Nothing moves under the pointer while a button is down: what has come is shown after that.
window.addEventListener("pointerdown", ({ target }) => { isPressing = target.closest?.("button") !== null; });
for (const end of ["pointerup", "pointercancel", "blur"]) window.addEventListener(end, () => { isPressing = false; redraw(); });

function legend() {
  const shows = SHOWS[$("shows").value];
  $("scale").hidden = shows.isBus ?? false;
  $("bus-colours").hidden = !shows.isBus;
  if (shows.isBus) return redraw();
  $("low").textContent = number(shows.low).replace(/\.0+$/, "");
  $("high").textContent = `${number(shows.high).replace(/\.0+$/, "")} ${shows.unit}`;
  drawRamp($("ramp"));
  redraw();
}
$("shows").onchange = legend;
$("tree").onchange = () => { drawTree(); redraw(); };
legend();
shapes($("shapes"), css);
function recolour() {
  if (scene) picture?.colours();
  shapes($("shapes"), css);
  legend();
  time.recolour();
  plots?.refresh();
}
onScheme(recolour);
// Paper is white.
for (const [name, is] of [["beforeprint", true], ["afterprint", false]]) {
  window.addEventListener(name, () => {
    document.documentElement.classList.toggle("printing", is);
    time.recolour();
    if (plots) { plots.refresh(); plots.draw(); }
  });
}
