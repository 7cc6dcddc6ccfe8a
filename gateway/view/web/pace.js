// The times at which the picture is drawn, and its resolution. There is no clock here: times are arguments, in ms.

// A bench on the same machine needs processor time while the picture is drawn in software.
export const SOFTWARE_HZ = 15;
// The picture is drawn in full resolution after it has stood still for this time.
export const STILL_MS = 400;
// While frames take longer than the first time in ms, a moving picture in software has fewer pixels; more again, if they
// take less than the second.
const LATE_MS = 40, EARLY_MS = 16, RATIOS = [1, 0.85, 0.7];

export class Pace {
  constructor(software) {
    Object.assign(this, { software, began: -Infinity, ended: -Infinity, cost: 0, mean: 25, level: 0 });
  }

  // The time until the next frame may begin: a pause as long as the last frame took.
  wait(now) {
    const next = this.ended + 2 * this.cost, limit = this.software ? this.began + 1000 / SOFTWARE_HZ : 0;
    return Math.max(0, next - now, limit - now);
  }

  drew(began, ended) {
    Object.assign(this, { began, ended });
  }

  // The browser is ready for the next frame.
  ready(now) {
    this.cost = Math.min(500, now - this.ended);
    this.mean += (this.cost - this.mean) / 4;
    const level = this.level + (this.mean > LATE_MS ? 1 : this.mean < EARLY_MS ? -1 : 0);
    if (level === this.level || !RATIOS[level]) return;
    [this.level, this.mean] = [level, (LATE_MS + EARLY_MS) / 2];
  }

  // Pixels of the picture per pixel of the page, along each side.
  ratio(device, still) {
    return this.software ? (still ? 2 : RATIOS[this.level]) : Math.min(2, device);
  }
}

// Draws when something may have changed, as often as the machine can. `draw(ratio)` returns two flags: it drew, and it
// did other work that takes time.
export class Painter {
  constructor(software, draw) {
    Object.assign(this, { pace: new Pace(software), draw, due: false, later: 0, sharp: true, stood: 0 });
  }

  redraw() {
    if (this.due) return;
    this.due = true;
    // A picture that is about to change is not worth four times the pixels.
    clearTimeout(this.later);
    setTimeout(() => requestAnimationFrame(() => this.paint(false)), this.pace.wait(performance.now()));
  }

  paint(still) {
    this.due = false;
    const { pace } = this, began = performance.now();
    const { drew, worked } = this.draw(pace.ratio(window.devicePixelRatio || 1, still));
    if (drew) this.sharp = still;
    if (drew || worked) {
      if (drew) this.stood = performance.now();
      pace.drew(began, performance.now());
      requestAnimationFrame(() => pace.ready(performance.now()));
    }
    clearTimeout(this.later);
    if (this.sharp || !pace.software) return;
    // News may come more often than a busy machine draws, so this must not wait for a moment without any.
    if (!still && !drew && performance.now() - this.stood >= STILL_MS) return this.paint(true);
    this.later = setTimeout(() => requestAnimationFrame(() => { if (!this.due) this.paint(true); }), Math.max(0, this.stood + STILL_MS - performance.now()));
  }
}
