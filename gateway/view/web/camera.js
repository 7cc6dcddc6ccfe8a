// The camera: the position from which the picture is seen. It keeps the robot in the picture until a user moves it.

import { add, cross, dot, look, perspective, times, unit } from "./math.js";

// How far the view is from what it shows; a long focal length, so that a link that comes nearer grows little.
const FOCUS = 6;
// The share of the picture that the robot is to fill along the side that it fills most; the shares between which the zoom
// keeps it, and the one that it must not leave.
const FILL = 0.87, TIGHT = 0.85, ROOMY = 0.89, MOST = 0.985;
// The zoom changes by at most this much in a second, and how directly it follows.
const RATE = Math.log(1.19), STIFF = 10;
// If the robot becomes larger or smaller faster than the zoom may follow, beyond these shares, the view turns by itself:
// how fast in rad/s, how far up and down, and the angle that it tries.
const EASY = [0.8, 0.88], STEER_RATE = 2, STEERED = [0.15, 1.35], TRIED = 0.03;
// Beyond these it turns as far as it takes, in four steps, the longest of them at this speed in rad/s.
const HELD = [0.74, 0.95], RESCUE_RATE = 5;
// If the robot still does not fit, by more than this share, the view changes to the best of the directions that are this far
// away in rad: nearer ones first.
const STUCK = 0.02, FAR = [0.3, 0.6, 1, 1.5];
// A view that a user turns follows faster.
const TURNED_RATE = Math.log(4), TURNED_MS = 500;
// The times in s in which the view follows a robot that moves aside, and reaches another direction.
const FOLLOWED_S = 0.5, TURN_S = 0.45;
const STEEPEST = 1.5;
// The time in s for which a motion is expected to go on as it is.
export const AHEAD_S = 0.15;
// The longest step in s in which the view follows a motion.
const STEP_S = 1 / 30;

// In a picture that is higher than wide, the width limits the view.
const focus = (width, height) => FOCUS * Math.min(1, width / Math.max(1, height));
// The points a share of the way from some to others.
const between = (from, to, share) => (share === 0 || from === to ? from : share === 1 ? to : to.map((v, i) => from[i] + (v - from[i]) * share));
const clamp = (v, low, high) => Math.min(high, Math.max(low, v));

export class Camera {
  constructor() {
    Object.assign(this, {
      yaw: -1.0, pitch: 0.5, middle: [0, 0, 0], distance: 1, size: 1, closest: 0.05, auto: true, fresh: true, turned: -Infinity, speed: 0, goal: null, steers: true, steering: [0, 0],
    });
  }

  // The directions of the picture: to the right, up, and toward the eye.
  basis(yaw = this.yaw, pitch = this.pitch) {
    const c = Math.cos(pitch), to = [c * Math.cos(yaw), c * Math.sin(yaw), Math.sin(pitch)];
    const right = unit(cross([0, 0, 1], to));
    return [right, cross(to, right), to];
  }

  // The bounds of points, three numbers each, as the picture sees them: for each side of the picture the largest offset
  // plus the depth times the slope of that side. They do not depend on the place of the eye.
  bounds(points, width, height, share, basis = this.basis()) {
    const [[ax, ay, az], [bx, by, bz], [cx, cy, cz]] = basis, f = focus(width, height);
    const slopes = [share * width / Math.max(1, height) / f, share / f], [sx, sy] = slopes;
    let [right, left, top, bottom, low, high] = [-Infinity, -Infinity, -Infinity, -Infinity, Infinity, -Infinity];
    for (let i = 0; i < points.length; i += 3) {
      const x = points[i], y = points[i + 1], z = points[i + 2];
      const across = ax * x + ay * y + az * z, along = bx * x + by * y + bz * z, deep = cx * x + cy * y + cz * z;
      right = Math.max(right, across + sx * deep);
      left = Math.max(left, sx * deep - across);
      top = Math.max(top, along + sy * deep);
      bottom = Math.max(bottom, sy * deep - along);
      low = Math.min(low, deep);
      high = Math.max(high, deep);
    }
    const most = [right, left, top, bottom];
    return { slopes, most, depth: (low + high) / 2 };
  }

  // The nearest view in which all points cover no more than a share of the picture.
  fitted(points, width, height, share = FILL, basis = this.basis()) {
    const [right, up, to] = basis, { slopes, most, depth } = this.bounds(points, width, height, share, basis);
    const z = Math.max(...[0, 1].map((k) => (most[2 * k] + most[2 * k + 1]) / 2 / slopes[k]));
    const [x, y] = [0, 1].map((k) => (most[2 * k] - most[2 * k + 1]) / 2);
    return { middle: add(add(to.map((v) => v * depth), right, x), up, y), distance: z - depth };
  }

  // Follows the robot, whose outline is these points, after a time in s. `soon` are those that it is expected to have
  // next; `now` is in ms. However late a frame is, the way to it is followed in short steps.
  follow(points, soon, seconds, now, width, height, jumps = false) {
    if (!points.length || !width || !height) return;
    // The robot is fitted into a picture of another size at once.
    if (this.seen && (this.seen[0] !== width || this.seen[1] !== height)) jumps = true;
    this.seen = [width, height];
    const from = jumps || this.last?.length !== points.length ? points : this.last;
    this.last = points;
    const steps = Math.max(1, Math.ceil(seconds / STEP_S - 1e-6)), step = seconds / steps;
    for (let k = 1; k <= steps; k++) {
      const at = k === steps ? points : between(from, points, k / steps), ahead = AHEAD_S - (steps - k) * step;
      this.go(at, ahead > 0 ? between(points, soon, ahead / AHEAD_S) : between(from, points, Math.min(1, (k * step + AHEAD_S) / seconds)), step, now, width, height, jumps);
    }
  }

  go(points, soon, seconds, now, width, height, jumps) {
    if (this.goal) this.approach(seconds);
    if (!this.auto) return;
    if (this.steers && !this.fresh && !jumps) this.steer(points, seconds, width, height);
    if (this.steers && !this.fresh && !jumps) this.rescue(points, seconds, width, height);
    const basis = this.basis(), wanted = this.fitted(points, width, height, FILL, basis);
    if (this.fresh || jumps) {
      Object.assign(this, wanted, { fresh: false, speed: 0, steering: [0, 0], size: wanted.distance / FOCUS });
      return;
    }
    // Far enough for what it is and will be, and as near as the smaller one allows.
    const least = (of) => this.fitted(of, width, height, ROOMY, basis).distance;
    const far = Math.max(least(points), least(soon)), near = this.fitted(points, width, height, TIGHT, basis).distance;
    const aim = far > near ? far : clamp(this.distance, far, near);
    const rate = now - this.turned < TURNED_MS || this.goal ? TURNED_RATE : RATE;
    const speed = clamp(STIFF * Math.log(aim / this.distance), -rate, rate);
    this.speed += (speed - this.speed) * Math.min(1, 12 * seconds);
    this.distance *= Math.exp(clamp(this.speed, -rate, rate) * seconds);
    const part = 1 - Math.exp(-seconds / FOLLOWED_S);
    const way = add(wanted.middle, this.middle, -1), to = basis[2], deep = dot(way, to);
    this.middle = add(add(this.middle, way, part), to, deep * (1 - part));
    this.contain(points, width, height);
  }

  // Turns a little to where the robot fits better, if it becomes larger or smaller faster than the zoom may follow.
  steer(points, seconds, width, height) {
    const fill = (yaw, pitch) => Math.log(this.fitted(points, width, height, 1, this.basis(yaw, pitch)).distance / this.distance);
    const now = fill(this.yaw, this.pitch), off = now - clamp(now, Math.log(EASY[0]), Math.log(EASY[1]));
    const slope = [0, 1].map((k) => (fill(this.yaw + (k ? 0 : TRIED), this.pitch + (k ? TRIED : 0)) - now) / TRIED);
    const steep = Math.hypot(...slope), speed = off ? clamp(off / 0.1, -1, 1) * STEER_RATE : 0;
    slope.forEach((v, k) => {
      const aim = steep > 1e-3 ? -speed * v / steep : 0;
      this.steering[k] += (aim - this.steering[k]) * Math.min(1, 10 * seconds);
    });
    this.yaw += this.steering[0] * seconds;
    this.pitch = clamp(this.pitch + this.steering[1] * seconds, ...STEERED);
  }

  // Turns at once, if the robot would not fit even with the fastest zoom: by little if that helps, else to another side.
  rescue(points, seconds, width, height) {
    const off = (yaw, pitch) => {
      const fill = this.fitted(points, width, height, 1, this.basis(yaw, pitch)).distance / this.distance;
      return Math.max(0, Math.log(HELD[0] / fill), Math.log(fill / HELD[1]));
    };
    let least = off(this.yaw, this.pitch);
    const around = (far) => {
      let best = null;
      for (let k = 0; k < 12; k++) {
        const yaw = this.yaw + Math.cos(k * Math.PI / 6) * far, pitch = clamp(this.pitch + Math.sin(k * Math.PI / 6) * far, ...STEERED), it = off(yaw, pitch);
        if (it < least) [best, least] = [[yaw, pitch], it];
      }
      if (best) [this.yaw, this.pitch] = best;
      return best !== null;
    };
    for (let ring = 1; least > 0 && ring <= 4; ring++) around(RESCUE_RATE * seconds * ring / 4);
    if (least > STUCK) FAR.some(around);
  }

  // Moves aside so far that no point is outside the picture.
  contain(points, width, height) {
    const basis = this.basis(), [right, up, to] = basis, { slopes, most } = this.bounds(points, width, height, MOST, basis);
    const eye = add(this.middle, to, this.distance), z = dot(eye, to);
    [right, up].forEach((axis, k) => {
      const [low, high] = [most[2 * k] - slopes[k] * z, slopes[k] * z - most[2 * k + 1]], at = dot(eye, axis);
      const inside = low > high ? (low + high) / 2 : clamp(at, low, high);
      this.middle = add(this.middle, axis, inside - at);
    });
  }

  // Turns toward the direction of a goal.
  approach(seconds) {
    const { yaw, pitch, left } = this.goal, part = left <= seconds ? 1 : seconds / left;
    const way = Math.atan2(Math.sin(yaw - this.yaw), Math.cos(yaw - this.yaw));
    this.yaw += way * part;
    this.pitch += (pitch - this.pitch) * part;
    this.goal = part === 1 ? null : { yaw, pitch, left: left - seconds };
  }

  // Returns true while the view moves by itself.
  get moves() {
    return this.goal !== null || this.auto && Math.max(...[this.speed, ...this.steering].map(Math.abs)) > 0.002;
  }

  turn(dx, dy, now = 0) {
    Object.assign(this, { turned: now, goal: null, steers: false });
    this.yaw -= dx * 0.008;
    this.pitch = clamp(this.pitch + dy * 0.008, -STEEPEST, STEEPEST);
  }

  // Turns to a direction, at once or by and by.
  turnTo(yaw, pitch, atOnce) {
    this.steers = false;
    this.goal = { yaw, pitch: clamp(pitch, -STEEPEST, STEEPEST), left: atOnce ? 0 : TURN_S };
  }

  // Frames the robot again, in the current direction.
  fit() {
    Object.assign(this, { auto: true, fresh: true, steers: true });
  }

  // Looks at the robot from where most of its skin is seen: `normals` are those of its cells, each with a weight.
  // Directions near the current one are preferred.
  choose(normals) {
    let best = -Infinity;
    const from = this.yaw;
    for (let k = 0; k < 48; k++) {
      const yaw = from + (k % 2 ? -1 : 1) * Math.ceil(k / 2) * Math.PI / 24, [, , to] = this.basis(yaw);
      const seen = normals.reduce((sum, [n, weight]) => sum + weight * Math.max(0, dot(n, to)), 0);
      if (seen > best * 1.002 + 1e-9) [best, this.yaw] = [seen, yaw];
    }
  }

  // Zooms by a factor around a point, which is given in pixels from the middle of a picture of this size.
  nearer(by, [x, y] = [0, 0], width = 1, height = 1) {
    const before = this.distance;
    Object.assign(this, { auto: false, goal: null });
    this.distance = clamp(before / by, this.closest * this.size * FOCUS, 6 * this.size * FOCUS);
    const grown = before / this.distance - 1;
    this.move(-x * grown, -y * grown, width, height);
  }

  // Pans by a distance in pixels of a picture of this size.
  move(dx, dy, width, height) {
    const grain = this.grain(width, height), [right, up] = this.basis();
    Object.assign(this, { auto: false, goal: null });
    this.middle = add(add(this.middle, right, -dx * grain), up, dy * grain);
  }

  // Looks at a point along its normal, near enough that a length at the point covers a number of pixels.
  face(place, normal, length, pixels, width, height) {
    const [x, y, z] = normal;
    Object.assign(this, { auto: false, goal: null, middle: place, yaw: Math.atan2(y, x) + 0.25 });
    this.pitch = clamp(Math.asin(clamp(z, -1, 1)) + 0.15, -STEEPEST, STEEPEST);
    this.distance = Math.max(this.closest * this.size * FOCUS, Math.min(this.distance, this.distance * length / (pixels * this.grain(width, height))));
  }

  // The length of a pixel at the middle of the view.
  grain(width, height) {
    return this.distance / focus(width, height) * 2 / Math.max(1, height);
  }

  // The direction from the middle of the view to the eye.
  toward() {
    return this.basis()[2];
  }

  eye() {
    return add(this.middle, this.toward(), this.distance);
  }

  matrix(width, height) {
    const near = Math.min(this.size * 0.02, this.distance * 0.2), far = this.distance + this.size * 8;
    return times(perspective(focus(width, height), width / Math.max(1, height), near, far), look(this.eye(), this.middle));
  }
}
