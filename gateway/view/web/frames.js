// The newest frames of the chosen cell, decoded, and the explanation of a torque among them.

import { element, show } from "./dom.js";
import { number } from "./scale.js";

const VERDICTS = {
  nearest: "nearest word", saturated: "saturated", rounded: "rounded J", unexplained: "not explained", open: "unknown",
};

const $ = (id) => document.getElementById(id);
// The server keeps frames for 6 s. A list under the pointer is renewed only after this time, which is shorter.
const STILL_MS = 2000;
// The time limit for the explanation of a frame.
const ANSWER_MS = 2500;
// The list stands still while a user reads it or chooses from it.
let held = false, asked = null, sought = null, renewed = 0;
// A button has to be under the pointer until it is released, and rows move when new ones come.
let isPressed = false;
$("frames").onpointerdown = () => { isPressed = true; };
for (const end of ["pointerup", "pointercancel"]) window.addEventListener(end, () => { isPressed = false; });

function standsStill() {
  const box = $("frames");
  if (!box.firstChild) return false;
  return held || isPressed || box.matches(":hover") && performance.now() < renewed + STILL_MS;
}

export function forget() {
  [held, asked, sought] = [false, null, null];
  $("frames").replaceChildren();
  $("why").replaceChildren();
  hold(false);
}

export function hold(still) {
  held = still;
  $("hold-frames").setAttribute("aria-pressed", String(still));
}

export function frames(all, why, ask) {
  $("frames-part").hidden = false;
  if (!standsStill()) update(all, ask);
  if (why && why.number === asked) explain(why);
}

// Keeps the rows of frames that are still among the newest, so that the focus and a pressed key stay with their button.
function update(all, ask) {
  const box = $("frames"), rows = new Map([...box.children].map((row) => [row.dataset.frame, row]));
  const keys = all.map((frame) => JSON.stringify(frame));
  for (const [key, row] of rows) if (!keys.includes(key)) row.remove();
  let next = box.firstChild;
  all.forEach((frame, at) => {
    const row = rows.get(keys[at]);
    if (row && row === next) next = next.nextSibling;
    else box.insertBefore(row ?? rowOf(frame, keys[at], ask), next);
  });
  renewed = performance.now();
}

function rowOf(frame, key, ask) {
  const row = element("li");
  row.dataset.frame = key;
  row.title = frame.frame;
  row.append(element("span", frame.at_s.toFixed(4), "faint"), element("span", frame.said));
  if (!frame.is_torque) return row;
  const button = element("button", "Why");
  button.type = "button";
  button.setAttribute("aria-label", `Why: explain the torque at ${frame.at_s.toFixed(4)} s`);
  button.onclick = ({ detail }) => {
    if (detail > 1) return;
    asked = sought = frame.number;
    hold(true);
    ask(frame.number);
    setTimeout(() => { if (sought === frame.number) giveUp(); }, ANSWER_MS);
  };
  row.append(button);
  return row;
}

function table(head, rows) {
  const it = element("table"), first = element("tr");
  first.append(...head.map((text, i) => { const cell = element(i ? "td" : "th", text, "faint"); if (!i) cell.scope = "col"; return cell; }));
  it.append(first, ...rows.map((values) => {
    const row = element("tr");
    row.append(...values.map((text, i) => { const cell = element(i ? "td" : "th", text); if (!i) cell.scope = "row"; return cell; }));
    return row;
  }));
  return it;
}

function explain(why) {
  const parts = [element("h3", `Explanation, epoch ${why.epoch}`)], cell = why.cell, force = cell?.force;
  if (force) {
    parts.push(element("p", `Contact ${force.contact_n.map((v) => v.toFixed(4)).join(" + ")} = ${force.touch_n.toFixed(4)} N`),
      element("p", `Force ${force.alpha_c} × ${force.touch_n.toFixed(4)} N + ${force.alpha_p_n} N × ${force.proximity.toFixed(4)} = ${force.fused_n.toFixed(4)} N; in steps of 2⁻¹⁶ N: ${force.force_steps}`));
  }
  if (cell) {
    const value = (v) => (v === null || v === undefined ? "–" : number(v));
    parts.push(table(["Joint", "J, m", "J F", "expected word", "sent word", "explanation"], cell.rows.map((row) => [
      String(row.joint), value(row.jacobian_m), `${value(row.product_nm)} ${row.unit}`, String(row.nearest_word ?? "–"),
      String(row.word ?? "–"), VERDICTS[row.verdict.is],
    ])));
  }
  parts.push(...why.missing.map((line) => element("p", line, "faint")));
  show($("why"), parts);
  if (sought === why.number) $("why").scrollIntoView({ block: "nearest" });
  sought = null;
}

function giveUp() {
  const words = "No answer: the server keeps frames for 6 s, and this frame may be older. Choose a newer frame.";
  $("why").replaceChildren(element("p", words, "faint"));
  $("why").scrollIntoView({ block: "nearest" });
  hold(false);
}
