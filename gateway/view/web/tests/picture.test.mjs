// What is drawn beside the cells, without a browser: node --test gateway/view/web/tests/
import assert from "node:assert/strict";
import { test } from "node:test";

import { arrows, axesOf, roundUp } from "../arrows.js";
import { shared } from "../gl.js";
import { axes as axesSeen, ground, spacing } from "../ground.js";
import { cross, dot } from "../math.js";
import { Picture } from "../picture.js";
import { frames } from "../robot.js";
import { demo } from "./motions.mjs";

// The volume that triangles enclose if their corners turn left, seen from outside.
function volume(corners) {
  let sum = 0;
  for (let k = 0; k < corners.length; k += 18) {
    const [a, b, c] = [0, 6, 12].map((i) => [...corners.slice(k + i, k + i + 3)]);
    sum += dot(a, cross(b, c)) / 6;
  }
  return sum;
}

test("arrows that a snapshot repeats do not change the picture", () => {
  const filled = [], picture = Object.assign(Object.create(Picture.prototype), { arrows: { count: 0 }, fill: (_, corners) => filled.push(corners[0]) });
  for (const x of [1, 1, 2, 2, 1]) picture.point(new Float32Array([x, 0, 0]));
  assert.deepEqual(filled, [1, 2, 1]);
});

test("arrows show contact forces and torques about the joints' axes, and gaps in them late replies", () => {
  const { scene: of, at } = demo, all = frames(of, at[0]);
  const it = { ...of, cells: [1, 2, 3].map((node) => ({ bus: 0, node, row: 2, joint: 2, position: [0, 0, 0.07], normal: [0, 0, 1], neighbors: [], root: false })) };
  const joints = of.joints.map((_, j) => ({ position: at[0][j], distributed: j === 1 ? 5 : 0, central: 0 }));
  const words = (...pressed) => Uint32Array.from(pressed.flatMap(([status, newtons]) => [status | newtons * 1000 << 16, 0]));
  const draw = (cells, options) => arrows(it, axesOf(it), all, { cells, joints }, { dark: true, most: 10, late: new Set(), torque: null, force: false, alarm: [1, 0, 0], ...options });
  const one = draw(words([2, 0], [2, 5], [4, 5]), { force: true });
  assert.ok(one.length > 0, "of the second: the first is at rest, and the third is silent");
  assert.equal(draw(words([2, 5], [2, 5], [4, 5]), { force: true }).length, 2 * one.length);
  assert.equal(draw(words([2, 0], [2, 0], [2, 0]), { force: true }).length, 0);
  const whole = draw(words([2, 0], [2, 0], [2, 0]), { torque: [0, 0, 1] }), broken = draw(words([2, 0], [2, 0], [2, 0]), { torque: [0, 0, 1], late: new Set([1]) });
  assert.ok(volume(broken) > 0 && volume(broken) < 0.8 * volume(whole), "one joint, with gaps");
  assert.ok(broken[3] > 0 && broken[5] === 0 && whole[3] === 0 && whole[5] > 0, "in the colour of what is bad");
  assert.deepEqual([0.3, 1, 1.2, 4.2, 73].map(roundUp).map((v) => Number(v.toPrecision(2))), [0.5, 1, 2, 5, 100]);
});

test("arrows are closed, and their triangles turn left, seen from outside: their backs need not be drawn", () => {
  const { scene: of, at } = demo, all = frames(of, at[0]), it = { ...of, cells: [{ bus: 0, node: 1, row: 2, joint: 2, position: [0, 0, 0.07], normal: [0, 0, 1], neighbors: [], root: false }] };
  const draw = (torque, force, late) => {
    const joints = of.joints.map((_, j) => ({ position: at[0][j], distributed: j === 1 ? torque : 0, central: 0 }));
    return arrows(it, axesOf(it), all, { cells: Uint32Array.of(2 | force << 16, 0), joints }, { dark: true, most: 10, late: new Set(late ? [1] : []), torque: [0, 0, 1], force: true, alarm: [1, 0, 0] });
  };
  for (const [torque, force, late] of [[0, 5000], [5, 0], [-5, 0], [0.4, 0], [5, 0, true], [-5.3, 0, true], [0.7, 0, true]]) {
    const corners = draw(torque, force, late), edges = new Map();
    for (let k = 0; k < corners.length; k += 18) {
      const three = [0, 6, 12].map((i) => [...corners.slice(k + i, k + i + 3)]), keys = three.map(String);
      if (new Set(keys).size < 3) continue;
      // Each edge of a closed surface belongs to two triangles, which follow it in opposite directions.
      keys.forEach((key, i) => {
        const [there, back] = [`${key} ${keys[(i + 1) % 3]}`, `${keys[(i + 1) % 3]} ${key}`];
        if (edges.get(back)) edges.set(back, edges.get(back) - 1);
        else edges.set(there, (edges.get(there) ?? 0) + 1);
      });
    }
    const open = [...edges.values()].reduce((sum, n) => sum + n, 0);
    assert.ok(volume(corners) > 1e-8 && open === 0, `torque ${torque}, force ${force}, late ${late}: ${volume(corners)} m³, ${open} edges`);
  }
});

test("equal corners of triangles are one", () => {
  const { corners, indices } = shared([0, 1, 2, 3, 0, 1, 4, 5, 2, 3, 0, 1], 2);
  assert.deepEqual([[...corners], [...indices]], [[0, 1, 2, 3, 4, 5], [0, 1, 0, 2, 1, 0]]);
});

test("the ground fades into the background, with the axes of the base", () => {
  const back = [0, 0, 0], all = ground(1, -0.2, back, [1, 1, 1]);
  assert.equal(spacing(1), 0.2);
  assert.ok(all.length % 12 === 0 && all.every(Number.isFinite));
  const far = [];
  for (let i = 0; i < all.length; i += 6) { assert.ok(Math.abs(all[i + 2] + 0.2) < 1e-6); if (Math.hypot(all[i], all[i + 1]) >= 1.4) far.push(...all.slice(i + 3, i + 6)); }
  assert.ok(far.length && far.every((v) => v === 0));
  assert.deepEqual(axesSeen([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).map(({ name }) => name)[0], "y", "the farthest first");
});
