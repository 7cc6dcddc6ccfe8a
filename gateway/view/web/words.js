// The tables of the page: facts, buses, silent cells, the chosen cell.

import { BUSES } from "./colours.js";
import { element, show, table } from "./dom.js";
import { forget, frames } from "./frames.js";
import { haltedWords } from "./halted.js";
import { busKey } from "./legend.js";
import { number } from "./plots.js";

// With more buses than this, one table has a row for each.
const FEW_BUSES = 3;
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

const percent = (share) => (share === null || share === undefined ? "–" : `${(share * 100).toFixed(share < 0.1 ? 1 : 0)} %`);

// One row for each bus.
function many(buses) {
  const it = element("table"), head = element("tr");
  for (const text of ["Bus", "Load", "Replies late, missing", "Packets lost, damaged"]) {
    const cell = element("th", text);
    cell.scope = "col";
    head.append(cell);
  }
  it.className = "buses";
  it.append(head, ...buses.map((bus) => {
    const row = element("tr"), name = element("th", bus.up ? bus.name : `${bus.name}: down`, bus.up ? "" : "bad");
    const [late, lost] = [[bus.late, bus.missing], [bus.lost + bus.dropped, bus.rejected]];
    name.scope = "row";
    row.append(name, element("td", percent(bus.load), bus.load > 1 ? "bad" : ""),
      ...[late, lost].map((pair) => element("td", pair.join(", "), pair.some((n) => n) ? "bad" : "")));
    return row;
  }));
  return it;
}

export function say(scene, said, ask) {
  const sum = (of) => said.buses.reduce((all, bus) => all + of(bus), 0);
  const [due, complete] = [sum((bus) => bus.epochs_due), sum((bus) => bus.epochs_complete)];
  facts([
    ["Cells", String(scene.cells.length)],
    ["In contact", String(said.contacts)],
    ["Silent", String(said.dead), said.dead ? "bad" : ""],
    ["Epochs complete", due ? `${complete} of ${due}` : "–", complete < due ? "bad" : ""],
    ...(said.halted ? [["Robot", "halted", "bad"]] : []),
  ]);
  const halted = haltedWords(said, scene.may_press);
  document.body.classList.toggle("halted", halted !== "");
  if ($("halted").textContent !== halted) $("halted").textContent = halted;
  $("halted").hidden = !halted;
  show($("buses"), said.buses.length > FEW_BUSES ? [many(said.buses)] : said.buses.flatMap((bus) => [
    element("h3", bus.up ? bus.name : `${bus.name}: down`, bus.up ? "" : "bad"),
    table([
      ["Load on a real bus", percent(bus.load), bus.load > 1 ? "bad" : ""],
      ["Replies in time", `${bus.in_time} of ${bus.due}`],
      ["Replies late, missing", `${bus.late}, ${bus.missing}`, bus.late + bus.missing ? "bad" : ""],
      ["Packets lost, damaged", `${bus.lost}, ${bus.rejected}`, bus.lost + bus.rejected ? "bad" : ""],
      ["Saturated torques", String(bus.saturated), bus.saturated ? "bad" : ""],
      ["Mean error", bus.error_nm === null ? "–" : `${bus.error_nm.toExponential(1)} Nm`],
      ...(bus.dropped ? [["Frames not read in time", String(bus.dropped), "bad"]] : []),
    ]),
  ]));
  show($("dead"), [said.dead_cells.length
    ? table(said.dead_cells.map((cell) => [`${cell.bus}:${cell.node}`, `${cell.for_s.toFixed(0)} s`, "bad"]))
    : element("p", "none", "faint")]);
  if (said.detail) detail(scene, said.detail, ask);
}

// The place of a cell in the skin: in the frame of its row.
function where(scene, { bus, node }) {
  const cell = scene.cells.find((it) => it.bus === bus && it.node === node);
  if (!cell) return [];
  const three = (values, digits) => values.map((v) => v.toFixed(digits).replace("-", "−")).join(", ");
  return [
    ["DH row, joint", `${cell.row}, ${cell.joint}`],
    ["Position, mm", three(cell.position.map((v) => v * 1000), 1)],
    ["Normal", three(cell.normal, 3)],
  ];
}

// A field of a sensors page, by the schema.
function reading({ name, unit, decimals, values }) {
  const title = name[0].toUpperCase() + name.slice(1);
  return [unit ? `${title}, ${unit}` : title, values.map((v) => v.toFixed(decimals).replace("-", "−")).join(", ")];
}

function detail(scene, it, ask) {
  const joints = scene.chains[scene.buses[it.bus].chain].rows.filter((row) => row.joint !== null).map((row) => scene.joints[row.joint]);
  const wrong = it.configuration[0] !== null && it.configuration[0] !== it.configuration[1];
  const rows = [
    ["Status", STATUSES[it.status] ?? it.status, it.status === "dead" || it.status === "stale" ? "bad" : ""],
    ["Serial number", String(it.serial)],
    ...where(scene, it),
    ["Configuration", wrong ? it.configuration.join(", expected ") : it.configuration[1], wrong ? "bad" : ""],
    ["Gains α: contact, proximity", it.gains.alpha.map(String).join(", ") + " N"],
    ["Thresholds: contact, proximity, force",
      it.gains.thresholds.map((value, at) => `${Number(value.toPrecision(3))}${[" N", "", " N"][at]}`).join(", ")],
    ["Force", `${it.force_n.toFixed(3)} N`],
    ...it.readings.map(reading),
    ["Replies in time", `${it.replies[1]} of ${it.replies[0]}`],
    ["Packets lost, restarts", `${it.lost}, ${it.restarts}`, it.lost ? "bad" : ""],
  ];
  const parts = [table(rows)];
  if (it.torque) {
    const units = [...new Set(joints.map((joint) => joint.torque_unit))];
    const head = element("tr");
    head.append(...["Joint", "word", "cell", "central", "error", "J"].map((text, i) => element(i ? "td" : "th", text, "faint")));
    const torques = element("table");
    torques.className = "torques";
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
    parts.push(element("h3", `Torque of epoch ${it.torque.epoch}${units.length > 1 ? "" : `, ${units[0]}`}${it.torque.saturated ? ", saturated" : ""}`), torques);
  }
  show($("cell"), parts);
  frames(it.frames, it.why, ask);
}

export function chosen(name) {
  $("cell-title").textContent = name ? `Cell ${name}` : "No cell chosen";
  if (!name) $("cell").replaceChildren();
  forget();
}

export function link(text, isBad) {
  $("link").textContent = text;
  $("link").className = isBad ? "bad" : "";
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
