// The time line of a recording: the position, the events, and the playback controls.

import { css } from "./colours.js";
import { button, element } from "./dom.js";
import { KINDS, colourOf } from "./events.js";

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10, 20];
const PARTS = 600;

// Minutes, seconds and thousandths of a time in s; hours if needed. Times before the loop began are negative.
export const clock = (seconds) => moment(seconds, 3);

// The same with another number of digits.
export function moment(seconds, digits) {
  const unit = 10 ** digits, all = Math.round(Math.abs(seconds) * unit), two = (v) => String(v).padStart(2, "0");
  const [h, m, s] = [Math.floor(all / unit / 3600), Math.floor(all / unit / 60) % 60, Math.floor(all / unit) % 60];
  const part = digits ? `.${String(all % unit).padStart(digits, "0")}` : "";
  return `${seconds < 0 && all > 0 ? "−" : ""}${h ? `${h}:${two(m)}` : m}:${two(s)}${part}`;
}

// The position in s that a fragment of the address requests, as in `#at=12.5`; null without one.
export function requested(fragment) {
  const found = /^#at=(\d+(?:\.\d+)?)$/.exec(fragment);
  return found ? Number(found[1]) : null;
}

export class TimeBar {
  constructor(box, send) {
    Object.assign(this, { box, send, playback: null, dragged: null, marked: "" });
    this.play = button("Play", "Play", () => this.toggle());
    this.back = button("−1", "−1 epoch", () => send({ do: "step", forward: false }), "Previous epoch");
    this.forth = button("+1", "+1 epoch", () => send({ do: "step", forward: true }), "Next epoch");
    this.speed = element("select");
    this.speed.setAttribute("aria-label", "Speed");
    for (const speed of SPEEDS) {
      const it = element("option", `${speed} ×`);
      it.value = String(speed);
      this.speed.append(it);
    }
    this.speed.value = "1";
    this.speed.onchange = () => { if (this.playback?.playing) send({ do: "play", speed: Number(this.speed.value) }); };
    this.kind = element("select");
    this.kind.setAttribute("aria-label", "Event to go to");
    for (const [kind, name] of Object.entries(KINDS)) {
      const it = element("option", name);
      it.value = kind;
      this.kind.append(it);
    }
    this.kind.value = "touch";
    const jump = (forward) => () => send({ do: "jump", to: this.kind.value, forward });
    this.last = button("◂", "Previous event", jump(false));
    this.next = button("▸", "Next event", jump(true));
    this.slider = element("input");
    Object.assign(this.slider, { type: "range", min: 0, max: 1, step: "any", value: 0 });
    this.slider.setAttribute("aria-label", "Position");
    this.slider.oninput = () => { this.dragged = Number(this.slider.value); send({ do: "seek", at_s: this.dragged }); this.words(); };
    this.slider.onchange = () => { this.dragged = null; };
    this.marks = element("canvas");
    this.marks.setAttribute("role", "img");
    this.at = element("output");
    this.state = element("p", "", "faint");
    const part = (className, ...children) => {
      const it = element("div", undefined, className);
      it.append(...children);
      return it;
    };
    const line = part("line", this.marks, this.slider), moves = part("moves", this.play, this.back, this.forth, this.speed);
    const row = part("controls", moves, this.at, part("moves", this.kind, this.last, this.next), this.state);
    box.append(line, row);
    window.addEventListener("hashchange", () => this.follow());
    window.addEventListener("resize", () => { this.marked = ""; });
  }

  // Draws the events again, in the colours of now.
  recolour() {
    this.marked = "";
    if (this.playback) this.draw();
  }

  // Pauses at a moment.
  go(at_s) {
    this.send({ do: "pause" });
    this.send({ do: "seek", at_s });
  }

  toggle() {
    const { playing, at_s, from_s, of_s } = this.playback;
    if (playing) return this.send({ do: "pause" });
    if (at_s >= of_s) this.send({ do: "seek", at_s: from_s });
    this.send({ do: "play", speed: Number(this.speed.value) });
  }

  // Seeks to the position in the address.
  follow() {
    const at = requested(location.hash);
    if (at === null || !this.playback) return;
    this.go(at);
  }

  say(playback) {
    const first = !this.playback && playback;
    this.playback = playback;
    this.box.hidden = !playback;
    document.body.classList.toggle("recorded", Boolean(playback));
    if (!playback) return;
    document.getElementById("press-title").textContent = "Choose";
    if (first) this.follow();
    const act = playback.playing ? "Pause" : "Play";
    if (this.play.textContent !== act) this.play.textContent = this.play.title = act;
    this.play.setAttribute("aria-label", act);
    this.slider.min = String(playback.from_s);
    this.slider.max = String(playback.of_s);
    if (this.dragged === null) this.slider.value = String(playback.at_s);
    this.words();
    this.draw();
    const has = (playback.marks[this.kind.value] ?? []).length > 0;
    for (const it of [this.last, this.next]) it.disabled = !has;
  }

  words() {
    const { at_s, of_s, read, exact, failed, unfinished, others } = this.playback;
    this.at.textContent = `${clock(this.dragged ?? at_s)} of ${clock(of_s)}`;
    this.slider.setAttribute("aria-valuetext", this.at.textContent);
    this.state.className = failed ? "bad" : "faint";
    this.state.textContent = failed ?? (read < 1 ? `${Math.floor(read * 100)} % read${exact ? "" : "; counts cover the last seconds only"}`
      : unfinished ?? (others ? `the recording has ${others} frames on buses that the skin does not have` : ""));
  }

  // Draws the events, one row for each kind.
  draw() {
    const { marks, read } = this.playback, w = this.marks.clientWidth, state = `${w} ${read} ${JSON.stringify(marks)}`;
    if (state === this.marked || !w) return;
    this.marked = state;
    const kinds = Object.keys(KINDS), ratio = Math.min(2, window.devicePixelRatio || 1), h = 4 * kinds.length;
    [this.marks.width, this.marks.height] = [Math.round(w * ratio), h * ratio];
    const pen = this.marks.getContext("2d");
    pen.scale(ratio, ratio);
    pen.fillStyle = css("--line");
    pen.fillRect(0, 0, w * read, h);
    kinds.forEach((kind, row) => {
      pen.fillStyle = css(colourOf(kind));
      for (const part of marks[kind] ?? []) pen.fillRect(part / PARTS * w, row * 4, Math.max(1.5, w / PARTS), 3);
    });
    const said = kinds.filter((kind) => (marks[kind] ?? []).length).map((kind) => KINDS[kind].toLowerCase());
    this.marks.setAttribute("aria-label", said.length ? `Rows: ${said.join(", ")}` : "No events so far");
  }
}
