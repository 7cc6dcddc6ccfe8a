// Where the picture is seen from.

import { look, perspective, times } from "./math.js";

export class Camera {
  constructor() {
    Object.assign(this, { yaw: -1.0, pitch: 0.3, zoom: 1, middle: [0, 0, 0], size: 1, moved: false });
  }

  // Shows all of it, unless somebody has moved the camera; it stays where it is while the robot moves a little.
  fit({ middle, size }) {
    const off = Math.hypot(...middle.map((v, i) => v - this.middle[i]));
    if (!this.moved && (off > 0.12 * this.size || Math.abs(size - this.size) > 0.25 * this.size)) {
      Object.assign(this, { middle, size });
    }
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
    const far = this.size * 1.02 / this.zoom, c = Math.cos(this.pitch);
    return [c * Math.cos(this.yaw), c * Math.sin(this.yaw), Math.sin(this.pitch)].map((v, i) => this.middle[i] + far * v);
  }

  matrix(width, height) {
    const aspect = width / Math.max(1, height), eye = this.eye();
    const far = this.size * 6 / Math.min(1, this.zoom);
    return times(perspective(Math.min(2, 2 * aspect), aspect, this.size * 0.02, far), look(eye, this.middle));
  }
}
