// Keys of what the picture shows: the colours of buses, and the shapes of cells.

import { SHAPES, busColour, isDark, ramp } from "./colours.js";
import { element } from "./dom.js";

// Draws the colours of values from low to high.
export function drawRamp(canvas) {
  const pen = canvas.getContext("2d"), { width, height } = canvas;
  for (let x = 0; x < width; x++) {
    pen.fillStyle = `rgb(${ramp(x / (width - 1), isDark()).join(" ")})`;
    pen.fillRect(x, 0, 1, height);
  }
}

// A square of a bus' colour.
export function busKey(bus) {
  const key = element("canvas"), pen = key.getContext("2d");
  [key.width, key.height] = [14, 14];
  key.setAttribute("aria-hidden", "true");
  pen.fillStyle = `rgb(${busColour(bus).join(" ")})`;
  pen.fillRect(0, 0, 14, 14);
  return key;
}

// A cell as the picture draws it, with a mark; or a cell's way from where it was described.
export function shapeKey(css, mark) {
  const size = 48, canvas = element("canvas"), r = size * 0.46;
  [canvas.width, canvas.height] = [size, size];
  canvas.setAttribute("aria-hidden", "true");
  const pen = canvas.getContext("2d");
  pen.translate(size / 2, size / 2);
  const hexagon = (k) => { pen.beginPath(); for (let i = 0; i < 6; i++) pen.lineTo(k * r * Math.cos(i * Math.PI / 3), k * r * Math.sin(i * Math.PI / 3)); pen.closePath(); };
  if (mark === "way") {
    pen.fillStyle = css("--alarm");
    pen.beginPath(); pen.moveTo(-r, -r * 0.35); pen.lineTo(-r, r * 0.35); pen.lineTo(r, 0); pen.fill();
    return canvas;
  }
  hexagon(1);
  pen.fillStyle = css("--unlit"); pen.fill();
  pen.strokeStyle = css("--faint"); pen.lineWidth = 3; pen.stroke();
  pen.fillStyle = pen.strokeStyle = css("--mark");
  pen.lineWidth = 6;
  const erase = () => { pen.globalCompositeOperation = "destination-out"; pen.fill(); pen.globalCompositeOperation = "source-over"; };
  if (mark === "cross") { pen.beginPath(); for (const s of [1, -1]) { pen.moveTo(-r * 0.5, -s * r * 0.5); pen.lineTo(r * 0.5, s * r * 0.5); } pen.stroke(); }
  if (mark === "ring") { hexagon(0.7); erase(); }
  if (mark === "hole") { pen.beginPath(); pen.arc(0, 0, r * 0.4, 0, 7); erase(); }
  if (mark === "disc") { pen.beginPath(); pen.arc(0, 0, r * 0.34, 0, 7); pen.fill(); }
  if (mark === "half") { pen.fillRect(0, -r * 0.7, r * 0.6, r * 1.4); }
  if (mark === "bar") { pen.fillRect(-r * 0.66, -r * 0.16, r * 1.32, r * 0.32); }
  if (mark === "square") { pen.globalAlpha = 0.5; pen.fillRect(-r * 0.26, -r * 0.26, r * 0.52, r * 0.52); pen.globalAlpha = 1; }
  if (mark === "root") { pen.lineWidth = 4; hexagon(0.57); pen.stroke(); }
  return canvas;
}

// Shows the shapes of cells in a list.
export function shapes(box, css, all = SHAPES) {
  box.replaceChildren(...all.map(({ name, mark }) => {
    const item = element("li");
    item.append(shapeKey(css, mark), element("span", name));
    return item;
  }));
}
