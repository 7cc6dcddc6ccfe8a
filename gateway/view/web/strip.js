// The events above the plots: labels that do not overlap, and marks for those without room. A click goes there.

import { element } from "./dom.js";
import { colourOf, labelOf, rankOf } from "./events.js";
import { groups, rowsOf } from "./scale.js";
import { clock } from "./time.js";

// Labels are this far apart in pixels, and this high.
const [GAP, ROW, ROWS] = [4, 24, 2];
// Events of one kind that are nearer to each other than this share a label.
const TOGETHER = 44;
const MOST_LABELS = 80;

export class Strip {
  constructor(go, redraw) {
    this.go = go;
    this.box = element("div", undefined, "strip");
    this.box.setAttribute("role", "group");
    this.box.setAttribute("aria-label", "Events");
    this.none = element("span", "no events", "faint");
    this.box.append(this.none);
    this.buttons = new Map();
    this.widths = new Map();
    // A label has to be under the pointer until it is released, and labels move with time.
    this.box.onpointerdown = () => { this.held = true; };
    for (const end of ["pointerup", "pointercancel"]) window.addEventListener(end, () => { if (this.held) setTimeout(() => { this.held = false; redraw(); }); });
  }

  width(text) {
    if (!this.pen) {
      this.pen = element("canvas").getContext("2d");
      this.pen.font = "13px system-ui, \"DejaVu Sans\", sans-serif";
    }
    if (!this.widths.has(text)) this.widths.set(text, Math.ceil(this.pen.measureText(text).width) + 18);
    return this.widths.get(text);
  }

  draw(scene, view) {
    const events = view.events.filter(({ at_s }) => at_s >= view.from && at_s <= view.to).sort((a, b) => a.at_s - b.at_s);
    const all = groups(events, view.inside / (view.to - view.from), TOGETHER).sort((a, b) => rankOf(a.kind) - rankOf(b.kind) || a.at - b.at).slice(0, MOST_LABELS);
    const labels = all.map((group) => {
      const [text, full] = labelOf(scene, group), w = this.width(text), at = view.x(group.at);
      // To the right of its moment, or to the left.
      return { group, text, full, w, at, places: [at, at - w] };
    });
    const rows = rowsOf(labels, view.width, ROWS, GAP), seen = new Set();
    labels.forEach(({ group, text, full, at, places }, k) => {
      const key = `${group.kind} ${group.at}`, { row, x } = rows[k], it = this.buttons.get(key) ?? this.button(key, group);
      seen.add(key);
      const said = row < 0 ? "" : text, name = `${full}, at ${clock(group.at)}`;
      if (it.textContent !== said) it.textContent = said;
      if (it.title !== name) it.title = name;
      // A label names itself.
      if (row < 0) it.setAttribute("aria-label", name);
      else it.removeAttribute("aria-label");
      it.className = row < 0 ? "bare" : x < places[0] ? "before" : "";
      it.style.transform = row < 0 ? `translate(${Math.round(at - 3)}px, ${ROW * ROWS}px)` : `translate(${Math.round(x)}px, ${ROW * row}px)`;
    });
    for (const [key, it] of this.buttons) if (!seen.has(key)) { it.remove(); this.buttons.delete(key); }
    this.none.hidden = labels.length > 0;
  }

  button(key, { kind, at }) {
    const it = element("button");
    it.type = "button";
    it.style.setProperty("--of", `var(${colourOf(kind)})`);
    it.onclick = () => this.go(at);
    this.buttons.set(key, it);
    this.box.append(it);
    return it;
  }
}
