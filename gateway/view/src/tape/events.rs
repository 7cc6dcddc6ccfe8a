//! Detects the events of a recording to which a page can jump.

use std::collections::BTreeMap;

use protocol::id::CellId;
use serde::{Deserialize, Serialize};
use trace::capture::{BusNote, CaptureNote, NoteKind};

use crate::live::{CellContact, LiveState};

/// The maximum time in ns between two losses on a bus that count as one event.
const LOSS_MERGE_NS: u64 = 200_000_000;
/// The maximum number of events that are stored.
pub const MAX_EVENTS: usize = 1 << 18;
/// The beginnings of notes about commands, which end with the name of the option that made the connection to the run.
const COMMAND_PREFIXES: [&str; 2] = ["view: ", "control: "];

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
    /// A bus is lost, or works again.
    Bus,
    /// A command was given to the run, such as to kill a cell.
    Command,
}

impl EventKind {
    /// All kinds.
    pub const ALL: [Self; 6] = [Self::Touch, Self::Loss, Self::Silence, Self::Halt, Self::Bus, Self::Command];
}

/// An event of a recording.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Event {
    /// The time at which it was detected, in ns since 1970, in steps of 20 ms.
    pub at: u64,
    /// The kind of event.
    pub kind: EventKind,
    /// The bus on which it happened; `None` for a bus that the skin does not have, or for no bus.
    pub bus: Option<usize>,
    /// The node id of the cell to which the event happened; `None` if it happened to the whole bus.
    pub node: Option<u8>,
    /// The text of the note that the recorder made; `None` for an event that frames show.
    pub text: Option<String>,
}

impl Event {
    /// Returns the event that a note reports; `None` for another note. `bus_index` finds a bus by its name.
    pub fn from_note(note: &CaptureNote<'_>, bus_index: impl Fn(&str) -> Option<usize>) -> Option<Self> {
        let event = |kind, bus, text: &str| {
            Some(Self { at: note.nanos, kind, bus, node: None, text: Some(text.to_owned()) })
        };
        if let Some((bus, state)) = BusNote::parse(note) {
            let text = match state {
                BusNote::Lost => "lost",
                BusNote::Back => "works again",
            };
            return event(EventKind::Bus, bus_index(bus), text);
        }
        let text = str::from_utf8(note.text).ok().filter(|_| note.kind == NoteKind::Text)?;
        let text = text.strip_prefix("# ").unwrap_or(text);
        let command = COMMAND_PREFIXES.iter().find_map(|prefix| text.strip_prefix(prefix))?;
        event(EventKind::Command, None, command)
    }
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
    /// Returns the events that have happened since the last call. `contacts` are those of all cells now.
    pub fn detect(&mut self, at: u64, live: &LiveState, contacts: &[CellContact]) -> Vec<Event> {
        let mut events = Vec::new();
        for (bus, (losses, halted)) in live.losses_and_halted_by_bus().enumerate() {
            if self.buses.len() <= bus {
                self.buses.push((0, false, None));
            }
            let Some((before, was_halted, last)) = self.buses.get_mut(bus) else { continue };
            if losses > *before {
                if last.is_none_or(|last| at.saturating_sub(last) > LOSS_MERGE_NS) {
                    events.push(Event { at, kind: EventKind::Loss, bus: Some(bus), node: None, text: None });
                }
                *last = Some(at);
            }
            if halted && !*was_halted {
                events.push(Event { at, kind: EventKind::Halt, bus: Some(bus), node: None, text: None });
            }
            (*before, *was_halted) = (losses, halted);
        }
        for &CellContact { bus, node, is_touched, is_dead, .. } in contacts {
            let now = [is_touched, is_dead];
            let before = self.cells.insert((bus, node), now).unwrap_or_default();
            for (kind, (now, before)) in
                [EventKind::Touch, EventKind::Silence].into_iter().zip(now.into_iter().zip(before))
            {
                if now && !before {
                    events.push(Event { at, kind, bus: Some(bus), node: Some(node.get()), text: None });
                }
            }
        }
        // Events beyond the maximum number are dropped.
        events.truncate(MAX_EVENTS - self.events.min(MAX_EVENTS));
        self.events += events.len();
        events
    }
}
