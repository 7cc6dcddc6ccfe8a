//! Curves and events of a recording, as pages request them for a part of the time.

use std::sync::Arc;

use protocol::skin::Skin;
use serde::Serialize;
use trace::capture::seconds_since;

use crate::command::CellReference;
use crate::index::{Curve, RecordingIndex};
use crate::tape::{Event, EventKind};

/// The maximum number of intervals in an answer.
const MAX_INTERVALS: u64 = 4_096;
/// The maximum number of events of each kind in an answer.
const MAX_EVENTS_PER_KIND: usize = 64;

/// The curves and the events of a recording.
#[derive(Debug)]
pub struct RecordedCurves {
    index: Arc<RecordingIndex>,
    skin: Skin,
    /// The time from which seconds count, in ns since 1970.
    zero: u64,
}

/// An event, as a page labels it.
#[derive(Debug, Serialize)]
struct LabelledEvent {
    at_s: f64,
    kind: EventKind,
    bus: Option<usize>,
    node: Option<u8>,
    text: Option<String>,
}

impl RecordedCurves {
    /// Creates the source of the curves of a recording. Seconds count from `zero`, in ns since 1970.
    #[must_use]
    pub const fn new(index: Arc<RecordingIndex>, skin: Skin, zero: u64) -> Self {
        Self { index, skin, zero }
    }

    /// Returns the media type and the bytes of an answer; `None` if the query is not valid.
    ///
    /// `/events?from=0&to=9.5` is answered in JSON. `/curves?of=torques&from=0&to=9.5&count=600` has values of
    /// `torques`, `loads`, `replies`, `lateness` or `force`, which needs a cell, as in `cell=vcan0:5`. The answer is little-endian:
    ///
    /// | bytes | content |
    /// |---|---|
    /// | 4 | quantities Q, u32: three for each joint (distributed and central torque, their difference), else one for each bus or one |
    /// | 4 | intervals N, u32 |
    /// | 8 | begin of the first interval in s, f64 |
    /// | 8 | length of an interval in s, f64 |
    /// | 8 Q N | for each quantity, for each interval: minimum and maximum, f32; NaN without a value |
    #[must_use]
    pub fn answer(&self, path: &str, query: &str) -> Option<(&'static str, Vec<u8>)> {
        let value = |name: &str| {
            query
                .split('&')
                .find_map(|part| part.split_once('=').filter(|(key, _)| *key == name))
                .map(|(_, v)| v)
        };
        let time =
            |name| value(name)?.parse::<f64>().ok().filter(|at| at.is_finite()).map(|at| self.nanos(at));
        let times = (time("from")?, time("to")?);
        match path {
            "/events" => {
                let events = self.index.events_between(times, MAX_EVENTS_PER_KIND);
                let events: Vec<_> = events.into_iter().map(|event| self.label(event)).collect();
                Some(("application/json", serde_json::to_vec(&events).ok()?))
            }
            "/curves" => {
                let curve = match value("of")? {
                    "torques" => Curve::Torques,
                    "loads" => Curve::Loads,
                    "replies" => Curve::Replies,
                    "lateness" => Curve::Lateness,
                    "force" => {
                        // Browsers may escape the colon.
                        let cell = CellReference(value("cell")?.replace("%3A", ":"));
                        let (bus, node) = cell.find(&self.skin).ok()?;
                        Curve::Force(bus, node)
                    }
                    _ => return None,
                };
                let count =
                    value("count")?.parse().ok().filter(|count| (1..=MAX_INTERVALS).contains(count))?;
                Some(("application/octet-stream", self.encode(curve, times, count)))
            }
            _ => None,
        }
    }

    fn encode(&self, curve: Curve, times: (u64, u64), count: u64) -> Vec<u8> {
        let part = self.index.curve(curve, times, count);
        let intervals = part.ranges.first().map_or(0, Vec::len);
        let word = |count: usize| u32::try_from(count).unwrap_or(u32::MAX).to_le_bytes();
        let mut bytes = Vec::with_capacity(24 + part.ranges.len() * intervals * 8);
        bytes.extend(word(part.ranges.len()));
        bytes.extend(word(intervals));
        bytes.extend(seconds_since(self.zero, part.from).to_le_bytes());
        bytes.extend(seconds_since(0, part.width).to_le_bytes());
        bytes.extend(part.ranges.iter().flatten().flatten().flat_map(|value| value.to_le_bytes()));
        bytes
    }

    fn label(&self, event: Event) -> LabelledEvent {
        let Event { at, kind, bus, node, text } = event;
        LabelledEvent { at_s: seconds_since(self.zero, at), kind, bus, node, text }
    }

    fn nanos(&self, at_s: f64) -> u64 {
        #[expect(clippy::cast_possible_truncation, reason = "saturates")]
        let since = (at_s * 1e9).round() as i64;
        self.zero.saturating_add_signed(since)
    }
}
