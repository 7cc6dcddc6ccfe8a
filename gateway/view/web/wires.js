// Ribbons over the skin: the tree of sums, from each cell toward the one that it sends its sum to; wires; and the ways
// of moved cells.

import { add, cross, direction, length, point, unit } from "./math.js";
import { indices } from "./robot.js";

// The kinds of ribbons, as in the shader: a branch of the tree, a wire that is cut, a wire of the skin, and a line from
// a cell's described place to its real one.
export const [TREE, CUT, WIRE, MOVED] = [0, 1, 2, 3];

// The width at both ends, in pitches, and the part of the way that the ribbon covers: a wire leaves the centres of
// cells free.
const FORMS = { [TREE]: [0.1, 0.03, 0, 1], [CUT]: [0.07, 0.07, 0, 1], [WIRE]: [0.05, 0.05, 0.36, 0.64], [MOVED]: [0.16, 0.02, 0, 1] };

// The wires to draw as { from, to, kind }, with indices of cells. `trees` has for each bus the places of its cells, or
// null.
export function wires(scene, trees) {
  const at = indices(scene), next = scene.buses.map(() => 0), all = [], cuts = new Set();
  const places = scene.cells.map((cell) => trees[cell.bus]?.[next[cell.bus]++] ?? null);
  scene.cells.forEach((cell, i) => {
    if (!places[i]) return;
    const [parent, works] = places[i];
    if (parent) {
      const to = at.get(cell.bus * 256 + parent);
      if (to !== undefined) all.push({ from: i, to, kind: TREE });
    }
    cell.neighbors.forEach((node, port) => {
      const to = at.get(cell.bus * 256 + node), key = to < i ? `${to} ${i}` : `${i} ${to}`;
      if (to === undefined || works >> port & 1 || cuts.has(key)) return;
      cuts.add(key);
      all.push({ from: i, to, kind: CUT });
    });
  });
  return all;
}

// Each wire of the skin, once.
export function wired(scene) {
  const at = indices(scene);
  return scene.cells.flatMap((cell, from) => cell.neighbors
    .map((node) => at.get(cell.bus * 256 + node))
    .filter((to) => to > from)
    .map((to) => ({ from, to, kind: WIRE })));
}

export const FLOATS = 5;

// Two triangles for each ribbon in the current pose, as position, share of the way from 0 to 1, and kind. An end is a
// cell's index, or a place as { chain, row, position, normal }. A branch is wide at the cell and narrow at its parent.
export function ribbons(scene, frames, all) {
  const out = new Float32Array(all.length * 6 * FLOATS), lift = scene.pitch * 0.12;
  const end = (it) => {
    const { bus, chain, row, position, normal } = scene.cells[it] ?? it;
    const m = frames[chain ?? scene.buses[bus].chain][row], n = direction(m, normal);
    return [add(point(m, position), n, lift), n];
  };
  let k = 0;
  for (const { from, to, kind } of all) {
    const [[a, n], [b, o]] = [end(from), end(to)], way = add(b, a, -1), up = add(n, o);
    const flat = cross(way, length(up) > 1e-6 ? up : n), side = length(flat) > 1e-9 ? unit(flat) : [0, 0, 0];
    const corner = (p, s, t) => { out.set([...add(p, side, s), t, kind], k); k += FLOATS; };
    const [wide, narrow, begin, stop] = FORMS[kind], [w, v] = [wide * scene.pitch, narrow * scene.pitch];
    const ends = [add(a, way, begin), add(a, way, stop)];
    for (const [s, t] of [[w, 0], [-w, 0], [v, 1], [v, 1], [-w, 0], [-v, 1]]) corner(ends[t], s, t);
  }
  return out;
}
