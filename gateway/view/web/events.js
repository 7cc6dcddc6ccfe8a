// The events of a bench: those that this page sees while it is live, and their labels.

import { isBack } from "./curves.js";
import { DEAD } from "./snapshot.js";

// The kinds, the most important first. Of many events the labels of these are shown first.
export const KINDS = { halt: "Halt", command: "Command", bus: "Bus", silence: "Silent cell", touch: "Touch", loss: "Loss" };
const RANKS = Object.keys(KINDS);
// The name of the colour of a kind.
const COLOURS = { touch: "--distributed", loss: "--central", bus: "--ink", command: "--ink" };
export const colourOf = (kind) => COLOURS[kind] ?? "--alarm";
export const rankOf = (kind) => RANKS.indexOf(kind);
// Losses that follow each other within this time in s are one event.
const ONE_LOSS_S = 1;
const MOST_EVENTS = 2000;

export class EventLog {
  constructor() {
    this.clear();
  }

  clear() {
    Object.assign(this, { events: [], touched: null, dead: null, buses: null, halted: false, answered: -1, time: -Infinity, lost: -Infinity });
  }

  add(at_s, kind, more = {}) {
    this.events.push({ at_s, kind, bus: null, node: null, text: null, ...more });
    if (this.events.length > MOST_EVENTS) this.events.shift();
  }

  // Takes in the cells of a snapshot. The first one shows what has been before.
  see(scene, { time, cells }) {
    if (isBack(time, this.time)) this.clear();
    time = Math.max(time, this.time);
    this.time = time;
    const first = !this.touched;
    if (first) [this.touched, this.dead] = [new Uint8Array(scene.cells.length), new Uint8Array(scene.cells.length)];
    scene.cells.forEach(({ bus, node }, i) => {
      const word = cells[2 * i], dead = Number((word & 255) === DEAD), touched = Number(!dead && word >>> 16 > 0);
      if (!first && touched && !this.touched[i]) this.add(time, "touch", { bus, node });
      if (!first && dead && !this.dead[i]) this.add(time, "silence", { bus, node });
      [this.touched[i], this.dead[i]] = [touched, dead];
    });
  }

  // Takes in a status message, the reason of a halt, and how many frames were lost since the last message.
  hear({ halted, buses, bench }, why, lost) {
    const time = this.time, before = this.buses, answers = bench?.answers ?? [];
    // A run whose bus is down knows of a halt before any frame shows it.
    halted ||= Boolean(bench?.halted);
    if (before) {
      if (halted && !this.halted) this.add(time, "halt", { text: why });
      buses.forEach(({ up }, bus) => { if (up !== before[bus]) this.add(time, "bus", { bus, text: up ? "works again" : "lost" }); });
      for (const { number, done, text } of answers) if (done && number > this.answered) this.add(time, "command", { text });
      if (lost && time > this.lost + ONE_LOSS_S) this.add(time, "loss");
      if (lost) this.lost = time;
    }
    [this.halted, this.buses] = [halted, buses.map(({ up }) => up)];
    this.answered = Math.max(this.answered, ...answers.map(({ number }) => number), 0);
  }
}

const cellName = (scene, { bus, node }) => (scene.buses.length > 1 ? `${scene.buses[bus].name}:${node}` : String(node));
const busName = (scene, bus) => scene.buses[bus]?.name ?? "a bus";

// The label of events of one kind: short, and in full for a reader who asks.
export function labelOf(scene, { kind, events }) {
  const [{ bus, node, text }] = events, many = events.length > 1;
  const cell = node !== null && cellName(scene, events[0]);
  switch (kind) {
    case "touch": return many ? [`Touch × ${events.length}`, `${events.length} touches, the first of cell ${cell}`] : [`Touch ${cell}`, `Touch of cell ${cell}`];
    case "silence": return many ? [`Silent × ${events.length}`, `${events.length} cells fell silent, the first cell ${cell}`] : [`Silent ${cell}`, `Cell ${cell} fell silent`];
    case "halt": return ["Halt", text ? `Halt: ${text}` : "Halt"];
    case "bus": return many ? [`Buses × ${events.length}`, `${events.length} changes of buses`] : [`${busName(scene, bus)} ${text}`, `Bus ${busName(scene, bus)} ${text}`];
    case "command": {
      const said = text.replace(scene.buses.length > 1 ? "" : ` on ${busName(scene, 0)}`, ""), word = said[0].toUpperCase() + said.slice(1);
      return many ? [`${word} + ${events.length - 1}`, events.map((it) => it.text).join("; ")] : [word, word];
    }
    default: return many ? [`Loss × ${events.length}`, `${events.length} times lost or late`] : ["Loss", "Replies or packets were lost or late"];
  }
}
