// What went wrong lately: totals only grow, so the page remembers when each has grown.

// For this long in s something counts as present.
const PRESENT_S = 3;

export class Health {
  constructor() {
    this.forget();
  }

  forget() {
    Object.assign(this, { seen: new Map(), time: 0, late: new Set() });
  }

  // Takes in the time of a status message in s. A time before the last one is a seek: nothing is known about then.
  begin(time) {
    if (time < this.time) this.seen.clear();
    this.time = time;
  }

  // Takes in a total by its name; returns how much it has grown since the last message.
  count(name, total) {
    const before = this.seen.get(name);
    const grown = before ? total - before.total : 0;
    if (!before || grown) this.seen.set(name, { total, at: grown > 0 ? this.time : before && grown === 0 ? before.at : null });
    return Math.max(0, grown);
  }

  // The time in s at which a total has grown last; null if it has not since the page is open.
  last(name) {
    return this.seen.get(name)?.at ?? null;
  }

  isPresent(name) {
    const at = this.last(name);
    return at !== null && this.time - at < PRESENT_S;
  }

  // The joints of the chains of buses whose replies are late or missing now.
  follow(scene, buses) {
    this.late = new Set(buses.flatMap((bus, b) => {
      const grown = this.count(`${b} late`, bus.late) + this.count(`${b} missing`, bus.missing);
      if (!grown && !this.isPresent(`${b} late`) && !this.isPresent(`${b} missing`)) return [];
      return scene.chains[scene.buses[b].chain].rows.flatMap(({ joint }) => (joint === null ? [] : [joint]));
    }));
  }

  lateJoints() {
    return this.late;
  }
}
