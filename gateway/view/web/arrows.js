// Arrows: the contact force on each touched cell, and the torque of the contacts about each joint's axis.

import { ramp } from "./colours.js";
import { add, cross, direction, dot, point, unit } from "./math.js";
import { cylinders } from "./robot.js";
import { DEAD, cellOf } from "./snapshot.js";

// The number of floats of a corner: a position and a colour.
export const FLOATS = 6;
// The most arrows, which are those of the largest forces; the length of one of 10 N in pitches; the sides of a shaft.
const MOST_ARROWS = 80, LONG = 6.5, SIDES = 4;
// The turn of the arrow for the largest torque, and the steps that it is drawn in.
const TURN = 1.5 * Math.PI, STEPS = 24;
// Torques below this share of the largest have no arrow.
const LEAST = 0.03;
const LIGHT = unit([0.4, -0.5, 0.77]);

const across = (z) => unit(cross(z, Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
const shaded = (colour, n) => colour.map((v) => v * (0.66 + 0.34 * Math.max(0, dot(n, LIGHT))));

// A band between two rings of points, with the directions in which the points are seen. These turn left around the way
// along the arrow, so that the corners of a triangle turn left, seen from outside. A ring that widens in its plane faces
// back.
function band(out, from, to, ways, colour) {
  ways.forEach((way, k) => {
    const next = (k + 1) % ways.length, c = shaded(colour, way), d = shaded(colour, ways[next]);
    for (const [p, q] of [[from[k], c], [from[next], d], [to[next], d], [from[k], c], [to[next], d], [to[k], c]]) out.push(...p, ...q);
  });
}

const ring = (middle, ways, radius) => ways.map((way) => add(middle, way, radius));

function around(axis) {
  const x = across(axis), y = cross(axis, x);
  return Array.from({ length: SIDES }, (_, k) => add(x.map((v) => v * Math.cos(2 * Math.PI * k / SIDES)), y, Math.sin(2 * Math.PI * k / SIDES)));
}

// A straight arrow.
function arrow(out, tail, tip, radius, colour) {
  const way = add(tip, tail, -1), axis = unit(way), ways = around(axis), head = Math.min(4.2 * radius, Math.hypot(...way) * 0.6);
  const neck = add(tip, axis, -head), back = ring(neck, ways, 2.3 * radius);
  band(out, ring(tail, ways, radius), ring(neck, ways, radius), ways, colour);
  band(out, ring(tail, ways, 0), ring(tail, ways, radius), ways, colour.map((v) => v * 0.8));
  band(out, ring(neck, ways, radius), back, ways, colour.map((v) => v * 0.7));
  band(out, back, ring(tip, ways, 0), ways, colour);
}

// An arrow around the z axis of a frame, to the left if the angle is positive; with gaps if `broken`.
function bow(out, m, radius, thick, angle, colour, broken) {
  const z = direction(m, [0, 0, 1]), middle = point(m, [0, 0, 0]), sign = Math.sign(angle), size = Math.abs(angle);
  const head = Math.min(5 * thick / radius, size * 0.6), from = Math.PI / 2 - sign * TURN / 2;
  const at = (turn) => {
    const a = from + sign * turn, way = direction(m, [Math.cos(a), Math.sin(a), 0]);
    return { middle: add(middle, way, radius), ways: [way, z.map((v) => -sign * v), way.map((v) => -v), z.map((v) => sign * v)] };
  };
  const parts = Math.max(3, Math.ceil(STEPS * size / TURN)), dark = colour.map((v) => v * 0.7);
  const cap = ({ middle, ways }, inner, outer) => band(out, ring(middle, ways, inner), ring(middle, ways, outer), ways, dark);
  let last = at(0), begin = ring(last.middle, last.ways, thick);
  for (let k = 1; k <= parts; k++) {
    const next = at((size - head) * k / parts), end = ring(next.middle, next.ways, thick), drawn = !broken || k % 2 === 1;
    if (drawn && (broken || k === 1)) cap(last, 0, thick);
    if (drawn) band(out, begin, end, next.ways, colour);
    if (drawn && broken && k < parts) cap(next, thick, 0);
    [last, begin] = [next, end];
  }
  const wide = 2.4 * thick * Math.min(1, 0.4 + size);
  cap(last, broken && parts % 2 === 0 ? 0 : thick, wide);
  band(out, ring(last.middle, last.ways, wide), ring(at(size).middle, last.ways, 0), last.ways, colour);
}

// A round number that is not smaller.
export function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value)), part = value / power;
  return power * [1, 2, 5, 10].find((it) => it >= part * 0.9999);
}

// The joints of a scene with the frames around whose z axes they turn, and the radius of their arrows.
export function axesOf(scene) {
  const thick = Math.max(0.03, ...scene.tubes.map((tube) => tube.radius), ...cylinders(scene).filter((it) => it.row > 0).map((it) => Math.min(0.08, it.radius)));
  const found = new Map();
  scene.chains.forEach((chain, c) => chain.rows.forEach(({ joint, slides }, row) => {
    if (joint !== null && !found.has(joint)) found.set(joint, { joint, chain: c, row, slides, radius: 1.5 * thick });
  }));
  return [...found.values()];
}

// The corners of all arrows in the current pose. `most` is the torque of the longest arrow, and `late` has the joints
// whose newest torques are incomplete.
export function arrows(scene, axes, frames, { cells, joints }, { dark, force, torque, alarm, most, late }) {
  const out = [], pressed = [];
  if (force) {
    for (let i = 0; i < scene.cells.length; i++) {
      const word = cells[2 * i];
      if (word >>> 16 && (word & 255) !== DEAD) pressed.push([word >>> 16, i]);
    }
  }
  pressed.sort((a, b) => b[0] - a[0]);
  for (const [, i] of pressed.slice(0, MOST_ARROWS)) {
    const { bus, row, position, normal } = scene.cells[i], m = frames[scene.buses[bus].chain][row];
    const share = Math.min(1, cellOf(cells, i).force / 10000), tip = add(point(m, position), direction(m, normal), 0.003);
    arrow(out, add(tip, direction(m, normal), scene.pitch * (1 + LONG * share)), tip, scene.pitch * 0.13, ramp(share, dark).map((v) => v / 255));
  }
  for (const { joint, chain, row, slides, radius } of torque ? axes : []) {
    const share = Math.max(-1, Math.min(1, joints[joint].distributed / most)), m = frames[chain][row], broken = late.has(joint);
    // An unknown torque has no arrow, either.
    if (!(Math.abs(share) >= LEAST)) continue;
    const colour = broken ? alarm : torque, thick = radius * 0.055;
    if (slides) arrow(out, point(m, [radius, 0, 0]), point(m, [radius, 0, 3 * radius * share]), thick, colour);
    else bow(out, m, radius, thick, share * TURN, colour, broken);
  }
  return new Float32Array(out);
}
