// One plot: its curves, their axis, the cursor, and the values there.

import { element } from "./dom.js";
import { bounds, number, secondDigits, tickText, ticks } from "./scale.js";
import { moment } from "./time.js";

// The places of the curves, in pixels from the left and right side; and the space for a line above and below.
export const [LEFT, RIGHT] = [46, 10];
const EDGE = 7;
// Points farther apart than this, in s, are not joined by a line.
const GAP_S = 1;
// A lane has no room for all values below this width in pixels.
const NARROW = 500;
// The smallest part of a unit that an axis shows.
const LEAST = { Nm: 0.01, N: 0.1, "%": 1, ms: 0.1, µs: 10 };
export const FONT = "system-ui, \"DejaVu Sans\", sans-serif";

// Makes a canvas as sharp as the screen, and clears it.
export function sized(canvas, width) {
  const ratio = Math.min(2, window.devicePixelRatio || 1), h = canvas.clientHeight;
  const [w, tall] = [width, h].map((v) => Math.round(v * ratio));
  if (canvas.width !== w || canvas.height !== tall) [canvas.width, canvas.height] = [w, tall];
  // In memory: the processor draws small lines sooner than WebGL in software.
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, h);
  return { pen, h };
}

// The value of a curve at a time: that of the last point before it, or of the next one; null where there is no point near.
export function valueAt(points, time, near = GAP_S) {
  let [low, high] = [0, points.length / 3];
  while (low < high) {
    const k = (low + high) >> 1;
    if (points[3 * k] <= time) low = k + 1;
    else high = k;
  }
  for (const k of [low - 1, low]) {
    const [at, a, b] = points.slice(3 * k, 3 * k + 3);
    if (k >= 0 && Math.abs(at - time) <= near && !Number.isNaN(a)) return Math.abs(a) > Math.abs(b) ? a : b;
  }
  return null;
}

export class Lane {
  constructor({ name, unit, curves, joint, bus }) {
    Object.assign(this, { name, unit, curves, joint, bus, values: "", time: null });
    this.row = element("div", undefined, "lane");
    this.value = element("span", "", "values");
    this.canvas = element("canvas");
    this.canvas.tabIndex = 0;
    for (const [key, value] of [["role", "slider"], ["aria-label", `${name}: time of the values`], ["aria-valuemin", "0"], ["aria-valuemax", "0"], ["aria-valuenow", "0"], ["aria-valuetext", "no values"]]) this.canvas.setAttribute(key, value);
    this.canvas.title = "Arrow keys move the cursor; drag moves, wheel zooms";
    const head = element("div", undefined, "head");
    head.append(element("span", name), this.value);
    this.row.append(head, this.canvas);
  }

  draw(view, curves) {
    const { theme, x } = view, { pen, h } = sized(this.canvas, view.width);
    let [low, high] = [0, 0];
    for (const of of curves) for (let k = 0; k < of.length; k += 3) if (of[k] >= view.from && of[k] <= view.to) [low, high] = [of[k + 1] < low ? of[k + 1] : low, of[k + 2] > high ? of[k + 2] : high];
    const [bottom, top] = bounds(low, high, LEAST[this.unit] ?? 0.01), y = (v) => EDGE + (top - v) / (top - bottom) * (h - 2 * EDGE);
    pen.font = `11px ${FONT}`;
    pen.textAlign = "right";
    const fine = ticks(bottom, top, 5), apart = fine.step / (top - bottom) * (h - 2 * EDGE);
    const { step, all } = apart < 13 ? ticks(bottom, top, 3) : fine;
    for (const v of all) {
      const at = Math.round(y(v)) + 0.5;
      pen.strokeStyle = theme.line;
      pen.beginPath(); pen.moveTo(LEFT, at); pen.lineTo(view.width - RIGHT, at); pen.stroke();
      pen.fillStyle = theme.faint;
      pen.fillText(tickText(v, step), LEFT - 6, Math.min(h - 1, Math.max(9, at + 4)));
    }
    for (const t of ticks(view.from, view.to, Math.max(2, Math.floor(view.inside / 90))).all) {
      pen.fillStyle = theme.line;
      pen.fillRect(Math.round(x(t)), EDGE, 1, h - 2 * EDGE);
    }
    for (const { at_s, kind } of view.events) {
      if (kind === "touch" || kind === "loss" || at_s < view.from || at_s > view.to) continue;
      pen.fillStyle = kind === "halt" || kind === "silence" ? theme.alarm : theme.faint;
      pen.fillRect(Math.round(x(at_s)), 0, 1, h);
    }
    pen.save();
    pen.beginPath(); pen.rect(LEFT, 0, view.inside, h); pen.clip();
    pen.lineJoin = "round";
    this.curves.forEach(([, colour, isConstant], k) => this.line(pen, curves[k], x, y, theme[colour], colour === "central", isConstant ? Infinity : GAP_S));
    pen.restore();
    const shown = view.cursor ?? view.at;
    if (view.at !== null) this.mark(pen, x(view.at), h, theme.ink, []);
    if (view.cursor !== null && view.cursor !== view.at) this.mark(pen, x(view.cursor), h, theme.chosen, [3, 3]);
    this.read(curves, shown ?? view.to, (view.to - view.from) / view.inside * 3, view.width < NARROW);
    if (shown !== null && shown !== undefined) {
      this.curves.forEach(([, colour], k) => {
        const value = this.at[k];
        if (value === null || shown < view.from || shown > view.to) return;
        pen.fillStyle = theme[colour];
        pen.strokeStyle = theme.panel;
        pen.lineWidth = 1.5;
        pen.beginPath(); pen.arc(x(shown), y(value), 4, 0, 7); pen.fill(); pen.stroke();
      });
    }
    if (document.activeElement === this.canvas) this.say(view);
  }

  line(pen, points, x, y, colour, dashed, gap) {
    pen.strokeStyle = colour;
    pen.lineWidth = dashed ? 2.5 : 1.5;
    pen.setLineDash(dashed ? [4, 3] : []);
    pen.beginPath();
    let before = NaN;
    for (let k = 0; k < points.length; k += 3) {
      const [time, low, high] = [points[k], points[k + 1], points[k + 2]];
      if (Number.isNaN(low)) { before = NaN; continue; }
      const across = x(time), [one, other] = [y(low), y(high)];
      if (time - before <= gap) pen.lineTo(across, one);
      else pen.moveTo(across, one);
      if (Math.abs(one - other) > 0.5) pen.lineTo(across, other);
      before = time;
    }
    pen.stroke();
    pen.setLineDash([]);
  }

  mark(pen, x, h, colour, dash) {
    pen.strokeStyle = colour;
    pen.lineWidth = 1;
    pen.setLineDash(dash);
    pen.beginPath(); pen.moveTo(Math.round(x) + 0.5, 0); pen.lineTo(Math.round(x) + 0.5, h); pen.stroke();
    pen.setLineDash([]);
  }

  // Reads the values at a time, and shows them as text.
  read(curves, time, near, brief) {
    this.time = time;
    this.at = curves.map((points, k) => valueAt(points, time, this.curves[k][2] ? Infinity : Math.max(GAP_S, near)));
    const named = this.curves.map(([name], k) => [name, this.at[k]]).reverse(), [one, other] = named.map(([, v]) => v);
    if (this.joint !== undefined && named.length > 1 && one !== null && other !== null) named.push(["difference", one - other]);
    if (brief && named.length > 2) named.splice(1, 1);
    const text = named.every(([, v]) => v === null) ? "–" : `${named.map(([name, v]) => `${named.length > 1 ? `${name} ` : ""}${v === null ? "–" : number(v)}`).join(", ")} ${this.unit}`;
    if (text === this.values) return;
    this.values = text;
    this.value.textContent = text;
  }

  // States the cursor for readers who do not see it.
  say(view) {
    if (view) this.view = view;
    if (!this.view || this.time === null) return;
    const { from, to } = this.view;
    for (const [key, value] of [["aria-valuemin", from.toFixed(3)], ["aria-valuemax", to.toFixed(3)], ["aria-valuenow", this.time.toFixed(3)], ["aria-valuetext", `${moment(this.time, secondDigits((to - from) / 100))}: ${this.values}`]]) {
      if (this.canvas.getAttribute(key) !== value) this.canvas.setAttribute(key, value);
    }
  }
}
