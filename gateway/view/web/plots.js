// A small plot for each joint: the torque that the cells sent, and the central computation.

import { css } from "./colours.js";

const SECONDS = 10;

export class Plots {
  constructor(box, joints) {
    this.rows = joints.map((joint, at) => {
      const row = document.createElement("div"), canvas = document.createElement("canvas");
      row.className = "plot";
      const name = document.createElement("span"), value = document.createElement("span");
      name.textContent = joint.name === `joint${at + 1}` ? `Joint ${at + 1}` : `${at + 1} ${joint.name}`;
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `${name.textContent}: torque of the last ${SECONDS} s`);
      row.append(name, value, canvas);
      return { row, canvas, value, unit: joint.torque_unit, points: [] };
    });
    box.replaceChildren(...this.rows.map((it) => it.row));
  }

  push(time, joints) {
    this.rows.forEach((row, at) => {
      const { distributed, central } = joints[at], { points } = row;
      if (points.length && time < points[points.length - 1][0]) points.length = 0;
      points.push([time, distributed, central]);
      while (points.length > 2 && points[0][0] < time - SECONDS) points.shift();
    });
  }

  // Replaces all values by a history.
  replace(history) {
    for (const row of this.rows) row.points.length = 0;
    for (const { time, joints } of history) this.push(time, joints);
  }

  draw() {
    const [line, faint, distributed, central] = ["--line", "--faint", "--distributed", "--central"].map(css);
    for (const { canvas, value, unit, points } of this.rows) {
      const ratio = Math.min(2, window.devicePixelRatio || 1), [w, h] = [canvas.clientWidth, canvas.clientHeight];
      if (!points.length || !w) continue;
      const [time, now, exact] = points[points.length - 1];
      value.textContent = `${number(now)} ${unit}, error ${number(now - exact)}`;
      if (canvas.width !== Math.round(w * ratio)) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); }
      // In memory: the processor draws small lines sooner than WebGL in software.
      const pen = canvas.getContext("2d", { willReadFrequently: true });
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.clearRect(0, 0, w, h);
      let high = 0.01;
      for (const [, a, b] of points) high = Math.max(high, Math.abs(a), Math.abs(b));
      const y = (v) => h / 2 - v / high * (h / 2 - 4), x = (t) => w - (time - t) / SECONDS * w;
      pen.strokeStyle = line;
      pen.lineWidth = 1;
      pen.beginPath(); pen.moveTo(0, y(0)); pen.lineTo(w, y(0)); pen.stroke();
      pen.fillStyle = faint;
      pen.font = "11px system-ui, sans-serif";
      pen.fillText(number(high), 0, 10);
      pen.fillText(number(-high), 0, h - 2);
      for (const [k, colour, dash, width] of [[2, central, [4, 3], 2.5], [1, distributed, [], 1.5]]) {
        pen.strokeStyle = colour;
        pen.lineWidth = width;
        pen.setLineDash(dash);
        pen.beginPath();
        points.forEach((p, i) => (i ? pen.lineTo(x(p[0]), y(p[k])) : pen.moveTo(x(p[0]), y(p[k]))));
        pen.stroke();
      }
      pen.setLineDash([]);
    }
  }
}

export function number(value) {
  const size = Math.abs(value);
  const text = size >= 100 ? value.toFixed(0) : size >= 10 ? value.toFixed(1) : size >= 1 ? value.toFixed(2) : value.toFixed(4);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}
