// What the page shows: a bench that is live, a recording that plays or is paused, or nothing new any more.

// The state as a word for style, and as text.
export function stateOf({ connected, refusal, said }) {
  if (connected === false) return { word: "lost", text: `lost: ${refusal || "the bench has ended, or is not reachable"}` };
  if (!connected || !said) return { word: "connecting", text: "connecting" };
  const { playback, buses } = said;
  if (playback) {
    if (playback.failed) return { word: "lost", text: "cannot be read further" };
    if (playback.playing) return { word: "playing", text: playback.speed === 1 ? "playing" : `playing, ${playback.speed} ×` };
    return { word: "paused", text: playback.at_s >= playback.of_s ? "paused at the end" : "paused" };
  }
  const down = buses.filter(({ up }) => !up).map(({ name }) => name);
  if (down.length === buses.length) return { word: "waiting", text: buses.length > 1 ? "waiting: no bus is up" : `waiting: ${down[0]} is down` };
  if (down.length) return { word: "live", text: `live, without ${down.length > 2 ? `${down.length} buses` : down.join(", ")}` };
  return { word: "live", text: "live" };
}

// The number of cells in a state, among those that were ever heard: of the others nothing is known.
export function countOf(count, unheard, cells) {
  if (unheard === cells) return "–";
  return unheard ? `${count} of ${cells - unheard} heard` : String(count);
}
