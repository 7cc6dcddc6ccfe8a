// The axes of plots and the places of labels. There is no DOM here.

// The smallest of 1, 2 and 5 times a power of ten that divides a span into at most `count` parts.
export function niceStep(span, count) {
  const rough = Math.max(span, 1e-9) / Math.max(1, count), power = 10 ** Math.floor(Math.log10(rough));
  return power * ([1, 2, 5].find((k) => k * power >= rough * (1 - 1e-9)) ?? 10);
}

// The multiples of a nice step between two values, and the step.
export function ticks(low, high, count) {
  const step = niceStep(high - low, count), all = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) all.push(k * step);
  return { step, all };
}

// A multiple of a step, with no more digits than the step has.
export function tickText(value, step) {
  const digits = Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)));
  const text = value.toFixed(digits);
  return Number(text) === 0 ? "0" : text.replace("-", "−");
}

// The digits of a second that ticks with this step need.
export const secondDigits = (step) => Math.max(0, Math.min(3, -Math.floor(Math.log10(step) + 1e-9)));

// The bounds of an axis for values between two bounds: they contain zero, have room for a line, and change in steps.
export function bounds(low, high, least) {
  const [a, b] = [Math.min(0, low), Math.max(0, high)], step = niceStep(Math.max(b - a, least), 3) / 4;
  const out = (v) => (v > 0 ? Math.ceil(v * 1.05 / step - 1e-9) * step : 0);
  return [-out(-a), Math.max(out(b), a < 0 ? 0 : out(least))];
}

// A part of the time, which is changed around a moment, and stays within limits.
const SPANS = [0.05, 86400];

export function zoomed({ from, to }, factor, at, [first, last] = [-Infinity, Infinity]) {
  const span = Math.min(Math.max((to - from) / factor, SPANS[0]), Math.min(SPANS[1], Math.max(last - first, SPANS[0])));
  const share = to > from ? (at - from) / (to - from) : 0.5, begin = at - share * span;
  return within({ from: begin, to: begin + span }, [first, last]);
}

export function within({ from, to }, [first, last] = [-Infinity, Infinity]) {
  const by = from < first ? first - from : to > last ? Math.max(first - from, last - to) : 0;
  return { from: from + by, to: to + by };
}

// The time that is shown while the page follows: the last `span` seconds, or in a recording what is around the position.
export function followed(now, span, limits) {
  if (!limits) return { from: now - span, to: now };
  return within({ from: now - span * 0.7, to: now + span * 0.3 }, limits);
}

// Joins events of one kind that are less than `apart` pixels from the one before; events are in the order of time.
export function groups(events, pixelsPerSecond, apart) {
  const last = new Map(), all = [];
  for (const event of events) {
    const group = last.get(event.kind);
    if (group && (event.at_s - group.end) * pixelsPerSecond < apart) {
      group.events.push(event);
      group.end = event.at_s;
      continue;
    }
    const fresh = { kind: event.kind, at: event.at_s, end: event.at_s, events: [event] };
    last.set(event.kind, fresh);
    all.push(fresh);
  }
  return all;
}

// A row and a place for each label, so that none overlap and all are between 0 and `width`; row −1 for a label without room. The
// first labels have the first choice. Each has its width w, and the places that suit it, the best first.
export function rowsOf(labels, width, rows, gap) {
  const taken = Array.from({ length: rows }, () => []);
  return labels.map(({ places, w }) => {
    for (const x of places.filter((it) => it >= 0 && it + w <= width)) {
      const row = taken.findIndex((of) => of.every(([from, to]) => x + w + gap <= from || to + gap <= x));
      if (row < 0) continue;
      taken[row].push([x, x + w]);
      return { row, x };
    }
    return { row: -1, x: 0 };
  });
}

// A measured value: four digits or so.
export function number(value) {
  const size = Math.abs(value);
  const text = size >= 100 ? value.toFixed(0) : size >= 10 ? value.toFixed(1) : size >= 1 ? value.toFixed(2) : value.toFixed(4);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}
