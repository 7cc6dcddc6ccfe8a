// Values over time: those that this page has received, and those that the server has of a recording. Both give curves as points
// [time in s, minimum, maximum] in one array, NaN without a value.

// Times of a live bench may go back by a little, while its frames are late.
export const isBack = (time, last) => time < last - 1;

// The newest values of some quantities; `Kind` is the type of array for them.
export class Recent {
  constructor(quantities, capacity, Kind = Float32Array, scale = 1) {
    Object.assign(this, { quantities, capacity, scale, size: 0, next: 0, times: new Float64Array(capacity), values: new Kind(capacity * quantities) });
  }

  // Adds values at a time in s. A time long before the last one is a seek or another run, and removes all.
  add(time, values) {
    if (isBack(time, this.last()) && this.size) this.clear();
    if (this.size && time <= this.last()) return;
    this.times[this.next] = time;
    this.values.set(values, this.next * this.quantities);
    this.next = (this.next + 1) % this.capacity;
    this.size = Math.min(this.capacity, this.size + 1);
  }

  clear() {
    [this.size, this.next] = [0, 0];
  }

  // The place of the k-th value, from the oldest.
  place(k) {
    return (this.next - this.size + k + this.capacity) % this.capacity;
  }

  first() {
    return this.size ? this.times[this.place(0)] : 0;
  }

  last() {
    return this.size ? this.times[this.place(this.size - 1)] : 0;
  }

  // The number of the first value at or after a time.
  after(time) {
    let [low, high] = [0, this.size];
    while (low < high) {
      const k = (low + high) >> 1;
      if (this.times[this.place(k)] < time) low = k + 1;
      else high = k;
    }
    return low;
  }

  // A quantity from one time to another, with about `count` points or fewer: a point for each of equal parts of time, which do not
  // move when the time shown does. `none` is the value that stands for no value.
  curve(quantity, from, to, count, none = NaN) {
    const step = (to - from) / Math.max(1, count), points = [];
    let part = NaN;
    for (let k = Math.max(0, this.after(from) - 1); k < this.size; k++) {
      const place = this.place(k), time = this.times[place], raw = this.values[place * this.quantities + quantity];
      const value = raw === none ? NaN : raw * this.scale, of = step ? Math.floor(time / step) : k, at = points.length - 3;
      if (of === part && !Number.isNaN(value) && !Number.isNaN(points[at + 1])) {
        points[at + 1] = Math.min(points[at + 1], value);
        points[at + 2] = Math.max(points[at + 2], value);
      } else {
        points.push(time, value, value);
      }
      part = of;
      if (time > to) break;
    }
    return points;
  }
}

// Decodes the answer to a request for curves.
export function decodeCurves(buffer) {
  const data = new DataView(buffer), quantities = data.getUint32(0, true), intervals = data.getUint32(4, true);
  const [from, step] = [data.getFloat64(8, true), data.getFloat64(16, true)];
  if (buffer.byteLength !== 24 + 8 * quantities * intervals) throw new Error("the curves have a wrong length");
  return { from, step, intervals, ranges: new Float32Array(buffer, 24, 2 * quantities * intervals) };
}

// A decoded quantity as points. Intervals without a value are left out, unless they follow each other for a second; where
// the quantity `beside` has a value, this one is unknown, NaN.
export function points({ from, step, intervals, ranges }, quantity, beside = quantity) {
  const all = [];
  for (let k = 0; k < intervals; k++) {
    const at = 2 * (quantity * intervals + k);
    if (!Number.isNaN(ranges[2 * (beside * intervals + k)])) all.push(from + (k + 0.5) * step, ranges[at], ranges[at + 1]);
  }
  return all;
}

// Values of a recording from the server: keeps the newest answer for each kind of curve.
export class Recorded {
  // `ask(path)` gets a Response; `arrived()` is called when an answer has come.
  constructor(ask, arrived) {
    Object.assign(this, { ask, arrived, kept: new Map() });
  }

  clear() {
    this.kept.clear();
  }

  // The answer for a time, and with `fresh` for the state of the index; null until it has come. Requests more than is shown.
  part(what, from, to, count, fresh, decode) {
    const kept = this.kept.get(what) ?? { answer: null, waits: false, from: NaN, to: NaN, step: NaN, fresh: null };
    const span = to - from, fits = kept.from <= from && to <= kept.to && kept.step <= 1.2 * span / count && kept.step >= 0.2 * span / count;
    this.kept.set(what, kept);
    if ((!fits || kept.fresh !== fresh) && !kept.waits) this.request(what, kept, [from - span / 2, to + span / 2, 2 * count], fresh, decode);
    return kept.answer;
  }

  async request(what, kept, [from, to, count], fresh, decode) {
    kept.waits = true;
    try {
      const answer = await this.ask(`${what}${what.includes("?") ? "&" : "?"}from=${from}&to=${to}&count=${Math.min(4096, count)}`);
      if (answer.ok) Object.assign(kept, { answer: await decode(answer), from, to, step: (to - from) / count, fresh });
    } catch {
      // The connection is lost, which the page reports elsewhere.
    }
    kept.waits = false;
    if (kept.answer) this.arrived();
  }
}
