//! Detects the events of a recording to which a page can jump.

use std::collections::BTreeMap;

use protocol::id::CellId;
use protocol::time::Micros;
use serde::{Deserialize, Serialize};

use crate::live::LiveState;

/// The maximum time in ns between two losses on a bus that count as one event.
const LOSS_MERGE_NS: u64 = 200_000_000;
/// The maximum number of events that are stored.
const MAX_EVENTS: usize = 1 << 18;

/// The kind of an event.
#[derive(Clone, Copy, Debug, Deserialize, Eq, Hash, Ord, PartialEq, PartialOrd, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum EventKind {
    /// A cell comes into contact.
    Touch,
    /// Replies or packets were lost, late or damaged, or frames were not recorded.
    Loss,
    /// A cell becomes silent.
    Silence,
    /// The robot is halted.
    Halt,
}

/// An event of a recording.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Event {
    /// The time at which it was detected, in ns since 1970, in steps of 20 ms.
    pub at: u64,
    /// The kind of event.
    pub kind: EventKind,
    /// The bus on which it happened.
    pub bus: usize,
    /// The node id of the cell to which the event happened; `None` if it happened to the whole bus.
    pub node: Option<u8>,
}

/// Detects events by comparing the state of a recording with its previous state.
#[derive(Clone, Debug, Default)]
pub struct EventDetector {
    /// For each bus: the number of losses, true if the bus is halted, and the time of the last loss.
    buses: Vec<(u64, bool, Option<u64>)>,
    /// For each cell: true if the cell is touched, and true if it is dead.
    cells: BTreeMap<(usize, CellId), [bool; 2]>,
    events: usize,
}

impl EventDetector {
    /// Returns the events that have happened since the last call.
    pub fn detect(&mut self, at: u64, live: &LiveState) -> Vec<Event> {
        let mut events = Vec::new();
        for (bus, (losses, halted)) in live.losses_and_halted_by_bus().enumerate() {
            if self.buses.len() <= bus {
                self.buses.push((0, false, None));
            }
            let Some((before, was_halted, last)) = self.buses.get_mut(bus) else { continue };
            if losses > *before {
                if last.is_none_or(|last| at.saturating_sub(last) > LOSS_MERGE_NS) {
                    events.push(Event { at, kind: EventKind::Loss, bus, node: None });
                }
                *last = Some(at);
            }
            if halted && !*was_halted {
                events.push(Event { at, kind: EventKind::Halt, bus, node: None });
            }
            (*before, *was_halted) = (losses, halted);
        }
        for (bus, node, now) in live.touched_and_dead_cells(Micros(at / 1_000)) {
            let before = self.cells.insert((bus, node), now).unwrap_or_default();
            for (kind, (now, before)) in
                [EventKind::Touch, EventKind::Silence].into_iter().zip(now.into_iter().zip(before))
            {
                if now && !before {
                    events.push(Event { at, kind, bus, node: Some(node.get()) });
                }
            }
        }
        // Events beyond the maximum number are dropped.
        events.truncate(MAX_EVENTS - self.events.min(MAX_EVENTS));
        self.events += events.len();
        events
    }
}
