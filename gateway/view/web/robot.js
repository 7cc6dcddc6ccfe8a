// The poses of a robot's links, and their shapes.

import { add, cross, direction, dot, length, point, row, times, unit } from "./math.js";

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

const SIDES = 16;

// Triangles of a cylinder with closed ends: positions and normals.
export function triangles({ from, to, radius }) {
  const axis = add(to, from, -1), z = unit(axis);
  const x = unit(cross(z, Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0])), y = cross(z, x);
  const out = [];
  const put = (p, n) => out.push(...p, ...n);
  if (length(axis) < 1e-6) return out;
  for (let k = 0; k < SIDES; k++) {
    const [a, b] = [k, (k + 1) % SIDES].map((i) => 2 * Math.PI * i / SIDES).map((t) => add(x.map((v) => v * Math.cos(t)), y, Math.sin(t)));
    const at = (end, n) => add(end, n, radius);
    for (const [p, n] of [[at(from, a), a], [at(from, b), b], [at(to, b), b], [at(from, a), a], [at(to, b), b], [at(to, a), a]]) put(p, n);
    const down = z.map((v) => -v);
    for (const p of [from, at(from, b), at(from, a)]) put(p, down);
    for (const p of [to, at(to, a), at(to, b)]) put(p, z);
  }
  return out;
}

// Directions in which a part's outline is sought: about even over the sphere.
const WAYS = Array.from({ length: 60 }, (_, i) => {
  const z = 1 - (2 * i + 1) / 60, r = Math.sqrt(1 - z * z), turn = i * 2.399963;
  return [r * Math.cos(turn), r * Math.sin(turn), z];
});

// The outline of everything that is drawn, as { chain, row, points } in the frame of each row: of each part's corners,
// those that are outermost in some direction. `corners` are those of the robot's surface, six numbers each.
export function outline(scene, corners = null) {
  const parts = new Map();
  const take = (chain, row, p) => {
    const key = `${chain} ${row}`;
    if (!parts.has(key)) parts.set(key, { chain, row, most: WAYS.map(() => -Infinity), points: [] });
    const { most, points } = parts.get(key);
    WAYS.forEach((way, k) => { const far = dot(way, p); if (far > most[k]) { most[k] = far; points[k] = p; } });
  };
  for (const { bus, row, position } of scene.cells) take(scene.buses[bus].chain, row, position);
  if (corners) {
    for (const { chain, row, first, count } of scene.shells) {
      for (let i = first; i < first + count; i++) take(chain, row, [corners[6 * i], corners[6 * i + 1], corners[6 * i + 2]]);
    }
  } else {
    for (const it of cylinders(scene)) {
      const all = triangles(it);
      for (let i = 0; i < all.length; i += 6) take(it.chain, it.row, all.slice(i, i + 3));
    }
  }
  return [...parts.values()].map(({ chain, row, points }) => ({ chain, row, points: [...new Set(points)] }));
}

// The points of an outline in the current pose, three numbers each.
export function placed(parts, all) {
  const out = new Float64Array(3 * parts.reduce((sum, { points }) => sum + points.length, 0));
  let k = 0;
  for (const { chain, row, points } of parts) {
    for (const p of points) { out.set(point(all[chain][row], p), k); k += 3; }
  }
  return out;
}

// Returns true if a ray from a point in a direction, of this length, passes through a link. Links are cylinders here.
function passes(from, way, links) {
  return links.some(({ a, axis, long, radius }) => {
    const off = add(from, a, -1), u = add(way, axis, -dot(way, axis)), v = add(off, axis, -dot(off, axis));
    const aa = dot(u, u), b = dot(u, v), c = dot(v, v) - radius * radius, root = b * b - aa * c;
    if (aa < 1e-12 || root < 0) return false;
    return [-1, 1].some((sign) => {
      const t = (-b + sign * Math.sqrt(root)) / aa, along = dot(add(off, way, t), axis);
      return t > 1e-3 && along > 0 && along < long;
    });
  });
}

// The direction from which the front of a cell is seen that is nearest to the current one, as { yaw, pitch }; null if it
// is seen already. `links` are the cylinders of the robot.
export function facing(scene, all, links, i, { yaw, pitch }) {
  const { bus, row, position, normal } = scene.cells[i], { chain } = scene.buses[bus], m = all[chain][row];
  const [place, front] = [point(m, position), unit(direction(m, normal))], from = add(place, front, 0.004);
  const solid = links.map((it) => {
    const [a, b] = [it.from, it.to].map((p) => point(all[it.chain][it.row], p)), axis = add(b, a, -1);
    return { a, axis: unit(axis), long: length(axis), radius: it.radius * 0.98 };
  });
  const way = (yaw, pitch) => [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];
  const shows = (to, least) => dot(front, to) > least && !passes(from, to, solid);
  const now = way(yaw, pitch);
  if (shows(now, 0.35)) return null;
  let best = null, most = -Infinity;
  for (const p of [0.3, 0.6, 0.9, 0.05, -0.3, 1.2, -0.8]) {
    for (let k = 0; k < 36; k++) {
      const y = yaw + k * Math.PI / 18, to = way(y, p), worth = dot(to, now) + 0.8 * dot(to, front) - 0.3 * Math.max(0, 0.1 - p);
      if (worth > most && shows(to, 0.55)) [best, most] = [{ yaw: y, pitch: p }, worth];
    }
  }
  return best ?? { yaw: Math.atan2(front[1], front[0]), pitch: Math.asin(front[2]) };
}
