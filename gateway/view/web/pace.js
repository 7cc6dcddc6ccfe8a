// When the picture is drawn, and how finely. It has no clock: times are given, in ms.

// Where the processor draws, a bench on the same machine needs it too.
export const SOFTWARE_HZ = 15;
// The picture is drawn sharp once nothing has moved for so long.
export const STILL_MS = 400;

export class Pace {
  constructor(software) {
    Object.assign(this, { software, began: -Infinity, ended: -Infinity, cost: 0 });
  }

  // How long until the next frame may begin: as long as one took, there is none after it.
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
  }

  // Pixels of the picture for one of the page, along each side.
  ratio(device, still) {
    return this.software ? (still ? 2 : 1) : Math.min(2, device);
  }
}
