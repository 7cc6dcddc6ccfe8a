// The newest frames of the chosen cell in words, and why the torque in one of them is what it is.

import { element } from "./dom.js";
import { number } from "./plots.js";

const VERDICTS = { nearest: "nearest", saturated: "saturated", rounded: "16-bit J", unexplained: "no J near", open: "not known" };

const $ = (id) => document.getElementById(id);
// The list stands still while somebody reads it or chooses from it.
let held = false, shown = "", asked = null;

export function forget() {
  [held, shown, asked] = [false, "", null];
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
  const state = JSON.stringify(all);
  if (!held && state !== shown) {
    shown = state;
    const focused = document.activeElement?.dataset?.frame;
    $("frames").replaceChildren(...all.map((frame) => {
      const item = element("li"), words = element("span", frame.said);
      item.append(element("span", frame.at_s.toFixed(4), "faint"), words);
      item.title = frame.frame;
      if (frame.is_torque) {
        const button = element("button", "Why");
        button.type = "button";
        button.dataset.frame = frame.number;
        button.setAttribute("aria-label", `Why is the torque at ${frame.at_s.toFixed(4)} s what it is`);
        button.onclick = () => { asked = frame.number; hold(true); ask(frame.number); };
        item.append(button);
      }
      return item;
    }));
    if (focused) $("frames").querySelector(`[data-frame="${focused}"]`)?.focus();
  }
  if (why && why.number === asked) explain(why);
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
  const parts = [element("h3", `Why, epoch ${why.epoch}`)], cell = why.cell, force = cell?.force;
  if (force) {
    parts.push(element("p", `Contact ${force.contact_n.map((v) => v.toFixed(4)).join(" + ")} = ${force.touch_n.toFixed(4)} N`),
      element("p", `Force ${force.alpha_c} × ${force.touch_n.toFixed(4)} N + ${force.alpha_p_n} N × ${force.proximity.toFixed(4)} = ${force.fused_n.toFixed(4)} N; in steps of 2⁻¹⁶ N: ${force.force_steps}`));
  }
  if (cell) {
    const value = (v) => (v === null || v === undefined ? "–" : number(v));
    parts.push(table(["Joint", "J, m", "J F", "step", "word", ""], cell.rows.map((row) => [
      String(row.joint), value(row.jacobian_m), `${value(row.product_nm)} ${row.unit}`, String(row.nearest_word ?? "–"),
      String(row.word ?? "–"), VERDICTS[row.verdict.is],
    ])));
  }
  parts.push(...why.missing.map((line) => element("p", line, "faint")));
  $("why").replaceChildren(...parts);
}
