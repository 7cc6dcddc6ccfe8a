// The run that this page belongs to: the process and the links of the chosen cell, the buses, and the lateness of the control loop.

import { element, show } from "./dom.js";

const $ = (id) => document.getElementById(id);

// The actions that are allowed on a process, by its phase.
const ACTIONS = { running: ["kill", "stop", "restart"], stopped: ["kill", "continue", "restart"], ended: ["restart"] };
const NAMES = ["kill", "stop", "continue", "restart"];
// The time that an answer is shown.
const SHOWN_MS = 10000;

export const allowed = (process) => (process ? ACTIONS[process.phase] : []);

// The process of a cell in a state. The state may still list that of the cell chosen before.
export function processOf(state, cell) {
  return state.processes.find(({ bus, nodes }) => cell && bus === cell.bus && nodes[0] <= cell.node && cell.node <= nodes[1]);
}

export function about(process) {
  if (!process) return "This run did not start the process of this cell.";
  const [first, last] = process.nodes;
  const what = first === last ? "The process of this cell" : `One process runs cells ${first} to ${last}; an action affects all of them. It`;
  return `${what} ${{ running: "is running", stopped: "is stopped", ended: "has ended" }[process.phase]}.`;
}

// The name of a cell in commands.
export const nameOf = (scene, { bus, node }) => `${scene.buses[bus].name}:${node}`;

export const isDown = (state, bus, one, other) =>
  state.links_down.some((link) => link.bus === bus && link.nodes[0] === Math.min(one, other) && link.nodes[1] === Math.max(one, other));

// Sets a text and a class, and touches nothing that is equal already.
function write(it, text, className = "") {
  if (it.textContent !== text) it.textContent = text;
  if (it.className !== className) it.className = className;
}

function button(text, onclick) {
  const it = element("button", text);
  it.type = "button";
  // The second click of a double click would undo the first one.
  it.onclick = (event) => { if (event.detail < 2) onclick(); };
  return it;
}

// A line with a button that takes something down, or up again.
class Switch {
  constructor(name, what, send) {
    this.what = what;
    this.state = element("td");
    this.button = button("", () => send(!this.down));
    this.row = element("tr");
    const head = element("th", name), last = element("td");
    head.scope = "row";
    last.append(this.button);
    this.row.append(head, this.state, last);
  }

  show(down, disabled) {
    this.down = down;
    write(this.state, down ? "down" : "up", down ? "bad" : "");
    write(this.button, down ? "Bring up" : "Take down");
    this.button.setAttribute("aria-label", `${down ? "Bring up" : "Take down"} ${this.what}`);
    this.button.disabled = disabled;
  }
}

export class Bench {
  constructor(send) {
    this.send = send;
    this.parts = [];
  }

  // Shows the state of the run; hides everything without one.
  say(scene, state, chosen) {
    if (this.scene !== scene) this.build(scene, state);
    for (const part of this.parts) part.hidden = !state;
    if (!state) return;
    this.sayCell(scene, state, scene.cells[chosen]);
    this.buses.forEach((it, bus) => it.show(state.buses[bus].down, !scene.may_press));
    this.sayLateness(state.lateness);
    const answers = state.answers.filter(({ number }) => number > this.answered);
    if (!answers.length) return;
    this.answered = answers[answers.length - 1].number;
    const text = answers.map(({ done, text }) => (done ? text : `Refused: ${text}`)).join("; ");
    write(this.answer, text, answers.every(({ done }) => done) ? "" : "bad");
    clearTimeout(this.clear);
    this.clear = setTimeout(() => { this.answer.textContent = ""; }, SHOWN_MS);
  }

  build(scene, state) {
    for (const part of this.parts) part.remove();
    this.scene = scene;
    this.cell = undefined;
    this.answered = Math.max(0, ...(state?.answers ?? []).map(({ number }) => number));
    this.answer = element("p");
    this.answer.id = "answer";
    this.answer.setAttribute("role", "status");
    $("link").after(this.answer);

    this.ofCell = element("div");
    this.process = element("p", undefined, "faint");
    this.actions = NAMES.map((action) => button(action[0].toUpperCase() + action.slice(1), () => {
      this.send({ do: action, cell: nameOf(this.scene, this.cell) });
    }));
    const row = element("div", undefined, "row actions");
    row.append(...this.actions);
    this.links = element("div");
    this.ofCell.append(element("h3", "Process"), this.process, row, this.links);
    // Above what grows and shrinks, so that its buttons stand still.
    $("cell").before(this.ofCell);

    this.buses = scene.buses.map(({ name }) => new Switch(name, `bus ${name}`, (down) => this.send({ do: "bus", bus: name, down })));
    const buses = element("table", undefined, "switches");
    buses.append(...this.buses.map((it) => it.row));
    $("buses").after(buses);

    const loop = element("section"), title = element("h2", "Control loop");
    title.id = "loop-title";
    loop.setAttribute("aria-labelledby", "loop-title");
    this.lateness = element("table");
    loop.append(title, this.lateness);
    $("buses").closest("section").before(loop);
    this.parts = [this.answer, this.ofCell, buses, loop];
  }

  sayCell(scene, state, cell) {
    this.ofCell.hidden = !cell;
    if (cell !== this.cell) {
      this.cell = cell;
      const wired = cell && state.buses[cell.bus].links ? cell.neighbors : [];
      this.neighbors = wired.map((other) => [other, new Switch(`to cell ${other}`, `the link between cells ${cell.node} and ${other}`,
        (down) => this.send({ do: "link", cells: [cell, { bus: cell.bus, node: other }].map((it) => nameOf(scene, it)), down }))]);
      const table = element("table", undefined, "switches");
      table.append(...this.neighbors.map(([, it]) => it.row));
      this.links.replaceChildren(...(wired.length ? [element("h3", "Links"), table] : []));
    }
    if (!cell) return;
    const process = processOf(state, cell);
    write(this.process, about(process), "faint");
    const focused = document.activeElement;
    this.actions.forEach((it, at) => { it.disabled = !scene.may_press || !allowed(process).includes(NAMES[at]); });
    // Keeps the focus on an enabled button.
    if (focused.disabled && this.actions.includes(focused)) this.actions.find((it) => !it.disabled)?.focus();
    for (const [other, it] of this.neighbors) it.show(isDown(state, cell.bus, cell.node, other), !scene.may_press);
  }

  sayLateness({ second, all, skipped }) {
    const line = (...cells) => {
      const row = element("tr"), [name, ...values] = cells.map((text, at) => element(at ? "td" : "th", text));
      name.scope = "row";
      row.append(name, ...values);
      return row;
    };
    const head = element("tr");
    head.append(...["Tick lateness, µs", "p50", "p99", "max"].map((text, at) => element(at ? "td" : "th", text, "faint")));
    const of = ({ p50, p99, max }) => [p50, p99, max].map((us) => us.toFixed(0));
    show(this.lateness, [head, line("last second", ...of(second)), line("since the start", ...of(all)),
      line("ticks skipped", "", "", String(skipped))]);
  }
}
