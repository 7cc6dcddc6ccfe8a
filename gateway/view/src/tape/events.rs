//! What happens in a recording, to be gone to.

use std::collections::BTreeMap;

use protocol::id::CellId;
use protocol::time::Micros;
use serde::{Deserialize, Serialize};

use crate::live::Live;

/// Losses on a bus that follow each other within so many ns are one event.
const TOGETHER_NS: u64 = 200_000_000;
/// Events that are kept.
const EVENTS: usize = 1 << 18;

/// Something that somebody may look for.
#[derive(Clone, Copy, Debug, Deserialize, Eq, Hash, Ord, PartialEq, PartialOrd, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum EventKind {
    /// A cell comes into contact.
    Touch,
    /// Replies or packets were lost, late or damaged, or frames not recorded.
    Loss,
    /// A cell has fallen silent.
    Silence,
    /// The robot is halted.
    Halt,
}

/// When something happened.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Event {
    /// When it was seen, in ns since 1970: at a look at the time, every 20 ms.
    pub at: u64,
    /// What.
    pub kind: EventKind,
    /// On which bus.
    pub bus: usize,
    /// Of which cell.
    pub node: Option<u8>,
}

/// Looks at what is known, and notes what has changed since the last look.
#[derive(Clone, Debug, Default)]
pub struct Watcher {
    /// By bus: losses, whether it is halted, and when the last loss was.
    buses: Vec<(u64, bool, Option<u64>)>,
    /// By cell: whether it is touched, and whether it is dead.
    cells: BTreeMap<(usize, CellId), [bool; 2]>,
    events: usize,
}

impl Watcher {
    /// What has happened since the last look.
    pub fn look(&mut self, at: u64, live: &Live) -> Vec<Event> {
        let mut events = Vec::new();
        for (bus, (losses, halted)) in live.losses().enumerate() {
            if self.buses.len() <= bus {
                self.buses.push((0, false, None));
            }
            let Some((before, was_halted, last)) = self.buses.get_mut(bus) else { continue };
            if losses > *before {
                if last.is_none_or(|last| at.saturating_sub(last) > TOGETHER_NS) {
                    events.push(Event { at, kind: EventKind::Loss, bus, node: None });
                }
                *last = Some(at);
            }
            if halted && !*was_halted {
                events.push(Event { at, kind: EventKind::Halt, bus, node: None });
            }
            (*before, *was_halted) = (losses, halted);
        }
        for (bus, node, now) in live.touched(Micros(at / 1_000)) {
            let before = self.cells.insert((bus, node), now).unwrap_or_default();
            for (kind, (now, before)) in
                [EventKind::Touch, EventKind::Silence].into_iter().zip(now.into_iter().zip(before))
            {
                if now && !before {
                    events.push(Event { at, kind, bus, node: Some(node.get()) });
                }
            }
        }
        // The first ones, where there are too many.
        events.truncate(EVENTS - self.events.min(EVENTS));
        self.events += events.len();
        events
    }
}
