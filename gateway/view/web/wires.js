// The tree of sums, as ribbons over the skin: from each cell toward the one that it passes its sum to; and wires that do not work.

import { add, cross, direction, length, point, unit } from "./math.js";
import { indices } from "./robot.js";

// The wires to be drawn as { from, to, cut }, with indices of cells. `trees` has of each bus the places of its cells, or null.
export function wires(scene, trees) {
  const at = indices(scene), next = scene.buses.map(() => 0), all = [], cuts = new Set();
  const places = scene.cells.map((cell) => trees[cell.bus]?.[next[cell.bus]++] ?? null);
  scene.cells.forEach((cell, i) => {
    if (!places[i]) return;
    const [parent, works] = places[i];
    if (parent) {
      const to = at.get(cell.bus * 256 + parent);
      if (to !== undefined) all.push({ from: i, to, cut: false });
    }
    cell.neighbors.forEach((node, port) => {
      const to = at.get(cell.bus * 256 + node), key = to < i ? `${to} ${i}` : `${i} ${to}`;
      if (to === undefined || works >> port & 1 || cuts.has(key)) return;
      cuts.add(key);
      all.push({ from: i, to, cut: true });
    });
  });
  return all;
}

export const FLOATS = 5;

// Two triangles for each wire where the robot stands now: place, part of the way from 0 to 1, 1 if it is cut. A ribbon is wide at the
// cell and narrow at its parent; one that is cut is as wide all the way.
export function ribbons(scene, frames, all) {
  const out = new Float32Array(all.length * 6 * FLOATS), width = scene.pitch * 0.1, lift = scene.pitch * 0.12;
  const end = (i) => {
    const { bus, row, position, normal } = scene.cells[i], m = frames[scene.buses[bus].chain][row], n = direction(m, normal);
    return [add(point(m, position), n, lift), n];
  };
  let k = 0;
  for (const { from, to, cut } of all) {
    const [[a, n], [b, o]] = [end(from), end(to)], way = add(b, a, -1), up = add(n, o);
    const flat = cross(way, length(up) > 1e-6 ? up : n), side = length(flat) > 1e-9 ? unit(flat) : [0, 0, 0];
    const corner = (p, s, t) => { out.set([...add(p, side, s), t, cut ? 1 : 0], k); k += FLOATS; };
    const [wide, narrow] = cut ? [width * 0.7, width * 0.7] : [width, width * 0.3];
    for (const [s, t] of [[wide, 0], [-wide, 0], [narrow, 1], [narrow, 1], [-wide, 0], [-narrow, 1]]) corner(t ? b : a, s, t);
  }
  return out;
}
