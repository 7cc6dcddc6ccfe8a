// Colours for values: viridis, whose order all readers can see, with any kind of colour vision (Smith, van der Walt 2015).

import { DEAD } from "./snapshot.js";

const STOPS = [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121], [110, 206, 88], [181, 222, 43], [253, 231, 37]];
// The parts of the scale from the lowest to the highest value: light ends contrast with a dark page, dark ones with a
// light page.
const [ON_DARK, ON_LIGHT] = [[0.4, 1], [0.9, 0]];

export function ramp(share, dark = true) {
  const [low, high] = dark ? ON_DARK : ON_LIGHT, part = low + (high - low) * Math.min(1, Math.max(0, share));
  const at = part * (STOPS.length - 1), i = Math.min(STOPS.length - 2, Math.floor(at));
  return STOPS[i].map((v, k) => Math.round(v + (STOPS[i + 1][k] - v) * (at - i)));
}

const scheme = "(prefers-color-scheme: dark)";
export const isDark = () => matchMedia(scheme).matches;
export const onScheme = (then) => { matchMedia(scheme).onchange = then; };

// Seven colours that colour-blind people can tell apart (Okabe, Ito 2008); with more than seven buses, colours repeat.
export const BUSES = [[86, 180, 233], [230, 159, 0], [0, 158, 115], [240, 228, 66], [0, 114, 178], [213, 94, 0], [204, 121, 167]];
export const busColour = (bus) => BUSES[bus % BUSES.length];

// The values that cells can show: how each is read from a snapshot's cell, its range and its unit.
export const SHOWS = {
  force: { of: (cell) => cell.force / 1000, low: 0, high: 10, unit: "N", rest: (v) => v <= 0 },
  proximity: { of: (cell) => cell.proximity / 32768, low: 0, high: 1, unit: "", rest: (v) => v <= 0 },
  temperature: { of: (cell) => cell.temperature / 100, low: 0, high: 60, unit: "°C", rest: (v) => v === 0 },
  bus: { isBus: true },
};

// The colour of a cell, which is `at` in the scene; null at rest, and if the cell is silent.
export function colourOf(shows, cell, at, dark = true) {
  if (shows.isBus) return busColour(at.bus);
  const value = shows.of(cell, at);
  return cell.status === DEAD || shows.rest(value) ? null : ramp((value - shows.low) / (shows.high - shows.low), dark);
}

// The meanings of a cell's shape, the most important first; `shape` is the number in the shader.
export const SHAPES = [
  { shape: 1, is: (cell) => cell.status === DEAD, name: "silent", mark: "cross" },
  { shape: 2, is: (cell) => cell.status === 0, name: "no frame received", mark: "ring" },
  { shape: 3, is: (cell) => (cell.flags & 1) !== 0, name: "no parameters", mark: "hole" },
  { shape: 4, is: (cell) => (cell.flags & 2) !== 0, name: "different parameters", mark: "half" },
  { shape: 5, is: (cell) => cell.status === 3, name: "stale: no reply", mark: "bar" },
  { shape: 7, is: (cell) => (cell.flags & 32) !== 0, name: "stuck: constant value", mark: "disc" },
  { shape: 6, is: (cell) => (cell.flags & 8) !== 0, name: "halted", mark: "square" },
  { shape: 0, is: () => true, name: "normal", mark: "" },
];

export const shapeOf = (cell) => SHAPES.find((it) => it.is(cell));

export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
