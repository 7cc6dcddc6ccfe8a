// The camera: the position from which the picture is seen.

import { add, cross, look, perspective, times, unit } from "./math.js";

// At this distance, in sizes, a sphere of that size is completely visible, including the thickness of the links around
// it.
const FAR = 1.15;

// In a picture that is higher than wide, the width limits the view.
const focus = (width, height) => Math.min(2, 2 * width / Math.max(1, height));

export class Camera {
  constructor() {
    Object.assign(this, { yaw: -1.0, pitch: 0.3, zoom: 1, most: 20, middle: [0, 0, 0], size: 1, moved: false, box: null });
  }

  // Fits this box and all earlier ones, unless a user has moved the camera. The camera stands still once the robot has
  // been everywhere.
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

  // Shows everything again, in the current direction.
  whole() {
    Object.assign(this, { moved: false, zoom: 1 });
    if (this.box) this.fit(this.box);
  }

  // Zooms by a factor around a point, which is given in pixels from the middle of a picture of this size.
  nearer(by, [x, y] = [0, 0], width = 1, height = 1) {
    const before = this.zoom;
    this.moved = true;
    this.zoom = Math.min(this.most, Math.max(0.3, this.zoom * by));
    const grown = this.zoom / before - 1;
    this.move(-x * grown, -y * grown, width, height);
  }

  // Pans by a distance in pixels of a picture of this size.
  move(dx, dy, width, height) {
    const grain = this.grain(width, height), to = this.toward(), right = unit(cross([0, 0, 1], to));
    this.moved = true;
    this.middle = add(add(this.middle, right, -dx * grain), cross(to, right), dy * grain);
  }

  // Looks at a point along its normal, near enough that a length at the point covers a number of pixels.
  face(place, normal, length, pixels, width, height) {
    const [x, y, z] = normal;
    Object.assign(this, { moved: true, middle: place, yaw: Math.atan2(y, x) + 0.25 });
    this.pitch = Math.min(1.5, Math.max(-1.5, Math.asin(Math.min(1, Math.max(-1, z))) + 0.15));
    this.zoom = Math.min(this.most, Math.max(this.zoom, this.zoom * pixels * this.grain(width, height) / length));
  }

  // The length of a pixel at the middle of the view.
  grain(width, height) {
    return this.distance() / focus(width, height) * 2 / Math.max(1, height);
  }

  distance() {
    return this.size * FAR / this.zoom;
  }

  // The direction from the middle of the view to the eye.
  toward() {
    const c = Math.cos(this.pitch);
    return [c * Math.cos(this.yaw), c * Math.sin(this.yaw), Math.sin(this.pitch)];
  }

  eye() {
    return add(this.middle, this.toward(), this.distance());
  }

  matrix(width, height) {
    const near = Math.min(this.size * 0.02, this.distance() * 0.2), far = this.size * 6 / Math.min(1, this.zoom);
    return times(perspective(focus(width, height), width / Math.max(1, height), near, far), look(this.eye(), this.middle));
  }
}
