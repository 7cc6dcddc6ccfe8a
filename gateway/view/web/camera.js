// Where the picture is seen from.

import { look, perspective, times } from "./math.js";

// So many sizes away a sphere of that size is seen whole, and the thickness of the links around it.
const FAR = 1.15;

export class Camera {
  constructor() {
    Object.assign(this, { yaw: -1.0, pitch: 0.3, zoom: 1, middle: [0, 0, 0], size: 1, moved: false, box: null });
  }

  // Shows this box and all before it, unless somebody has moved the camera: it stands still once the robot has been everywhere.
  fit({ low, high }) {
    const now = this.box ?? { low, high };
    this.box = { low: low.map((v, i) => Math.min(v, now.low[i])), high: high.map((v, i) => Math.max(v, now.high[i])) };
    if (this.moved) return;
    const [from, to] = [this.box.low, this.box.high];
    this.middle = from.map((v, i) => (v + to[i]) / 2);
    this.size = Math.hypot(...from.map((v, i) => to[i] - v)) || 1;
  }

  turn(dx, dy) {
    this.moved = true;
    this.yaw -= dx * 0.008;
    this.pitch = Math.min(1.5, Math.max(-1.5, this.pitch + dy * 0.008));
  }

  nearer(by) {
    this.moved = true;
    this.zoom = Math.min(20, Math.max(0.3, this.zoom * by));
  }

  eye() {
    const far = this.size * FAR / this.zoom, c = Math.cos(this.pitch);
    return [c * Math.cos(this.yaw), c * Math.sin(this.yaw), Math.sin(this.pitch)].map((v, i) => this.middle[i] + far * v);
  }

  matrix(width, height) {
    const aspect = width / Math.max(1, height), eye = this.eye();
    const far = this.size * 6 / Math.min(1, this.zoom);
    return times(perspective(Math.min(2, 2 * aspect), aspect, this.size * 0.02, far), look(eye, this.middle));
  }
}
