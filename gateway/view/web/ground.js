// The ground: a grid below the robot, which fades away, and the x and y axes of its base.

// The lines to each side of the middle, and the pieces of half a line.
const LINES = 7, PIECES = 2;
const X = [0.85, 0.27, 0.3], Y = [0.25, 0.62, 0.3];

// The distance between lines for a robot of this size, in m.
export const spacing = (size) => [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2].find((it) => it * 5 >= size * 0.9) ?? 5;

// The ends of the lines as a position and a colour, between those of the background and of lines.
export function ground(size, height, back, line) {
  const step = spacing(size), far = LINES * step, out = [];
  const colour = (p, of) => { const t = Math.min(1, Math.hypot(p[0], p[1]) / far) ** 1.4; return of.map((v, i) => v + (back[i] - v) * t); };
  for (let k = 1 - LINES; k < LINES; k++) {
    // A line ends where it has faded away, and has few pieces: a software renderer takes time for each.
    const half = Math.sqrt(LINES * LINES - k * k + 0.001) * step / PIECES;
    for (const turned of [false, true]) {
      const place = (at) => (turned ? [k * step, at * half, height] : [at * half, k * step, height]);
      const of = k ? (k % 5 ? line : line.map((v, j) => v + (v - back[j]) * 0.5)) : turned ? Y : X;
      for (let i = -PIECES; i < PIECES; i++) {
        for (const p of [place(i), place(i + 1)]) out.push(...p, ...colour(p, of));
      }
    }
  }
  return new Float32Array(out);
}

const coarse = (v) => Math.round(v * 25) / 25;

// The axes of the base on the screen, for a small drawing: each as its end from the middle, nearest last. Steps are so
// coarse that the drawing seldom changes.
export function axes([right, up, to]) {
  return ["x", "y", "z"].map((name, k) => ({ name, x: coarse(right[k]), y: coarse(-up[k]), deep: to[k] })).sort((a, b) => a.deep - b.deep);
}
