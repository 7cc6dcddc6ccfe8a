// The pointer and the keys: turning, zooming, choosing and pressing.

import { add, direction, dot, point, project } from "./math.js";

// The cell at a point of the picture, among those that are hit from their front: of the cells within a pitch of the one nearest to
// the eye, the one whose centre is nearest to the point.
export function pick(scene, frames, camera, view, width, height, x, y) {
  // The length of the view's second row is its focal length.
  const eye = camera.eye(), hit = [], focus = Math.hypot(view[1], view[5], view[9]);
  scene.cells.forEach((cell, i) => {
    const m = frames[scene.buses[cell.bus].chain][cell.row], at = point(m, cell.position);
    const seen = project(view, at, width, height);
    if (!seen) return;
    const radius = Math.max(6, scene.pitch * 0.56 / seen[2] * height / 2 * focus);
    const off = Math.hypot(seen[0] - x, seen[1] - y);
    if (off <= radius && dot(direction(m, cell.normal), add(eye, at, -1)) > 0) hit.push({ i, off, far: seen[2] });
  });
  const nearest = Math.min(...hit.map((it) => it.far));
  return hit.filter((it) => it.far < nearest + scene.pitch).reduce((best, it) => (it.off < best.off ? it : best), { i: -1, off: Infinity }).i;
}

// A press that is released within this distance is a click, in pixels.
const CLICK = 5;

// Calls `on.at(x, y)` for the cell there, `on.press(cell)`, `on.release()`, `on.turn(dx, dy)`, `on.zoom(by, x, y)`. A page that cannot
// press has `on.choose(cell)` for a click, and `on.move(dx, dy)` for a drag with shift, another button or two fingers.
export function listen(canvas, on) {
  const pointers = new Map();
  let presses = false, apart = 0, travelled = 0;
  const place = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const stop = () => { if (presses) { presses = false; on.release(); } };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, place(event));
    if (pointers.size > 1) { stop(); apart = 0; travelled = CLICK; return; }
    travelled = 0;
    const cell = !on.choose && event.button === 0 && !event.shiftKey ? on.at(...place(event)) : -1;
    if (cell >= 0) { presses = true; on.press(cell); }
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = place(event), [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    pointers.set(event.pointerId, now);
    travelled += Math.hypot(dx, dy);
    if (pointers.size === 2) {
      const [a, b] = [...pointers.values()], far = Math.hypot(a[0] - b[0], a[1] - b[1]);
      on.move?.(dx / 2, dy / 2);
      if (apart) on.zoom(far / apart, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
      apart = far;
    } else if (presses) {
      const cell = on.at(...now);
      if (cell >= 0) on.press(cell);
    } else if (on.move && (event.shiftKey || event.buttons > 1)) {
      on.move(dx, dy);
    } else {
      on.turn(dx, dy);
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    if (on.choose && pointers.size === 1 && travelled < CLICK) on.choose(on.at(...place(event)));
  });
  if (on.move) canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    canvas.addEventListener(name, (event) => { pointers.delete(event.pointerId); if (!pointers.size) stop(); apart = 0; });
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    on.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };
    const key = event.key;
    if (turns[key]) on.turn(...turns[key]);
    else if (key === "+" || key === "=") on.zoom(1.2);
    else if (key === "-") on.zoom(1 / 1.2);
    else if (key === "f") on.fit();
    else if (key === "n" || key === "p") on.next(key === "n" ? 1 : -1);
    else if (key === " ") { if (!event.repeat) on.pressChosen(); }
    else if (key === "Escape") on.release();
    else return;
    event.preventDefault();
  });
  canvas.addEventListener("keyup", (event) => { if (event.key === " ") on.release(); });
  canvas.addEventListener("blur", () => { stop(); on.release(); });
}
