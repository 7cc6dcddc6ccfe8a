// The text about a halt: its reason, and the next step.

export function haltedWords(said, mayPress) {
  const run = said.bench;
  if (!said.halted && !run?.halted) return "";
  const why = run?.halted ? `The robot is halted: ${run.halted}.` : "The robot is halted by a halt frame on the bus.";
  if (!mayPress) return why;
  return run?.buses.some(({ down }) => down) ? `${why} Bring the bus up, then press Resume.` : `${why} Press Resume to continue.`;
}
