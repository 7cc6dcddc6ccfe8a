// The text about a halt: its reason, and the next step.

import { moment } from "./time.js";

// What to do about a reason, before the robot is resumed.
const ADVICE = [
  [/the torque is not valid$/, "Cells did not answer in time: look at silent cells and buses, then press Resume."],
  [/external controller/, "Check the external controller, then press Resume."],
];

// The reason of the present halt; null if it is not known.
export const haltReason = (said) => said.bench?.halted ?? said.playback?.halt?.reason ?? null;

export function haltedWords(said, mayPress) {
  const { bench: run, playback } = said, reason = haltReason(said);
  if (!said.halted && !run?.halted && !playback?.halt) return "";
  if (playback) {
    const since = playback.halt ? ` since ${moment(playback.halt.since_s, 1)}` : "";
    const before = /bad cycles/.test(reason ?? "") ? " Look at the second before it: silent cells, buses, late replies." : "";
    return `The robot is halted${since}${reason ? `: ${reason}` : " by a halt frame on the bus"}.${before}`;
  }
  const why = reason ? `The robot is halted: ${reason}.` : "The robot is halted by a halt frame on the bus.";
  if (!mayPress) return why;
  if (run?.buses.some(({ down }) => down)) return `${why} Bring the bus up, then press Resume.`;
  return `${why} ${ADVICE.find(([of]) => of.test(reason ?? ""))?.[1] ?? "Press Resume to continue."}`;
}
