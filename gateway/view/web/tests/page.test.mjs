// The page's modules without a browser: node --test gateway/view/web/tests/
import assert from "node:assert/strict";
import { test } from "node:test";

import { about, allowed, isDown, processOf } from "../bench.js";
import { AHEAD_S, Camera } from "../camera.js";
import { BUSES, SHAPES, SHOWS, busColour, colourOf, ramp, shapeOf } from "../colours.js";
import { haltedWords } from "../halted.js";
import { Health } from "../health.js";
import { cross, direction, dot, look, perspective, point, project, row, times, unit } from "../math.js";
import { Pace, Painter, SOFTWARE_HZ, STILL_MS } from "../pace.js";
import { axes, cylinders, facing, frames, neighbors, outline, placed, triangles } from "../robot.js";
import { cellOf, decode, decodeHistory } from "../snapshot.js";
import { pick } from "../touch.js";
import { number } from "../scale.js";
import { clock, requested } from "../time.js";
import { arms, demo } from "./motions.mjs";
import { CUT, FLOATS, MOVED, TREE, WIRE, ribbons, wired, wires } from "../wires.js";

const close = (a, b, within = 1e-9) => a.forEach((v, i) => assert.ok(Math.abs(v - b[i]) < within, `${a} ${b}`));
const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

// A UR5: a, alpha, d of each row, as its maker publishes them.
const UR5 = [[0, Math.PI / 2, 0.089159], [-0.425, 0, 0], [-0.39225, 0, 0], [0, Math.PI / 2, 0.10915], [0, -Math.PI / 2, 0.09465], [0, 0, 0.0823]];
const scene = (cells = [], tubes = []) => ({
  joints: UR5.map((_, i) => ({ name: `joint${i + 1}`, unit: "rad", torque_unit: "Nm" })),
  chains: [{ name: "chain", base: IDENTITY, rows: UR5.map(([a, alpha, d], joint) => ({ joint, slides: false, a, alpha, d, theta: 0 })) }],
  buses: [{ name: "vcan0", chain: 0 }], cells, tubes, pitch: 0.028, may_press: true,
});
const cell = (row, position, normal) => ({ bus: 0, node: 1, row, joint: row, position, normal, neighbors: [], root: false });

test("the tool of a UR5 is where its maker's table puts it", () => {
  const tip = (q) => point(frames(scene(), q)[0][6], [0, 0, 0]);
  close(tip([0, 0, 0, 0, 0, 0]), [-0.81725, -0.19145, -0.005491], 1e-6);
  // The base turned by a quarter turn, and by a whole one.
  close(tip([Math.PI / 2, 0, 0, 0, 0, 0]), [0.19145, -0.81725, -0.005491], 1e-6);
  close(tip([2 * Math.PI, 0, 0, 0, 0, 0]), tip([0, 0, 0, 0, 0, 0]), 1e-9);
});

test("a joint that slides moves along its axis, a fixed row does not move, and a base counts", () => {
  const base = times(IDENTITY, [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]);
  const rows = [{ joint: 0, slides: true, a: 0, alpha: 0, d: 0.3, theta: 0 }, { joint: null, slides: false, a: 0.1, alpha: 0, d: 0, theta: 0 }];
  const all = frames({ chains: [{ base, rows }] }, [0.2]);
  close(point(all[0][2], [0, 0, 0]), [5, 0.1, 0.5]);
});

test("links are cylinders with normals that point outward", () => {
  const all = cylinders(scene());
  assert.ok(all.length >= 8 && all.every((it) => it.radius > 0 && it.radius < 0.11));
  const flat = triangles({ from: [0, 0, 0], to: [0, 0, 1], radius: 0.5 });
  for (let k = 0; k < flat.length; k += 18) {
    const [a, b, c] = [0, 6, 12].map((at) => flat.slice(k + at, k + at + 3));
    const facing = cross([0, 1, 2].map((i) => b[i] - a[i]), [0, 1, 2].map((i) => c[i] - a[i]));
    assert.ok(dot(facing, flat.slice(k + 3, k + 6)) > 0, "the corners turn left, seen from outside");
  }
});

test("a link beside the line of its table is drawn where its cells are", () => {
  const tube = { chain: 0, row: 2, ends: [[0.4, 0, 0.14], [0.02, 0, 0.14]], radius: 0.07 };
  const at = cylinders(scene([], [tube])).filter((it) => it.row === 2);
  assert.ok(at.some((it) => Math.abs(it.from[2] - 0.14) < 1e-9 && Math.abs(it.to[2] - 0.14) < 1e-9));
});

test("a snapshot is read as the server writes it", () => {
  const data = new DataView(new ArrayBuffer(24 + 12 * 2 + 8));
  [7, 2, 1].forEach((v, i) => data.setUint32(4 * i, v, true));
  data.setFloat64(16, 1.5, true);
  [0.5, 1, 2, -0.5, -1, -2].forEach((v, i) => data.setFloat32(24 + 4 * i, v, true));
  [4, 16].forEach((v, i) => data.setUint8(48 + i, v));
  data.setUint16(50, 6000, true);
  data.setUint16(52, 16384, true);
  data.setInt16(54, -150, true);
  const { cells, ...rest } = decode(data.buffer);
  assert.deepEqual(rest, {
    number: 7, time: 1.5, joints: [{ position: 0.5, distributed: 1, central: 2 }, { position: -0.5, distributed: -1, central: -2 }],
  });
  assert.equal(cells.length, 2);
  assert.deepEqual(cellOf(cells, 0), { status: 4, flags: 16, force: 6000, proximity: 16384, temperature: -150 });
  assert.throws(() => decode(data.buffer.slice(0, 50)));
});

test("a cell's shape says the worst about it, and each shape is another", () => {
  const of = (status, flags) => shapeOf({ status, flags }).name;
  assert.equal(of(2, 0), "normal");
  assert.equal(of(4, 3), "silent");
  assert.equal(of(0, 0), "no frame received");
  assert.equal(of(1, 1 | 2), "no parameters");
  assert.equal(of(1, 2 | 8), "different parameters");
  assert.equal(of(3, 8), "stale: no reply");
  assert.equal(of(1, 8 | 16), "halted");
  assert.equal(of(2, 16 | 32), "stuck: constant value");
  assert.equal(new Set(SHAPES.map((it) => it.shape)).size, SHAPES.length);
});

test("colours grow lighter with the value on a dark page and darker on a light one, and values beyond the range have its ends", () => {
  const light = (share, dark) => { const [r, g, b] = ramp(share, dark); return 0.3 * r + 0.6 * g + 0.1 * b; };
  for (let share = 0.05; share <= 1; share += 0.05) {
    assert.ok(light(share, true) > light(share - 0.05, true));
    assert.ok(light(share, false) < light(share - 0.05, false));
  }
  assert.deepEqual([ramp(-1), ramp(9)], [ramp(0), ramp(1)]);
});

test("the nearest cell that faces the eye is picked", () => {
  const cells = [cell(1, [0, 0, 0.1], [0, 0, 1]), cell(1, [0, 0, 0.3], [0, 0, 1]), cell(1, [0, 0, 0.5], [0, 0, -1])];
  const it = { ...scene(cells), chains: [{ base: IDENTITY, rows: [{ joint: null, slides: false, a: 0, alpha: 0, d: 0, theta: 0 }] }] };
  const all = frames(it, []), eye = [0.001, 0, 2];
  const view = times(perspective(2, 1, 0.05, 20), look(eye, [0, 0, 0]));
  const camera = { eye: () => eye };
  assert.equal(pick(it, all, camera, view, 400, 400, 200, 200), 1);
  assert.equal(pick(it, all, camera, view, 400, 400, 20, 20), -1);
  assert.equal(project(view, [0, 0, 3], 400, 400), null, "behind the eye");
  // Small ones on one surface: each by its middle, not all the one that is a little nearer.
  const small = [0, 1, 2].map((k) => cell(1, [0.004 * k, 0, 0.001 * k], [0, 0, 1])), of = { ...it, cells: small, pitch: 0.004 };
  small.forEach(({ position }, i) => {
    const [x, y] = project(view, point(frames(of, [])[0][1], position), 400, 400);
    assert.equal(pick(of, frames(of, []), camera, view, 400, 400, x, y), i);
  });
});

// The share of the picture that the robot's box fills along its larger side, and how far it is outside in pixels.
function filled(camera, pose, w, h) {
  const box = [Infinity, Infinity, -Infinity, -Infinity], view = camera.matrix(w, h);
  for (let i = 0; i < pose.length; i += 3) {
    project(view, pose.slice(i, i + 3), w, h).slice(0, 2).forEach((v, k) => { box[k] = Math.min(box[k], v); box[k + 2] = Math.max(box[k + 2], v); });
  }
  return [Math.max((box[2] - box[0]) / w, (box[3] - box[1]) / h), Math.max(-box[0], -box[1], box[2] - w, box[3] - h)];
}

for (const [name, { scene: it, at }] of Object.entries({ demo, arms })) {
  test(`the picture is filled by the robot and holds it, and zooms calmly: ${name}`, () => {
    const parts = outline(it), place = (q) => placed(parts, frames(it, q));
    const q = (t) => { const k = Math.min(at.length - 2, Math.floor(t * 10)); return at[k].map((v, j) => v + (at[k + 1][j] - v) * (t * 10 - k)); };
    for (const [w, h] of [[1000, 560], [1520, 780], [390, 470]]) {
      for (const hz of [3, 4, 15, 30, 60]) {
        const camera = new Camera();
        let before = null;
        for (let t = 0; t < (at.length - 2) / 10; t += 1 / hz) {
          const now = q(t), passed = Math.min(0.1, 1 / hz), last = q(Math.max(0, t - passed)), next = now.map((v, j) => v + (v - last[j]) / passed * AHEAD_S);
          if (!t) camera.choose([[[0, -1, 0], 1]]);
          camera.follow(place(now), place(next), 1 / hz, 1e9, w, h);
          const [share, outside] = filled(camera, place(now), w, h), said = `${w} x ${h}, ${hz} Hz, ${t.toFixed(2)} s`;
          assert.ok(share >= 0.7, `${share} of the picture, ${said}`);
          assert.ok(outside <= 0, `${outside} px outside, ${said}`);
          const zoom = before === null ? 0 : Math.abs(Math.log(camera.distance / before)) * hz;
          assert.ok(zoom <= Math.log(1.2) + 1e-9, `${zoom}, ${said}`);
          before = camera.distance;
        }
      }
    }
  });
}

// A robot seen in one direction fits at 4 Hz only if its size, to the fourth of a second, grows by no more than the zoom
// may follow and the shares between 0.7 and 1 have room for: returns how much of the logarithm is missing.
function missing(sizes, hz) {
  const [room, rate] = [Math.log(1 / 0.7), Math.log(1.2) / hz];
  let most = 0;
  sizes.forEach((from, i) => sizes.forEach((to, k) => { most = Math.max(most, Math.abs(to - from) - room - rate * Math.abs(k - i)); }));
  return most;
}

test("hardly any view that does not turn could hold the demo", () => {
  const { scene: it, at } = demo, parts = outline(it), poses = at.filter((_, k) => k % 2 === 0).map((q) => placed(parts, frames(it, q))), [w, h] = [1000, 560];
  const camera = new Camera(), hold = [];
  for (let yaw = -Math.PI; yaw < Math.PI; yaw += Math.PI / 6) {
    for (const pitch of [0.3, 0.5, 0.8, 1.1]) {
      const sizes = poses.map((pose) => Math.log(camera.fitted(pose, w, h, 1, camera.basis(yaw, pitch)).distance));
      if (missing(sizes, 5) === 0) hold.push([yaw, pitch]);
    }
  }
  assert.ok(hold.length <= 4, `of 52 views that do not turn, these could hold the demo: ${hold}`);
});

test("the demo is held from every side, at the uneven times at which a busy machine draws it", () => {
  const { scene: it, at } = demo, parts = outline(it), place = (q) => placed(parts, frames(it, q));
  // Snapshots come 30 times a second; a frame shows the newest.
  const poses = Array.from({ length: 3 * (at.length - 2) }, (_, i) => at[Math.floor(i / 3)].map((v, j) => v + (at[Math.floor(i / 3) + 1][j] - v) * (i % 3) / 3)).map(place);
  let drawn = 0, small = 0;
  for (const [w, h] of [[880, 560], [1000, 382], [390, 473]]) {
    for (let side = 0; side < 12; side++) {
      const camera = new Camera(), yaw = side * Math.PI / 6;
      camera.choose([[[Math.cos(yaw), Math.sin(yaw), 0], 1]]);
      let state = side + 1;
      const random = () => { state = state * 48271 % 2147483647; return state / 2147483647; };
      for (let t = 0.3, passed = 0.1; t * 30 < poses.length; t += passed) {
        const k = Math.floor(t * 30), pose = poses[k], last = poses[k - 2];
        camera.follow(pose, pose.map((v, i) => v + (v - last[i]) * 15 * AHEAD_S), passed, 1e9, w, h);
        const [share, outside] = filled(camera, pose, w, h);
        assert.ok(share >= 0.6 && outside <= 5, `${w} x ${h}, side ${side}, ${t.toFixed(2)} s: ${share}, ${outside} px outside`);
        drawn++;
        small += share < 0.7 || outside > 0;
        passed = 0.06 + 0.05 * random() + (random() < 0.04 ? 0.3 * random() : 0);
      }
    }
  }
  assert.ok(drawn > 3000 && small <= drawn / 500, `${small} of ${drawn} frames`);
});

test("a robot that grows faster than any zoom in one frame is held by what turning can give", () => {
  // A cube, which is as large from all sides, becomes twice as large between two frames.
  const cube = (size) => [-1, 1].flatMap((x) => [-1, 1].flatMap((y) => [-1, 1].flatMap((z) => [x * size, y * size, z * size])));
  const camera = new Camera(), [w, h] = [800, 800], follow = (size) => camera.follow(cube(size), cube(size), 0.25, 1e9, w, h);
  for (let k = 0; k < 8; k++) follow(0.5);
  const before = camera.distance;
  follow(2);
  assert.ok(missing([Math.log(0.5), Math.log(2)], 4) > 0.9, "no view can hold both");
  assert.ok(Math.log(camera.distance / before) * 4 <= Math.log(1.2) + 1e-9, "the zoom stays calm");
  for (let k = 0; k < 80; k++) follow(2);
  assert.ok(filled(camera, cube(2), w, h)[1] <= 0 && filled(camera, cube(2), w, h)[0] >= 0.7, "and it fits again");
});

test("a user's view stays where it is until it is to fit again, and a turned view stays filled", () => {
  const { scene: it, at } = demo, pose = placed(outline(it), frames(it, at[0])), [w, h] = [1000, 600];
  const camera = new Camera(), follow = (seconds = 0.05, now = 1e9) => camera.follow(pose, pose, seconds, now, w, h);
  follow();
  camera.turn(200, 0, 1e9);
  for (let k = 0; k < 40; k++) follow();
  assert.ok(filled(camera, pose, w, h)[0] > 0.75);
  const { yaw } = camera;
  camera.nearer(3, [0, 0], w, h);
  const { middle, distance } = camera;
  follow();
  assert.deepEqual([camera.yaw, camera.middle, camera.distance], [yaw, middle, distance]);
  camera.fit();
  follow();
  assert.ok(Math.abs(filled(camera, pose, w, h)[0] - 0.87) < 1e-6);
  camera.turnTo(2, 0.4, false);
  assert.ok(camera.moves);
  for (let k = 0; k < 60; k++) follow();
  close([Math.cos(camera.yaw), Math.sin(camera.yaw), camera.pitch], [Math.cos(2), Math.sin(2), 0.4]);
  assert.ok(!camera.moves);
});

test("a cell behind its link, or turned away, is turned to", () => {
  const { scene: of, at } = demo, [tube] = of.tubes, all = frames(of, at[0]), links = cylinders(of);
  const middle = [0, 1, 2].map((i) => (tube.ends[0][i] + tube.ends[1][i]) / 2), axis = unit([0, 1, 2].map((i) => tube.ends[1][i] - tube.ends[0][i]));
  for (let k = 0; k < 12; k++) {
    const out = unit(cross(axis, [Math.cos(k), Math.sin(k), 0.3])), position = middle.map((v, i) => v + out[i] * tube.radius / 0.97);
    const it = { ...of, cells: [{ bus: 0, node: 1, row: tube.row, joint: 2, position, normal: out, neighbors: [], root: false }] };
    const normal = direction(all[0][tube.row], out), way = ({ yaw, pitch }) => [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];
    const from = { yaw: Math.atan2(-normal[1], -normal[0]), pitch: 0 }, to = facing(it, all, links, 0, from);
    assert.ok(to && dot(way(to), normal) > 0.5, "its front is seen");
    assert.equal(facing(it, all, links, 0, to), null, "what is seen needs no turn");
  }
});

test("a zoom keeps what is under the pointer, a drag moves it, and a cell is faced", () => {
  const camera = new Camera(), [w, h] = [1000, 800];
  const box = [-0.5, 0.5].flatMap((x) => [-0.5, 0.5].flatMap((y) => [0, 1].flatMap((z) => [x, y, z])));
  const follow = () => camera.follow(box, box, 0, 0, w, h);
  follow();
  const seen = (p) => project(camera.matrix(w, h), p, w, h).slice(0, 2);
  // A point in the plane of the middle, which is seen to the right and above.
  const up = cross(camera.toward(), unit(cross([0, 0, 1], camera.toward())));
  const p = camera.middle.map((v, i) => v + 0.2 * up[i] + 0.1 * unit(cross([0, 0, 1], camera.toward()))[i]);
  const [x, y] = seen(p);
  assert.ok(x > w / 2 && y < h / 2);
  camera.nearer(2, [x - w / 2, y - h / 2], w, h);
  close(seen(p), [x, y], 1e-6);
  camera.move(30, -20, w, h);
  close(seen(p), [x + 30, y - 20], 1e-6);
  camera.face([0.1, 0.2, 0.3], [0, 1, 0], 0.015, 20, w, h);
  close(seen([0.1, 0.2, 0.3]), [w / 2, h / 2], 1e-6);
  assert.ok(camera.grain(w, h) * 20 <= 0.015 * 1.0001 && dot(camera.toward(), [0, 1, 0]) > 0.9);
  camera.fit();
  follow();
  const [share, outside] = filled(camera, box, w, h);
  assert.ok(Math.abs(share - 0.87) < 1e-6 && outside < 0);
});

test("totals that grow are bad for a while, and a seek forgets when", () => {
  const health = new Health(), at = (time, total) => { health.begin(time); return health.count("lost", total); };
  assert.deepEqual([at(1, 5), at(2, 5), at(3, 7)], [0, 0, 2]);
  assert.deepEqual([health.last("lost"), health.isPresent("lost")], [3, true]);
  at(8, 7);
  assert.deepEqual([health.last("lost"), health.isPresent("lost")], [3, false]);
  at(2, 7);
  assert.equal(health.last("lost"), null);
});

test("numbers are short", () => {
  assert.deepEqual([0, 0.12345, -1.5, 12.34, -250.4].map(number), ["0.0000", "0.1235", "−1.50", "12.3", "−250"]);
  close(unit([0, 3, 4]), [0, 0.6, 0.8]);
  close(row(1, 0, 2, 0).slice(12), [1, 0, 2, 1]);
});

test("what was before a position is read as the server writes it", () => {
  const data = new DataView(new ArrayBuffer(16 + 2 * (8 + 8)));
  [3, 1, 2, 1].forEach((v, i) => data.setUint32(4 * i, v, true));
  data.setFloat64(16, 1.5, true);
  data.setFloat32(24, 0.25, true);
  data.setFloat32(28, 0.5, true);
  data.setFloat64(32, 1.75, true);
  const all = decodeHistory(data.buffer);
  assert.deepEqual(all[0], { time: 1.5, joints: [{ distributed: 0.25, central: 0.5 }] });
  assert.equal(all[1].time, 1.75);
  assert.throws(() => decodeHistory(data.buffer.slice(0, 40)));
});

test("times are said as clocks, and an address asks for one", () => {
  assert.deepEqual([0, 8.3, 64.9551, 3599.9999, 3600, 86400.5].map(clock),
    ["0:00.000", "0:08.300", "1:04.955", "1:00:00.000", "1:00:00.000", "24:00:00.500"]);
  assert.deepEqual(["#at=12.5", "#at=0", "#at=", "#at=-1", "#at=1e9", "#cell=1", ""].map(requested), [12.5, 0, null, null, null, null, null]);
});

test("a hexagon has its sides toward its neighbors, and lies in its cell's plane", () => {
  const cells = [cell(1, [0, 0, 0], [0, 0, 1]), { ...cell(1, [0.02, 0.01, 0.005], [0, 0, 1]), node: 2 }, { ...cell(2, [1, 0, 0], [1, 0, 0]), node: 3 }];
  cells[0].neighbors = [3, 2];
  const it = scene(cells), nearest = neighbors(it);
  assert.deepEqual(nearest, [1, -1, -1], "one in another frame is none");
  for (const i of [0, 1, 2]) {
    const [x, y] = axes(it, nearest, i);
    close([dot(x, y), dot(x, cells[i].normal), dot(x, x), dot(y, y)], [0, 0, 1, 1]);
    close(cross(x, y), cells[i].normal);
  }
  const [x] = axes(it, nearest, 0);
  assert.ok(Math.abs(dot(x, unit([0.02, 0.01, 0])) - Math.cos(Math.PI / 6)) < 1e-9);
});

test("a frame is followed by as long a pause as it took, and software has a limit and is sharp when it stands still", () => {
  const pace = new Pace(false);
  assert.equal(pace.wait(1000), 0);
  pace.drew(1000, 1010);
  pace.ready(1040);
  assert.equal(pace.wait(1040), 30);
  pace.ready(9999);
  assert.equal(pace.wait(1040), 970, "a page that was hidden is not slow for ever");
  const soft = new Pace(true);
  soft.drew(1000, 1001);
  soft.ready(1002);
  assert.ok(Math.abs(soft.wait(1002) - (1000 / SOFTWARE_HZ - 2)) < 1e-9);
  assert.deepEqual([soft.ratio(1, false), soft.ratio(3, false), soft.ratio(1, true)], [1, 1, 2]);
  assert.deepEqual([pace.ratio(1, false), pace.ratio(3, true)], [1, 2]);
  // Frames that are late have fewer pixels until they are not.
  const frame = (took) => { soft.drew(0, 0); soft.ready(took); return soft.ratio(1, false); };
  const many = (took) => Array.from({ length: 40 }, () => frame(took))[39];
  assert.deepEqual([many(30), many(90), soft.ratio(1, true), many(30), many(5)], [1, 0.7, 2, 0.7, 1]);
});

test("a picture that is about to change is not drawn in full resolution, one that stands still is", (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const drawn = [], keep = [globalThis.requestAnimationFrame, globalThis.window];
  [globalThis.requestAnimationFrame, globalThis.window] = [(then) => { then(0); }, { devicePixelRatio: 1 }];
  let changed = true;
  const painter = new Painter(true, (ratio) => { const drew = changed || ratio === 2; if (drew) drawn.push(ratio); changed = false; return { drew, worked: true }; });
  painter.redraw();
  t.mock.timers.tick(1000 / SOFTWARE_HZ);
  assert.equal(drawn.length, 1);
  // The next frame is due, however late.
  t.mock.timers.tick(STILL_MS - 100);
  painter.pace.wait = () => 5000;
  changed = true;
  painter.redraw();
  t.mock.timers.tick(4000);
  assert.deepEqual(drawn, [1]);
  t.mock.timers.tick(1000);
  assert.deepEqual(drawn, [1, 1]);
  painter.pace.wait = () => 0;
  painter.redraw();
  for (let k = 0; k < 3; k++) t.mock.timers.tick(STILL_MS);
  assert.deepEqual(drawn, [1, 1, 2], "news without a change do not keep it coarse");
  [globalThis.requestAnimationFrame, globalThis.window] = keep;
});

test("a picture that stands still becomes sharp, however often news come", (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  let now = 0;
  const keep = [globalThis.requestAnimationFrame, globalThis.window], drawn = [];
  t.mock.method(performance, "now", () => now);
  [globalThis.requestAnimationFrame, globalThis.window] = [(then) => setTimeout(then, 150), { devicePixelRatio: 1 }];
  let changed = true;
  const painter = new Painter(true, (ratio) => { const drew = changed || ratio === 2; if (drew) drawn.push(ratio); changed = false; return { drew, worked: true }; });
  for (let k = 0; k < 40; k++) {
    painter.redraw();
    now += 50;
    t.mock.timers.tick(50);
  }
  assert.deepEqual(drawn.slice(0, 2), [1, 2]);
  [globalThis.requestAnimationFrame, globalThis.window] = keep;
});

test("a process offers what makes sense, and says which cells it runs", () => {
  const state = { processes: [{ bus: 1, nodes: [1, 63], phase: "running" }], links_down: [{ bus: 1, nodes: [4, 9] }] };
  const process = processOf(state, { bus: 1, node: 63 });
  assert.deepEqual(allowed(process), ["kill", "stop", "restart"]);
  assert.match(about(process), /cells 1 to 63; .* is running\.$/);
  assert.deepEqual(allowed({ phase: "stopped" }), ["kill", "continue", "restart"]);
  assert.deepEqual(allowed({ phase: "ended" }), ["restart"]);
  for (const other of [{ bus: 0, node: 5 }, { bus: 1, node: 64 }, undefined]) assert.deepEqual(allowed(processOf(state, other)), []);
  assert.equal(about({ nodes: [7, 7], phase: "ended" }), "The process of this cell has ended.");
  assert.deepEqual([[9, 4], [4, 9], [4, 5]].map(([a, b]) => isDown(state, 1, a, b)), [true, true, false]);
  assert.equal(isDown(state, 0, 4, 9), false);
});

test("the tree leads from each cell to its parent, and a wire that does not work is there once", () => {
  const at = (node, x, neighbors, row = 1) => ({ ...cell(row, [x, 0, 0], [0, 0, 1]), node, neighbors });
  const cells = [at(1, 0, [2, 0, 0, 3]), at(2, 0.03, [1, 0, 0, 0]), at(3, 0.06, [1, 0, 0, 0], 2), { ...at(1, 0.5, [2, 0, 0, 0]), bus: 1 }];
  const it = { ...scene(cells), buses: [{ name: "vcan0", chain: 0 }, { name: "vcan1", chain: 0 }] };
  // 1 is a root, both of its wires work; 2 hangs on 1; 3 has not reported, the other bus sends no sums.
  assert.deepEqual(wires(it, [[[0, 0b1001], [1, 0b0001], null], null]), [{ from: 1, to: 0, kind: TREE }]);
  // The wire between 1 and 2 is cut, as both say.
  assert.deepEqual(wires(it, [[[0, 0b1000], [null, 0], [1, 0b0001]], null]), [{ from: 0, to: 1, kind: CUT }, { from: 2, to: 0, kind: TREE }]);
  const all = [{ from: 1, to: 0, kind: TREE }, { from: 2, to: 0, kind: CUT }], places = frames(it, [0, 0, 0, 0, 0, 0]);
  const corners = ribbons(it, places, all);
  assert.equal(corners.length, 2 * 6 * FLOATS);
  const corner = (k) => [...corners.slice(k * FLOATS, (k + 1) * FLOATS)];
  assert.deepEqual([corner(0)[4], corner(6)[4]], [TREE, CUT]);
  const gap = (a, b) => Math.hypot(...[0, 1, 2].map((i) => corner(a)[i] - corner(b)[i]));
  assert.ok(gap(0, 1) > 3 * gap(3, 5), "narrow at the parent");
  close([gap(6, 7)], [gap(9, 11)], 1e-6);
  const far = point(places[0][2], [0.06, 0, 0]).map((v, i) => v - (corner(6)[i] + corner(7)[i]) / 2);
  assert.ok(Math.hypot(...far) < 0.3 * it.pitch, "a wire leads from one row's frame to another's");
});

test("a wire of the skin is there once and leaves the numbers free, and a cell's way begins at a place", () => {
  const at = (node, x, neighbors) => ({ ...cell(1, [x, 0, 0], [0, 0, 1]), node, neighbors });
  const it = scene([at(1, 0, [2, 0, 0, 9]), at(2, 0.03, [1, 3, 0, 0]), at(3, 0.06, [2, 0, 0, 0])]), places = frames(it, [0, 0, 0, 0, 0, 0]);
  const all = wired(it);
  assert.deepEqual(all, [{ from: 0, to: 1, kind: WIRE }, { from: 1, to: 2, kind: WIRE }], "9 is no cell");
  const ends = (corners) => [0, 3].map((k) => [0, 1, 2].map((i) => (corners[k * FLOATS + i] + corners[(k + 1 + 3 * (k > 0)) * FLOATS + i]) / 2));
  const middle = (x) => point(places[0][1], [x, 0, 0.12 * it.pitch]);
  const along = (p) => Math.hypot(...p.map((v, i) => v - middle(0)[i]));
  const [begin] = ends(ribbons(it, places, all));
  assert.ok(along(begin) > 0.01 && along(begin) < 0.015);
  const from = { chain: 0, row: 1, position: [0.01, 0, 0], normal: [0, 0, 1] };
  const [old] = ends(ribbons(it, places, [{ from, to: 1, kind: MOVED }]));
  close(old, middle(0.01), 1e-6);
});

test("buses have colours of their own, and cells at rest none", () => {
  assert.deepEqual(colourOf(SHOWS.bus, {}, { bus: 1 }), BUSES[1]);
  assert.deepEqual(busColour(BUSES.length), BUSES[0]);
  assert.equal(colourOf(SHOWS.force, { force: 0 }, { bus: 1 }), null);
  assert.deepEqual(colourOf(SHOWS.force, { force: 10000 }, { bus: 1 }), ramp(1));
  assert.deepEqual(colourOf(SHOWS.force, { force: 10000 }, { bus: 1 }, false), ramp(1, false));
  assert.equal(colourOf(SHOWS.force, { force: 10000, status: 4 }, { bus: 1 }), null, "what a silent cell said is old");
});

test("a halt is told with its reason and the next step", () => {
  const bench = (halted, down = false) => ({ halted, buses: [{ down }] });
  assert.equal(haltedWords({ halted: false, bench: bench(null) }, true), "");
  const said = (bench, mayPress = true) => haltedWords({ halted: true, bench }, mayPress);
  assert.equal(said(bench("too many bad cycles")), "The robot is halted: too many bad cycles. Press Resume to continue.");
  assert.equal(said(bench("no torque", true)), "The robot is halted: no torque. Bring the bus up, then press Resume.");
  assert.equal(said(null), "The robot is halted by a halt frame on the bus. Press Resume to continue.");
  assert.equal(said(null, false), "The robot is halted by a halt frame on the bus.");
  // A run with its bus down knows of the halt before any frame tells it.
  assert.match(haltedWords({ halted: false, bench: bench("no bus", true) }, true), /^The robot is halted: no bus/);
});
