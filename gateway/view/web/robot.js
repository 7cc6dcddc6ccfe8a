// The poses of a robot's links, and their shapes.

import { add, cross, dot, length, point, row, times, unit } from "./math.js";

// The frame of each row of each chain, the base first.
export function frames(scene, positions) {
  return scene.chains.map((chain) => {
    const all = [chain.base];
    for (const { joint, slides, a, alpha, d, theta } of chain.rows) {
      const q = joint === null ? 0 : positions[joint] ?? 0;
      all.push(times(all[all.length - 1], row(a, alpha, slides ? d + q : d, slides ? theta : theta + q)));
    }
    return all;
  });
}

// Cylinders as { chain, row, from, to, radius } in the frame of a row; 0 is the base.
export function cylinders(scene) {
  const all = scene.tubes.map((tube) => ({ chain: tube.chain, row: tube.row, from: tube.ends[0], to: tube.ends[1], radius: tube.radius }));
  const thick = (chain, row) => Math.min(0.045, ...all.filter((it) => it.chain === chain && it.row === row).map((it) => it.radius * 0.6));
  scene.chains.forEach((chain, c) => {
    chain.rows.forEach((it, at) => {
      // From the previous frame: by d along its z, and then by a along x.
      const [s, co] = [Math.sin(it.alpha), Math.cos(it.alpha)];
      const bend = [-it.a, 0, 0], start = [-it.a, -it.d * s, -it.d * co];
      const radius = thick(c, at + 1) * Math.max(0.55, 1 - 0.05 * at);
      if (Math.abs(it.d) > 0.005 && !it.slides) all.push({ chain: c, row: at + 1, from: start, to: bend, radius });
      // A link may lie beside the line of its Denavit-Hartenberg row, such as a UR5's upper arm: it is drawn where its
      // cells are.
      const tube = scene.tubes.find((tube) => tube.chain === c && tube.row === at + 1);
      const path = tube ? [bend, near(tube.ends, bend), near(tube.ends, [0, 0, 0]), [0, 0, 0]] : [bend, [0, 0, 0]];
      path.slice(1).forEach((to, i) => {
        if (length(add(to, path[i], -1)) > 0.005) all.push({ chain: c, row: at + 1, from: path[i], to, radius });
      });
      // The joint itself, around its axis.
      if (it.joint !== null && at > 0) all.push({ chain: c, row: at, from: [0, 0, -radius * 1.25], to: [0, 0, radius * 1.25], radius: radius * 1.12 });
    });
    if (c === 0) all.push({ chain: 0, row: 0, from: [0, 0, -0.02], to: [0, 0, 0], radius: 0.08 });
  });
  return all;
}

// The point nearest to p on the line through these ends.
function near([from, to], p) {
  const along = unit(add(to, from, -1));
  return add(from, along, dot(along, add(p, from, -1)));
}

// The indices of the cells, by 256 times the bus plus the node id.
export const indices = (scene) => new Map(scene.cells.map((cell, i) => [cell.bus * 256 + cell.node, i]));

// For each cell, the index of a neighbor in the same frame, or -1.
export function neighbors(scene) {
  const at = indices(scene);
  return scene.cells.map((cell) => {
    const near = cell.neighbors.map((node) => at.get(cell.bus * 256 + node)).find((i) => scene.cells[i]?.row === cell.row);
    return near ?? -1;
  });
}

// The axes of a cell's hexagon. Its first corner is on x; neighbors lie beyond its sides.
export function axes(scene, nearest, i) {
  const { position, normal } = scene.cells[i], other = scene.cells[nearest[i]];
  const flat = (v) => add(v, normal, -dot(v, normal));
  const toward = other ? flat(add(other.position, position, -1)) : [0, 0, 0];
  const side = length(toward) > 1e-9 ? unit(toward) : unit(cross(normal, Math.abs(normal[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
  const x = add(side.map((v) => v * Math.cos(Math.PI / 6)), cross(normal, side), 0.5);
  return [x, cross(normal, x)];
}

const SIDES = 20;

// Triangles of a cylinder with closed ends: positions and normals.
export function triangles({ from, to, radius }) {
  const axis = add(to, from, -1), z = unit(axis);
  const x = unit(cross(z, Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0])), y = cross(z, x);
  const out = [];
  const put = (p, n) => out.push(...p, ...n);
  if (length(axis) < 1e-6) return out;
  for (let k = 0; k < SIDES; k++) {
    const [a, b] = [k, k + 1].map((i) => 2 * Math.PI * i / SIDES).map((t) => add(x.map((v) => v * Math.cos(t)), y, Math.sin(t)));
    const at = (end, n) => add(end, n, radius);
    for (const [p, n] of [[at(from, a), a], [at(from, b), b], [at(to, b), b], [at(from, a), a], [at(to, b), b], [at(to, a), a]]) put(p, n);
    const down = z.map((v) => -v);
    for (const p of [from, at(from, b), at(from, a)]) put(p, down);
    for (const p of [to, at(to, a), at(to, b)]) put(p, z);
  }
  return out;
}

// The corners of the box around everything that is drawn, in the current pose.
export function extent(scene, all) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  const take = (p) => p.forEach((v, i) => { low[i] = Math.min(low[i], v); high[i] = Math.max(high[i], v); });
  scene.chains.forEach((_, c) => all[c].forEach((m) => take(point(m, [0, 0, 0]))));
  for (const cell of scene.cells) take(point(all[scene.buses[cell.bus].chain][cell.row], cell.position));
  return { low, high };
}
