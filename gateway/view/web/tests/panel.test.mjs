// The panel without a browser: axes, curves, labels of events, and the words about the state.
import assert from "node:assert/strict";
import { test } from "node:test";

import { Recent, Recorded, decodeCurves, points } from "../curves.js";
import { EventLog, labelOf } from "../events.js";
import { haltedWords } from "../halted.js";
import { Health } from "../health.js";
import { valueAt } from "../lane.js";
import { bounds, followed, groups, niceStep, number, rowsOf, secondDigits, tickText, ticks, within, zoomed } from "../scale.js";
import { countOf, stateOf } from "../state.js";
import { clock, moment } from "../time.js";

test("ticks are round, lie within the axis, and are no more than asked for", () => {
  for (const [low, high] of [[0, 1], [-3.3, 4.7], [0, 0.0123], [1000, 1010], [3599.2, 3601.7]]) {
    for (const count of [2, 3, 5, 10]) {
      const { step, all } = ticks(low, high, count);
      assert.ok(all.length <= count + 1 && all.length >= 1 || high - low < step, `${low} ${high} ${count}: ${all}`);
      assert.ok(all.every((v) => v >= low - 1e-9 && v <= high + step * 1e-6), `${all}`);
      assert.ok([1, 2, 5].includes(Math.round(step / 10 ** Math.floor(Math.log10(step) + 1e-9))), `${step}`);
    }
  }
  assert.deepEqual([niceStep(10, 5), niceStep(1, 3), niceStep(0, 3) > 0], [2, 0.5, true]);
  assert.deepEqual([tickText(-0.5, 0.5), tickText(2, 1), tickText(-1e-12, 0.1), tickText(0.02, 0.01)], ["−0.5", "2", "0", "0.02"]);
  assert.deepEqual([1, 0.5, 0.01, 60].map(secondDigits), [0, 1, 2, 0]);
  assert.deepEqual([moment(75.26, 1), clock(75.26), number(-0.00001)], ["1:15.3", "1:15.260", "0.0000"]);
});

test("an axis contains zero and all values, and does not tremble with them", () => {
  for (const [low, high] of [[0, 3.7], [-4.1, 1.1], [-2, -1], [5, 6], [0, 0]]) {
    const [bottom, top] = bounds(low, high, 0.01);
    assert.ok(bottom <= Math.min(0, low) && top >= Math.max(0, high) && top > bottom, `${bottom} ${top}`);
  }
  assert.deepEqual(bounds(0, 3.71, 0.01), bounds(0, 3.73, 0.01));
});

test("a zoom keeps the moment under the pointer, and a recording's limits", () => {
  const near = zoomed({ from: 10, to: 20 }, 2, 12);
  assert.deepEqual(near, { from: 11, to: 16 });
  assert.deepEqual(zoomed({ from: 10, to: 20 }, 0.01, 15, [0, 60]), { from: 0, to: 60 });
  const least = zoomed({ from: 10, to: 20 }, 1e9, 15);
  assert.ok(least.to - least.from > 0.01);
  assert.deepEqual(within({ from: -3, to: 7 }, [0, 60]), { from: 0, to: 10 });
  assert.deepEqual(within({ from: 55, to: 65 }, [0, 60]), { from: 50, to: 60 });
  assert.deepEqual(followed(100, 10), { from: 90, to: 100 });
  assert.deepEqual([followed(50, 10, [0, 60]), followed(1, 10, [0, 60]), followed(60, 10, [0, 60])], [{ from: 43, to: 53 }, { from: 0, to: 10 }, { from: 50, to: 60 }]);
});

test("values of a page are kept to its capacity, and decimated with their extremes", () => {
  const recent = new Recent(2, 100);
  for (let k = 0; k < 250; k++) recent.add(k / 10, [k, k === 200 ? -7 : 1]);
  assert.deepEqual([recent.size, recent.first(), recent.last()], [100, 15, 24.9]);
  const all = recent.curve(0, 15, 24.9, Infinity);
  assert.deepEqual([all.length, all.slice(0, 3)], [300, [15, 150, 150]]);
  const few = recent.curve(1, 15, 25, 10), low = few.filter((_, k) => k % 3 === 1);
  assert.ok(few.length <= 33 && Math.min(...low) === -7, "the least value is there");
  // What is shown moves, and the parts stay.
  const inside = (from) => recent.curve(0, from, from + 10, 10).join(" ").match(/ 18(\.\d+)? .* 21 \d+ \d+/)[0];
  assert.equal(inside(16.03), inside(16));
  recent.add(24.9, [9, 9]);
  assert.equal(recent.size, 100, "the same moment is one");
  recent.add(3, [1, 1]);
  assert.deepEqual([recent.size, recent.first()], [1, 3], "a seek begins anew");
  const forces = new Recent(1, 10, Uint16Array, 1e-3);
  [[0, 5000], [1, 65535], [2, 0]].forEach(([t, v]) => forces.add(t, [v]));
  const gap = forces.curve(0, 0, 2, Infinity, 65535);
  assert.deepEqual([gap[1], gap[7]], [5, 0]);
  assert.ok(Number.isNaN(gap[4]), "a dead cell has no force");
});

const curves = (from, step, values) => {
  const data = new DataView(new ArrayBuffer(24 + 8 * values.length));
  [1, values.length].forEach((v, k) => data.setUint32(4 * k, v, true));
  [from, step].forEach((v, k) => data.setFloat64(8 + 8 * k, v, true));
  values.flat().forEach((v, k) => data.setFloat32(24 + 4 * k, v, true));
  return data.buffer;
};

test("curves of a recording are read as the server writes them", () => {
  const it = decodeCurves(curves(2, 0.5, [[1, 2], [NaN, NaN], [-3, 4]]));
  assert.deepEqual(points(it, 0), [2.25, 1, 2, 3.25, -3, 4]);
  assert.throws(() => decodeCurves(curves(2, 0.5, [[1, 2]]).slice(0, 30)));
  const all = points(it, 0);
  assert.deepEqual([valueAt(all, 2.3), valueAt(all, 3.3), valueAt(all, 9), valueAt([], 1)], [2, 4, null, null]);
  // The central torque is unknown in the second interval, in which the cells sent one.
  const two = new DataView(new ArrayBuffer(24 + 8 * 6));
  [2, 3].forEach((v, k) => two.setUint32(4 * k, v, true));
  [2, 0.5].forEach((v, k) => two.setFloat64(8 + 8 * k, v, true));
  [7, 7, 8, 8, NaN, NaN, 1, 2, NaN, NaN, NaN, NaN].forEach((v, k) => two.setFloat32(24 + 4 * k, v, true));
  const central = points(decodeCurves(two.buffer), 1, 0);
  assert.deepEqual(central, [2.25, 1, 2, 2.75, NaN, NaN]);
  assert.deepEqual([valueAt(central, 2.25, 0), valueAt(central, 2.75, 0.2)], [2, null]);
});

test("what is shown is asked for once, with some beside it, and again after a zoom", async () => {
  const asked = [];
  let arrived = 0;
  const recorded = new Recorded(async (path) => { asked.push(path); return { ok: true }; }, () => arrived++);
  const part = (from, to, fresh = 1) => recorded.part("/curves?of=loads", from, to, 100, fresh, async () => "them");
  assert.equal(part(10, 20), null);
  part(10, 20);
  await new Promise(setImmediate);
  assert.deepEqual([asked, arrived, part(10, 20), part(6, 16)], [["/curves?of=loads&from=5&to=25&count=200"], 1, "them", "them"]);
  assert.equal(asked.length, 1, "a pan within it needs no other");
  part(14, 15);
  await new Promise(setImmediate);
  part(14, 15, 2);
  await new Promise(setImmediate);
  assert.equal(asked.length, 3, "a zoom, and more of the recording read");
});

test("labels of events do not overlap, and the important have the first choice", () => {
  const labels = [[0, 50], [20, 50], [40, 50], [60, 50], [180, 50], [100, 30]].map(([x, w]) => ({ places: [x, x - w], w })), all = rowsOf(labels, 200, 2, 4);
  assert.deepEqual(all.map(({ row }) => row), [0, 1, -1, 0, 0, 1]);
  assert.equal(all[4].x, 130, "on the other side of its moment");
  labels.forEach((a, i) => labels.forEach((b, k) => {
    if (i < k && all[i].row >= 0 && all[i].row === all[k].row) assert.ok(all[i].x + a.w <= all[k].x || all[k].x + b.w <= all[i].x, `${i} ${k}`);
  }));
  const events = [1, 1.1, 5, 5.1].map((at_s, k) => ({ at_s, kind: k === 3 ? "halt" : "touch" }));
  assert.deepEqual(groups(events, 100, 40).map(({ kind, at, events }) => [kind, at, events.length]), [["touch", 1, 2], ["touch", 5, 1], ["halt", 5.1, 1]]);
});

const scene = (buses) => ({ buses: buses.map((name) => ({ name, chain: 0 })), cells: [{ bus: 0, node: 3 }, { bus: 0, node: 4 }], chains: [{ rows: [] }] });
const said = (more = {}) => ({ halted: false, buses: [{ name: "vcan0", up: true }], bench: null, playback: null, ...more });

test("a live page keeps what happens", () => {
  const log = new EventLog(), it = scene(["vcan0"]);
  const see = (time, ...words) => log.see(it, { time, cells: Uint32Array.from(words.flatMap((word) => [word, 0])) });
  see(1, 2 | 5000 << 16, 1);
  log.hear(said(), null, 0);
  assert.deepEqual(log.events, [], "what was before the page is no event");
  see(2, 2 | 5000 << 16, 2 | 900 << 16);
  see(3, 4, 1);
  log.hear(said({ halted: true, buses: [{ name: "vcan0", up: false }], bench: { answers: [{ number: 1, done: true, text: "kill cell 3 on vcan0" }, { number: 2, done: false, text: "no" }] } }), "no torque", 2);
  log.hear(said({ halted: true, buses: [{ name: "vcan0", up: false }] }), "no torque", 2);
  assert.deepEqual(log.events.map(({ at_s, kind, node, text }) => [at_s, kind, node, text]), [
    [2, "touch", 4, null], [3, "silence", 3, null], [3, "halt", null, "no torque"], [3, "bus", null, "lost"], [3, "command", null, "kill cell 3 on vcan0"], [3, "loss", null, null]]);
  const label = (kind, events) => labelOf(it, { kind, events });
  const [touch, , halt, bus, command] = log.events;
  assert.deepEqual([label("touch", [touch])[0], label("touch", [touch, touch])[0], label("halt", [halt])[1], label("bus", [bus])[0], label("command", [command])[0]],
    ["Touch 4", "Touch × 2", "Halt: no torque", "vcan0 lost", "Kill cell 3"]);
  assert.equal(labelOf(scene(["vcan0", "vcan1"]), { kind: "touch", events: [touch] })[0], "Touch vcan0:4");
  see(0.5, 2, 2);
  assert.deepEqual(log.events, [], "another run");
});

test("live, playing, paused, waiting and lost have different words", () => {
  const of = (more) => stateOf({ connected: true, said: said(more) });
  const playback = (playing, at_s = 1, speed = 1) => ({ playing, at_s, of_s: 9, speed, failed: null });
  assert.deepEqual([stateOf({}).word, stateOf({ connected: false, refusal: "403" })], ["connecting", { word: "lost", text: "lost: 403" }]);
  assert.match(stateOf({ connected: false }).text, /^lost: the bench has ended/);
  assert.deepEqual([of({}).text, of({ playback: playback(true) }).text, of({ playback: playback(true, 1, 0.5) }).text, of({ playback: playback(false) }).text, of({ playback: playback(false, 9) }).text],
    ["live", "playing", "playing, 0.5 ×", "paused", "paused at the end"]);
  assert.equal(of({ buses: [{ name: "vcan0", up: false }] }).text, "waiting: vcan0 is down");
  assert.equal(of({ buses: [{ name: "a", up: true }, { name: "b", up: false }] }).text, "live, without b");
});

test("cells that were never heard are not counted as known", () => {
  assert.deepEqual([countOf(0, 253, 253), countOf(2, 3, 253), countOf(2, 0, 253)], ["–", "2 of 250 heard", "2"]);
});

test("a halt of a recording has its reason and its time, and one of a run what to do", () => {
  const halt = { since_s: 12.34, reason: "too many bad cycles in a row: the torque is not valid" };
  assert.equal(haltedWords(said({ halted: true, playback: { halt } }), false),
    "The robot is halted since 0:12.3: too many bad cycles in a row: the torque is not valid. Look at the second before it: silent cells, buses, late replies.");
  assert.equal(haltedWords(said({ halted: true, playback: { halt: null } }), false), "The robot is halted by a halt frame on the bus.");
  assert.equal(haltedWords(said({ playback: { halt: null } }), false), "");
  const run = (halted) => haltedWords(said({ halted: true, bench: { halted, buses: [] } }), true);
  assert.match(run(halt.reason), /valid\. Cells did not answer in time: look at silent cells and buses, then press Resume\.$/);
  assert.match(run("too many bad cycles in a row: no external controller is connected"), /Check the external controller, then press Resume\.$/);
});

test("a total is an alarm while it grows and a little after, and says when it has grown", () => {
  const health = new Health(), buses = (late, lost) => [{ late, missing: 0, lost, rejected: 0, dropped: 0, saturated: 0, epochs_due: 10, epochs_complete: 10 }];
  const at = (time, ...of) => { health.begin(time); return health.follow({ buses: [{ chain: 0 }], chains: [{ rows: [] }] }, buses(...of)); };
  assert.deepEqual([at(1, 3, 0), at(2, 4, 2)], [0, 3], "late and lost");
  assert.deepEqual(health.lately(["0 late", "0 missing"]), { at: 2, style: "alarm" });
  at(15, 4, 2);
  assert.deepEqual(health.lately(["0 late", "0 lost"]), { at: 2, style: "over" });
  at(30, 4, 2);
  assert.deepEqual(health.lately(["0 late", "0 lost"]), { at: 2, style: "" });
  assert.deepEqual(health.lately(["0 missing"]), { at: null, style: "" });
  health.begin(50, 2);
  assert.equal(health.last("0 late"), null, "a jump forward is a seek");
});
