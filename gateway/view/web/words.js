// The tables of the page: facts, buses, silent cells, the chosen cell.

import { BUSES } from "./colours.js";
import { element, show, table } from "./dom.js";
import { forget, frames } from "./frames.js";
import { haltedWords } from "./halted.js";
import { busKey } from "./legend.js";
import { number } from "./scale.js";
import { countOf } from "./state.js";
import { clock, moment } from "./time.js";

// With more buses than this, one table has a row for each.
const FEW_BUSES = 3;
// A torque is one of now for this time in s.
const CURRENT_S = 1;
// Texts for statuses whose names in summaries are not used on the page.
const STATUSES = { "never heard": "no frame received" };
const $ = (id) => document.getElementById(id);

function facts(pairs) {
  show($("facts"), pairs.map(([name, value, className]) => {
    const pair = element("div");
    pair.append(element("dt", name), element("dd", value, className));
    return pair;
  }));
}

// A total, when it has grown last, and a class while that is not long ago.
function noted(health, names, text) {
  const { at, style } = health.lately(names);
  return [at === null ? text : `${text}, last at ${moment(at, 0)}`, style];
}

const percent = (share) => (share === null || share === undefined ? "–" : `${(share * 100).toFixed(share < 0.1 ? 1 : 0)} %`);

const ms = (value) => (value === null ? "–" : value.toFixed(value < 10 ? 2 : 1));

// The rows of a bus on which frames take time: its slowest reply beside the bound of `skinbus fit`, and its transmit queues.
function timed({ timed }) {
  if (!timed) return [];
  const rows = [], { queues } = timed;
  rows.push(["Slowest reply, ms", `${ms(timed.last_reply_ms)}, ${timed.bound_ms === null ? "no bound" : `bound ${ms(timed.bound_ms)}`}`]);
  if (queues) {
    rows.push(["Wait: p50, p99, ms", [queues.wait_us.p50, queues.wait_us.p99].map((us) => ms(us / 1000)).join(", ")]);
    rows.push(["Waiting now, refused", `${queues.waiting}, ${queues.refused}`, queues.refused ? "bad" : ""]);
  }
  return rows;
}

// One row for each bus.
function many(buses, health) {
  const it = element("table"), head = element("tr");
  for (const text of ["Bus", "Load", "Replies late, missing", "Packets lost, damaged"]) {
    const cell = element("th", text);
    cell.scope = "col";
    head.append(cell);
  }
  it.className = "buses";
  it.append(head, ...buses.map((bus, b) => {
    const row = element("tr"), name = element("th", bus.up ? bus.name : `${bus.name}: down`, bus.up ? "" : "bad");
    const pairs = [[["late", "missing"], [bus.late, bus.missing]], [["lost", "rejected"], [bus.lost, bus.rejected]]];
    name.scope = "row";
    row.append(name, element("td", percent(bus.load), bus.load > 1 ? "bad" : ""),
      ...pairs.map(([names, pair]) => element("td", ...noted(health, names.map((name) => `${b} ${name}`), pair.join(", ")))));
    return row;
  }));
  return it;
}

export function say(scene, said, ask, health, hardest) {
  const sum = (of) => said.buses.reduce((all, bus) => all + of(bus), 0);
  const [due, complete] = [sum((bus) => bus.epochs_due), sum((bus) => bus.epochs_complete)];
  const known = (count) => countOf(count, said.unheard, scene.cells.length);
  facts([
    ["Cells", String(scene.cells.length)],
    ["In contact", known(said.contacts)],
    ...(hardest ? [["Pressed hardest", hardest]] : []),
    ["Silent", known(said.dead), said.dead ? "bad" : ""],
    ["Epochs complete", ...(due ? noted(health, said.buses.map((_, b) => `${b} incomplete`), `${complete} of ${due}`) : ["–"])],
  ]);
  const halted = haltedWords(said, scene.may_press);
  document.body.classList.toggle("halted", halted !== "");
  if ($("halted").textContent !== halted) $("halted").textContent = halted;
  $("halted").hidden = !halted;
  const unread = sum((bus) => bus.dropped);
  show($("buses"), said.buses.length > FEW_BUSES ? [many(said.buses, health), ...(unread ? [element("p", `The page's server did not read ${unread} frames in time; they count as lost here.`, "faint")] : [])] : said.buses.flatMap((bus, b) => [
    element("h3", bus.up ? bus.name : `${bus.name}: down`, bus.up ? "" : "bad"),
    table([
      [bus.timed ? `Load at ${bus.timed.rates ?? "unknown rates"}` : "Load on a real bus", percent(bus.load), bus.load > 1 ? "bad" : ""],
      ...timed(bus),
      ["Replies in time", `${bus.in_time} of ${bus.due}`],
      ["Replies late, missing", ...noted(health, [`${b} late`, `${b} missing`], `${bus.late}, ${bus.missing}`)],
      ["Packets lost, damaged", ...noted(health, [`${b} lost`, `${b} rejected`], `${bus.lost}, ${bus.rejected}`)],
      ...(bus.dropped ? [["of these, missed by the page", ...noted(health, [`${b} dropped`], String(bus.dropped))]] : []),
      ["Saturated torques", ...noted(health, [`${b} saturated`], String(bus.saturated))],
      ["Mean error", bus.error_nm === null ? "–" : `${bus.error_nm.toExponential(1)} Nm`],
    ]),
  ]));
  show($("dead"), [said.dead_cells.length
    ? table(said.dead_cells.map((cell) => [`${cell.bus}:${cell.node}`, `for ${cell.for_s.toFixed(0)} s`, "bad"]))
    : element("p", "none", "faint")]);
  if (said.detail) detail(scene, said.detail, ask, health);
}

// The place of a cell in the skin: in the frame of its row.
function where(scene, { bus, node }, joints) {
  const cell = scene.cells.find((it) => it.bus === bus && it.node === node);
  if (!cell) return [];
  const three = (values, digits) => values.map((v) => v.toFixed(digits).replace("-", "−")).join(", ");
  return [
    ["Link", `moved by ${joints[cell.joint - 1]?.name ?? cell.joint}, DH row ${cell.row}`],
    ["Position, mm", three(cell.position.map((v) => v * 1000), 1)],
    ["Normal", three(cell.normal, 3)],
  ];
}

// A field of a sensors page, by the schema. The words of temperature sensors that a cell lacks are 0.
function reading({ name, unit, decimals, values }) {
  const title = name[0].toUpperCase() + name.slice(1), absent = unit === "°C" && values.every((v) => v === 0);
  return [unit ? `${title}, ${unit}` : title, absent ? "no sensor, or 0" : values.map((v) => v.toFixed(decimals).replace("-", "−")).join(", ")];
}

function detail(scene, it, ask, health) {
  const joints = scene.chains[scene.buses[it.bus].chain].rows.filter((row) => row.joint !== null).map((row) => scene.joints[row.joint]);
  const wrong = it.configuration[0] !== null && it.configuration[0] !== it.configuration[1];
  const dead = it.dead_at_s !== null && it.dead_at_s !== undefined, silent = dead || it.status === "never heard";
  const lost = `${it.bus}:${it.node} lost`;
  health.count(lost, it.lost);
  const values = [["Force", it.force_n === null ? "unknown" : `${it.force_n.toFixed(3)} N`], ...it.readings.map(reading)];
  const rows = [
    ["Status", dead ? `dead since ${moment(it.dead_at_s, 1)}` : STATUSES[it.status] ?? it.status, it.status === "dead" || it.status === "stale" ? "bad" : ""],
    ["Serial number", String(it.serial)],
    ...where(scene, it, joints),
    ["Configuration", wrong ? it.configuration.join(", expected ") : it.configuration[1], wrong ? "bad" : ""],
    ["Gains α: contact, proximity", it.gains.alpha.map(String).join(", ") + " N"],
    ["Thresholds: contact, proximity, force",
      it.gains.thresholds.map((value, at) => `${Number(value.toPrecision(3))}${[" N", "", " N"][at]}`).join(", ")],
    ...(silent ? [] : values),
    ["Replies in time", `${it.replies[1]} of ${it.replies[0]}`],
    ["Packets lost, restarts", ...noted(health, [lost], `${it.lost}, ${it.restarts}`)],
  ];
  const parts = [table(rows)];
  // Nothing of a cell that is silent stands as if it were so now.
  if (dead) parts.push(element("h3", `Last values, before ${moment(it.dead_at_s, 1)}`), table(values.map(([name, value]) => [name, value, "faint"])));
  if (it.torque) {
    const units = [...new Set(joints.map((joint) => joint.torque_unit))];
    const head = element("tr");
    head.append(...["Joint", "word", "cell", "central", "error", "J"].map((text, i) => element(i ? "td" : "th", text, "faint")));
    const torques = element("table");
    torques.append(head);
    it.torque.words.forEach((word, at) => {
      const row = element("tr"), joint = joints[at] || { name: String(at + 1), torque_unit: "" };
      const name = element("th", units.length > 1 ? `${joint.name}, ${joint.torque_unit}` : joint.name);
      name.scope = "row";
      row.append(name, element("td", String(word).replace("-", "−")), element("td", number(it.torque.distributed[at])),
        element("td", it.torque.central ? number(it.torque.central[at]) : "–"),
        element("td", it.torque.central ? number(it.torque.distributed[at] - it.torque.central[at]) : "–"),
        element("td", it.torque.jacobian ? number(it.torque.jacobian[at]) : "–"));
      torques.append(row);
    });
    const current = !dead && (it.torque.at_s === undefined || health.time - it.torque.at_s < CURRENT_S);
    torques.className = current ? "torques" : "torques faint";
    const when = current || it.torque.at_s === undefined ? "" : `, the last one, at ${clock(it.torque.at_s)}`;
    parts.push(element("h3", `Torque of epoch ${it.torque.epoch}${when}${units.length > 1 ? "" : `, ${units[0]}`}${it.torque.saturated ? ", saturated" : ""}`), torques);
  }
  show($("cell"), parts);
  frames(it.frames, it.why, ask);
}

export function chosen(name) {
  $("cell-title").textContent = name ? `Cell ${name}` : "No cell chosen";
  $("cell").replaceChildren();
  forget();
}

export function link({ word, text }) {
  if ($("link").textContent !== text) $("link").textContent = text;
  $("link").className = `is-${word}`;
}

// Tells readers who do not see the page what an action has done.
export function tell(text) {
  $("results").textContent = text;
}

// The colours of the buses; buses that share a colour are in one line.
export function buses(scene) {
  $("bus-colours").replaceChildren(...BUSES.slice(0, scene.buses.length).map((_, at) => {
    const same = scene.buses.filter((_, bus) => bus % BUSES.length === at).map((bus) => bus.name);
    const item = element("li");
    item.append(busKey(at), element("span", same.length > 2 ? `${same[0]}, ${same[1]} ... ${same[same.length - 1]}` : same.join(", ")));
    return item;
  }));
}
