// The plots: torques, forces, loads and lateness over one axis of time, with the events above.

import { css } from "./colours.js";
import { Recent, Recorded, decodeCurves, isBack, points } from "./curves.js";
import { button, element } from "./dom.js";
import { EventLog } from "./events.js";
import { LEFT, Lane, RIGHT, sized } from "./lane.js";
import { followed, secondDigits, ticks, within, zoomed } from "./scale.js";
import { DEAD } from "./snapshot.js";
import { Strip } from "./strip.js";
import { moment } from "./time.js";

// The time that is shown at first in s, and the memory for newest values: moments, and bytes for forces.
const [SPAN_S, LONGEST_WHOLE_S, MOMENTS, FORCE_BYTES] = [10, 30, 18000, 16 << 20];
// A force in a snapshot that stands for no value, as of a dead cell.
const NO_FORCE = 65535;
// Torques below this part of the largest are drawn, but a joint without a larger one is folded; and never those below this one.
const [LOADED_SHARE, LOADED] = [0.01, 0.002];
const ZOOM = 1.5;
// Who wants less motion sees a new picture this often.
const CALM_MS = 1000;

export class Plots {
  // `on.seek(at)` goes to a moment of a recording; `on.redraw()` asks for a drawing.
  constructor(box, scene, on) {
    Object.assign(this, { box, scene, on, span: SPAN_S, view: null, cursor: null, playback: null, now: 0, chosen: -1, health: null, log: new EventLog(), loaded: new Set(), down: new Set(), hover: null, dirty: true, asked: false, drawnAt: -Infinity, drawn: "" });
    const joints = scene.joints.length, cells = scene.cells.length;
    this.torques = new Recent(2 * joints, MOMENTS);
    this.forces = new Recent(cells, Math.max(300, Math.min(MOMENTS, Math.floor(FORCE_BYTES / 2 / Math.max(1, cells)))), Uint16Array, 1e-3);
    this.loads = new Recent(scene.buses.length, MOMENTS / 6);
    this.replies = new Recent(scene.buses.length, MOMENTS / 6);
    this.bounds = [];
    this.lateness = new Recent(2, MOMENTS / 6);
    this.recorded = new Recorded((path) => fetch(`${path}&${location.search.slice(1)}`), () => { this.dirty = true; on.redraw(); });
    this.build();
  }

  build() {
    this.what = element("select");
    this.what.id = "plotted";
    const label = element("label", "Plot");
    label.htmlFor = "plotted";
    this.options = ["torque", "difference", "force", "load", "replies", "lateness"].map((value) => {
      const it = element("option", { torque: "torque", difference: "torque: cells − central", force: "force of the chosen cell", load: "load of the buses", replies: "slowest reply on timed buses", lateness: "lateness of the loop" }[value]);
      it.value = value;
      return it;
    });
    this.what.append(...this.options);
    this.what.onchange = () => { this.loaded.clear(); this.lanes(); this.refresh(); };
    this.keys = element("span", undefined, "keys-of-curves");
    this.shown = element("output", "");
    const tools = element("div", undefined, "tools");
    this.follow = button("Follow", "Follow the time", () => { this.view = null; this.refresh(); });
    this.less = button("−", "Show more time", () => this.zoom(1 / ZOOM));
    this.more = button("+", "Show less time", () => this.zoom(ZOOM));
    tools.append(label, this.what, this.keys, this.shown, this.less, this.more, this.follow);
    this.strip = new Strip((at) => this.go(at), () => this.refresh());
    this.rows = element("div", undefined, "lanes");
    this.fold = element("details", undefined, "fold");
    this.folded = element("summary", "");
    this.foldRows = element("div");
    this.fold.append(this.folded, this.foldRows);
    this.fold.ontoggle = () => this.refresh();
    this.axis = element("canvas", undefined, "axis");
    this.axis.setAttribute("aria-hidden", "true");
    this.box.replaceChildren(tools, this.strip.box, this.rows, this.axis);
    this.listen(this.axis);
    this.lanes();
  }

  // Makes the lanes of what is plotted.
  lanes() {
    const { scene } = this, joint = ({ name }, at) => (name === `joint${at + 1}` ? `Joint ${at + 1}` : `${at + 1} ${name}`);
    const kinds = {
      torque: () => scene.joints.map((it, at) => ({ name: joint(it, at), unit: it.torque_unit, curves: [["central", "central"], ["cells", "distributed"]], joint: at })),
      difference: () => scene.joints.map((it, at) => ({ name: joint(it, at), unit: it.torque_unit, curves: [["cells − central", "distributed"]], joint: at })),
      force: () => [{ name: this.chosen < 0 ? "No cell chosen" : `Cell ${scene.buses[scene.cells[this.chosen].bus].name}:${scene.cells[this.chosen].node}`, unit: "N", curves: [["force", "distributed"]] }],
      load: () => scene.buses.map(({ name }, at) => ({ name, unit: "%", curves: [["load", "distributed"]], bus: at })),
      replies: () => scene.buses.flatMap(({ name }, at) => (this.bounds[at] === undefined ? [] : [{ name, unit: "ms", curves: [["bound", "central", true], ["slowest reply", "distributed"]], bus: at }])),
      lateness: () => [{ name: "Latest tick of a second", unit: "µs", curves: [["latest", "central"]] }],
    };
    this.all = kinds[this.what.value]().map((of) => new Lane(of, this));
    for (const lane of this.all) this.listen(lane.canvas, lane);
    const torque = this.what.value === "torque";
    this.keys.replaceChildren(...(torque ? [["distributed", "cells"], ["central", "central"]] : []).map(([className, text]) => {
      const it = element("span");
      it.append(element("span", undefined, `key ${className}`), text);
      return it;
    }));
    this.rows.replaceChildren(...this.all.map((lane) => lane.row), this.fold);
    this.drawn = "";
  }

  choose(chosen) {
    this.chosen = chosen;
    if (this.what.value === "force") this.lanes();
    this.refresh();
  }

  // Asks for a drawing, because the user has done something.
  refresh() {
    this.dirty = this.asked = true;
    this.on.redraw();
  }

  push(snapshot) {
    const { time, joints, cells } = snapshot;
    this.now = isBack(time, this.now) ? time : Math.max(time, this.now);
    // The last torques of a joint whose buses are down are none of now. Halted cells send none.
    this.torques.add(time, joints.flatMap(({ distributed, central }, at) => (this.down.has(at) ? [NaN, NaN] : [this.halted ? NaN : distributed, central])));
    const forces = new Uint16Array(this.scene.cells.length);
    for (let i = 0; i < forces.length; i++) forces[i] = (cells[2 * i] & 255) === DEAD ? NO_FORCE : Math.min(NO_FORCE - 1, cells[2 * i] >>> 16);
    this.forces.add(time, forces);
    this.log.see(this.scene, snapshot);
  }

  // Takes in a status message, the reason of a halt, and the number of losses since the last one.
  say(said, why, lost) {
    const before = this.playback;
    [this.playback, this.halted] = [said.playback, said.halted];
    if (!this.playback) this.log.hear(said, why, lost);
    if (before?.jumped !== this.playback?.jumped) this.recorded.clear();
    this.loads.add(this.now, said.buses.map(({ load }) => (load ?? NaN) * 100));
    const second = said.bench?.lateness.second;
    this.lateness.add(this.now, second ? [second.max, second.p99] : [NaN, NaN]);
    this.replies.add(this.now, said.buses.map(({ timed }) => timed?.last_reply_ms ?? NaN));
    const bounds = said.buses.map(({ timed }) => timed?.bound_ms), are = String(bounds) !== String(this.bounds);
    this.bounds = bounds;
    if (are && this.what.value === "replies") this.lanes();
    for (const [value, is] of [["lateness", second || this.playback], ["replies", said.buses.some(({ timed }) => timed)]]) this.options.find((it) => it.value === value).disabled = !is;
    const jointsOf = (is) => said.buses.flatMap(({ up }, bus) => (up === is ? this.scene.chains[this.scene.buses[bus].chain].rows.map(({ joint }) => joint) : []));
    const up = new Set(jointsOf(true));
    this.down = new Set(jointsOf(false).filter((joint) => !up.has(joint)));
    this.dirty = true;
  }

  // The torques before a position of a recording, of which the server has no curves yet.
  replace(history) {
    this.torques.clear();
    for (const { time, joints } of history) this.torques.add(time, joints.flatMap(({ distributed, central }) => [distributed, central]));
  }

  limits() {
    return this.playback ? [this.playback.from_s, Math.max(this.playback.of_s, this.playback.from_s + 0.1)] : undefined;
  }

  // The time that is shown.
  shownTime() {
    const limits = this.limits();
    if (this.view) return this.view;
    if (limits && this.span === SPAN_S && limits[1] - limits[0] <= LONGEST_WHOLE_S) return { from: limits[0], to: limits[1] };
    return followed(this.playback ? this.playback.at_s : this.now, this.span, limits);
  }

  zoom(factor, at) {
    const shown = this.shownTime(), limits = this.limits() ?? [-Infinity, this.now];
    const follows = !this.view && at === undefined, anchor = at ?? (this.playback ? this.playback.at_s : shown.to);
    const view = zoomed(shown, factor, anchor, limits);
    this.span = view.to - view.from;
    // A zoom by the buttons or at the end of a live plot goes on following.
    this.view = follows || !this.playback && !this.view && at > shown.to - 0.1 * (shown.to - shown.from) ? null : view;
    this.refresh();
  }

  pan(seconds) {
    const { from, to } = this.shownTime();
    this.view = within({ from: from + seconds, to: to + seconds }, this.limits() ?? [-Infinity, this.now]);
    this.span = to - from;
    this.refresh();
  }

  // Goes to a moment: in a recording by its position, else by what is shown.
  go(at) {
    if (this.playback) return this.on.seek(at);
    const { from, to } = this.shownTime();
    this.view = { from: at - (to - from) / 2, to: at + (to - from) / 2 };
    this.cursor = at;
    this.refresh();
  }

  // The points of a curve of a lane; a recording's come from the server, as far as it has read.
  points(lane, curve, { from, to }, count) {
    const what = this.what.value, { playback } = this;
    if (what === "replies" && curve === 0) {
      const bound = this.bounds[lane.bus] ?? null;
      return bound === null ? [] : [from, bound, bound, to, bound, bound];
    }
    const read = playback ? playback.from_s + playback.read * (playback.of_s - playback.from_s) : -Infinity;
    if (playback && (playback.read >= 1 || this.now < read)) {
      const cell = what === "force" && this.chosen >= 0 ? this.scene.cells[this.chosen] : null;
      if (what === "force" && !cell) return [];
      const of = { torque: "torques", difference: "torques", load: "loads", force: `force&cell=${cell && this.scene.buses[cell.bus].name}:${cell?.node}` }[what] ?? what;
      const fresh = playback.read < 1 ? Math.floor(playback.read * 50) : 1;
      const answer = this.recorded.part(`/curves?of=${of}`, from, to, count, fresh, async (response) => decodeCurves(await response.arrayBuffer()));
      if (!answer) return [];
      const quantity = what === "torque" ? 3 * lane.joint + (curve === 0 ? 1 : 0) : what === "difference" ? 3 * lane.joint + 2 : lane.bus ?? 0;
      // Where the cells' torque is known, and this one is not, the curve has a gap.
      const all = points(answer, quantity, what === "torque" || what === "difference" ? 3 * lane.joint : quantity);
      return what === "load" ? all.map((v, k) => (k % 3 ? v * 100 : v)) : all;
    }
    if (what === "torque") return this.torques.curve(2 * lane.joint + (curve === 0 ? 1 : 0), from, to, count);
    if (what === "difference") {
      const [cells, central] = [0, 1].map((k) => this.torques.curve(2 * lane.joint + k, from, to, Infinity));
      return cells.map((v, k) => (k % 3 ? v - central[k] : v));
    }
    if (what === "force") return this.chosen < 0 ? [] : this.forces.curve(this.chosen, from, to, count, NO_FORCE);
    if (what === "replies") return this.replies.curve(lane.bus, from, to, count);
    return what === "load" ? this.loads.curve(lane.bus, from, to, count) : this.lateness.curve(0, from, to, count);
  }

  // Draws if anything has changed.
  draw() {
    if (!this.dirty || this.strip.held) return;
    const width = this.rows.clientWidth, shown = this.shownTime(), now = performance.now();
    if (!width || !(shown.to > shown.from)) return;
    if (!this.asked && now < this.drawnAt + CALM_MS && matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    [this.dirty, this.asked, this.drawnAt] = [false, false, now];
    // The cursor stays under a pointer that stands still.
    if (this.hover !== null) this.cursor = shown.from + this.hover * (shown.to - shown.from);
    const inside = Math.max(10, width - LEFT - RIGHT), count = Math.round(inside / 1.5);
    const at = this.playback ? this.playback.at_s : null;
    const view = { ...shown, at, cursor: this.cursor, x: (t) => LEFT + (t - shown.from) / (shown.to - shown.from) * inside, inside, width };
    view.theme = Object.fromEntries(["line", "faint", "ink", "distributed", "central", "alarm", "panel", "chosen"].map((name) => [name, css(`--${name}`)]));
    const curves = this.all.map((lane) => lane.curves.map((_, k) => this.points(lane, k, shown, count)));
    view.events = this.events(shown);
    this.sort(curves);
    this.all.forEach((lane, k) => { if (lane.row.isConnected && lane.row.offsetParent) lane.draw(view, curves[k]); });
    this.strip.draw(this.scene, view);
    this.drawAxis(view);
    const span = shown.to - shown.from;
    this.shown.textContent = span >= 120 ? `${(span / 60).toFixed(0)} min` : `${span.toFixed(span < 1 ? 2 : span < 10 ? 1 : 0)} s`;
    this.follow.disabled = !this.view;
  }

  events({ from, to }) {
    if (!this.playback) return this.log.events;
    const fresh = `${this.playback.events} ${this.playback.read >= 1}`;
    return this.recorded.part("/events", from, to, 64, fresh, (response) => response.json()) ?? [];
  }

  // Shows the lanes of loaded joints first, and folds the others. A joint stays loaded while it is shown.
  sort(curves) {
    const largest = curves.map((all) => all.reduce((most, of) => of.reduce((m, v, k) => (k % 3 && Math.abs(v) > m ? Math.abs(v) : m), most), 0));
    const joints = this.all.length && this.all[0].joint !== undefined;
    const limit = Math.max(LOADED, LOADED_SHARE * Math.max(...largest)) * (this.what.value === "difference" ? 0 : 1);
    largest.forEach((value, k) => { if (!joints || this.what.value === "difference" ? value > 0 || !joints : value >= limit) this.loaded.add(k); });
    if (this.rows.matches(":hover") || this.rows.contains(document.activeElement)) return;
    const order = [...this.loaded].sort((a, b) => a - b).join();
    if (order === this.drawn && this.rows.childElementCount) return;
    this.drawn = order;
    const [some, rest] = [true, false].map((is) => this.all.filter((_, k) => this.loaded.has(k) === is).map((lane) => lane.row));
    this.rows.replaceChildren(...some, ...(rest.length ? [this.fold] : []));
    this.foldRows.replaceChildren(...rest);
    this.folded.textContent = `${rest.length === 1 ? "1 joint" : `${rest.length} joints`} without torque`;
  }

  drawAxis(view) {
    // Beside a scrollbar the lanes are narrower.
    this.axis.style.width = `${view.width}px`;
    const { pen, h } = sized(this.axis, view.width);
    const { step, all } = ticks(view.from, view.to, Math.max(2, Math.floor(view.inside / 90)));
    pen.fillStyle = view.theme.faint;
    pen.strokeStyle = view.theme.faint;
    pen.font = "12px system-ui, \"DejaVu Sans\", sans-serif";
    pen.textAlign = "center";
    for (const t of all) {
      const x = view.x(t), text = moment(t, secondDigits(step)), half = pen.measureText(text).width / 2;
      pen.fillRect(Math.round(x), 0, 1, 4);
      pen.fillText(text, Math.max(half + 1, Math.min(view.width - half - 1, x)), h - 4);
    }
  }

  // The pointer on a lane or the axis: its place is the cursor; a drag pans, the wheel and two fingers zoom, a click goes there.
  listen(canvas, lane) {
    const pointers = new Map();
    let travelled = 0, apart = 0;
    const share = (x) => (x - canvas.getBoundingClientRect().left - LEFT) / Math.max(10, canvas.clientWidth - LEFT - RIGHT);
    const time = (x) => { const { from, to } = this.shownTime(); return from + share(x) * (to - from); };
    const perPixel = () => { const { from, to } = this.shownTime(); return (to - from) / Math.max(10, canvas.clientWidth - LEFT - RIGHT); };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event.clientX);
      travelled = pointers.size > 1 ? 99 : 0;
      apart = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      this.hover = Math.min(1, Math.max(0, share(event.clientX)));
      if (before !== undefined) {
        pointers.set(event.pointerId, event.clientX);
        travelled += Math.abs(event.clientX - before);
        if (pointers.size === 2) {
          const [a, b] = [...pointers.values()], far = Math.max(20, Math.abs(a - b));
          if (apart) this.zoom(far / apart, time((a + b) / 2));
          apart = far;
        } else if (travelled > 4) {
          this.pan((before - event.clientX) * perPixel());
        }
      }
      this.refresh();
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => {
        if (name === "pointerup" && pointers.size === 1 && travelled <= 4) {
          if (this.playback) this.on.seek(time(event.clientX));
        }
        pointers.delete(event.pointerId);
        apart = 0;
      });
    }
    // The whole of a recording, or the present of a bench.
    canvas.addEventListener("dblclick", () => {
      const limits = this.limits();
      this.view = limits ? { from: limits[0], to: limits[1] } : null;
      this.refresh();
    });
    canvas.addEventListener("pointerleave", () => { this.hover = null; if (document.activeElement !== canvas) this.cursor = null; this.refresh(); });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const turn = event.deltaMode ? 20 : 1;
      if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) this.pan((event.deltaX || event.deltaY) * turn * perPixel());
      else this.zoom(Math.exp(-event.deltaY * turn * 0.002), time(event.clientX));
    }, { passive: false });
    if (lane) this.listenKeys(canvas, lane);
  }

  listenKeys(canvas, lane) {
    canvas.addEventListener("focus", () => { this.cursor ??= this.playback ? this.playback.at_s : this.shownTime().to; this.refresh(); });
    canvas.addEventListener("blur", () => { this.cursor = null; this.refresh(); });
    canvas.addEventListener("keydown", (event) => {
      const { from, to } = this.shownTime(), step = (to - from) / (event.shiftKey ? 10 : 100);
      this.hover = null;
      const move = { ArrowLeft: -step, ArrowRight: step, PageUp: -step * 10, PageDown: step * 10 }[event.key];
      if (move) this.cursor = (this.cursor ?? to) + move;
      else if (event.key === "Home") this.cursor = from;
      else if (event.key === "End") this.cursor = to;
      else if (event.key === "+" || event.key === "=") this.zoom(ZOOM, this.cursor ?? undefined);
      else if (event.key === "-") this.zoom(1 / ZOOM, this.cursor ?? undefined);
      else if (event.key === "Enter" && this.playback) this.on.seek(this.cursor);
      else if (event.key === "Escape") this.cursor = null;
      else return;
      event.preventDefault();
      const [first, last] = this.limits() ?? [-Infinity, this.now];
      if (this.cursor !== null) this.cursor = Math.min(last, Math.max(first, this.cursor));
      // What is shown moves with the cursor, and stands still in a live view.
      if (this.cursor !== null && (this.cursor < from || this.cursor > to)) this.pan(this.cursor < from ? this.cursor - from : this.cursor - to);
      else if (!this.playback && move) this.view = { from, to };
      this.refresh();
      lane.say();
    });
  }
}
