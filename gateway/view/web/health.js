// What went wrong lately: totals only grow, so the page remembers when each has grown.

import { isBack } from "./curves.js";

// For this long in s something counts as present, is shown as an alarm, and as one that is over.
const [PRESENT_S, ALARM_S, OVER_S] = [3, 10, 20];
// The totals of a bus that should not grow. Those of losses are counted together.
const LOSSES = ["late", "missing", "lost", "rejected", "dropped"];

export class Health {
  constructor() {
    this.forget();
  }

  forget() {
    Object.assign(this, { seen: new Map(), time: 0, late: new Set() });
  }

  // Takes in the time of a status message in s. A time before the last one, or later by more than `most`, is a seek: nothing is
  // known about then.
  begin(time, most = Infinity) {
    if (isBack(time, this.time) || time > this.time + most) this.seen.clear();
    this.time = isBack(time, this.time) ? time : Math.max(time, this.time);
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

  isPresent(name, within = PRESENT_S) {
    const at = this.last(name);
    return at !== null && this.time - at < within;
  }

  // The last growth of any of these totals: when, in s, or null; and how it is shown: as an alarm, and less so with time.
  lately(names) {
    const times = names.map((name) => this.last(name)).filter((at) => at !== null);
    const at = times.length ? Math.max(...times) : null, since = at === null ? Infinity : this.time - at;
    return { at, style: since < ALARM_S ? "alarm" : since < OVER_S ? "over" : "" };
  }

  // Takes in the totals of all buses, and finds the joints of the chains of buses whose replies are late or missing now. Returns
  // the number of losses since the last message.
  follow(scene, buses) {
    let losses = 0;
    this.late = new Set(buses.flatMap((bus, b) => {
      const [late, missing, ...others] = LOSSES.map((name) => this.count(`${b} ${name}`, bus[name] ?? 0)), grown = late + missing;
      losses += others.reduce((sum, n) => sum + n, grown);
      this.count(`${b} saturated`, bus.saturated ?? 0);
      this.count(`${b} incomplete`, (bus.epochs_due ?? 0) - (bus.epochs_complete ?? 0));
      if (!grown && !this.isPresent(`${b} late`) && !this.isPresent(`${b} missing`)) return [];
      return scene.chains[scene.buses[b].chain].rows.flatMap(({ joint }) => (joint === null ? [] : [joint]));
    }));
    return losses;
  }

  lateJoints() {
    return this.late;
  }
}
