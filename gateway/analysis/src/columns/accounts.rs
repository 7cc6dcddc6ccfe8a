//! Counts of what a capture contains, by bus and by cell.

use std::collections::{BTreeMap, HashMap};

use protocol::message::{Message, NetworkPage};
use serde::Serialize;
use trace::capture::{CaptureNote, NoteKind};

use super::{bus_and_node, cell_group};

/// Counts of one bus.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
pub struct BusAccount {
    /// The name of the bus.
    pub name: String,
    /// Number of frames.
    pub frames: u64,
    /// Number of decoded packets.
    pub packets: u64,
    /// Number of torques.
    pub torques: u64,
    /// Number of torques that are used in an epoch.
    pub used: u64,
    /// Number of sums.
    pub sums: u64,
    /// Number of frames that the recorder lost.
    pub lost: u64,
}

/// Counts of one cell, or of another sender on a bus of the skin.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct CellAccount {
    /// The index of the bus.
    pub bus: u32,
    /// The node id.
    pub node: u8,
    /// Number of torques.
    pub torques: u64,
    /// Number of torques that are used in an epoch.
    pub used: u64,
    /// Number of sums.
    pub sums: u64,
    /// Number of heartbeats.
    pub heartbeats: u64,
}

/// Counts of a whole capture.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CaptureAccount {
    /// Number of frames.
    pub frames: u64,
    /// Number of frames that the recorder lost.
    pub lost: u64,
    /// Number of lines of a log that cannot be read.
    pub unreadable_lines: u64,
    /// Number of messages of a recording that cannot be read.
    pub unreadable_messages: u64,
    /// Number of CAN XL frames, which are not decoded.
    pub can_xl: u64,
    /// Number of epochs.
    pub epochs: u64,
    /// The buses: first those of the skin, then others in the order of their first frames.
    pub buses: Vec<BusAccount>,
    /// The cells, by bus and node id.
    pub cells: Vec<CellAccount>,
}

/// Counts of a capture that is being read.
#[derive(Debug, Default)]
pub(super) struct Accounts {
    pub(super) total: CaptureAccount,
    numbers: HashMap<String, usize>,
    cells: BTreeMap<u32, CellAccount>,
    last: usize,
}

impl Accounts {
    /// Creates empty accounts of these buses.
    pub(super) fn new<'a>(buses: impl Iterator<Item = &'a str>) -> Self {
        let mut accounts = Self::default();
        for bus in buses {
            accounts.bus_index(bus);
        }
        accounts
    }

    /// Returns the index of a bus, and adds a bus that is new.
    pub(super) fn bus_index(&mut self, name: &str) -> usize {
        if self.total.buses.get(self.last).is_some_and(|bus| bus.name == name) {
            return self.last;
        }
        self.last = self.numbers.get(name).copied().unwrap_or_else(|| {
            let index = self.total.buses.len();
            self.total.buses.push(BusAccount { name: name.to_owned(), ..BusAccount::default() });
            self.numbers.insert(name.to_owned(), index);
            index
        });
        self.last
    }

    /// Counts a frame and its message. `is_used` is true for a torque that is used, `is_of_skin` for a bus of the skin.
    pub(super) fn count_frame(
        &mut self,
        bus: usize,
        message: Option<&Message>,
        is_used: bool,
        is_of_skin: bool,
    ) {
        self.total.frames += 1;
        let Some(of_bus) = self.total.buses.get_mut(bus) else { return };
        of_bus.frames += 1;
        let Some(message) = message else { return };
        let is_torque = u64::from(matches!(message, Message::Torque { .. }));
        let is_sum = u64::from(matches!(message, Message::Sum { .. }));
        of_bus.packets += 1;
        of_bus.torques += is_torque;
        of_bus.used += u64::from(is_used);
        of_bus.sums += is_sum;
        if let Some(sender) = message.sender().filter(|_| is_of_skin) {
            let group = cell_group(bus, sender);
            let (bus, node) = bus_and_node(group);
            let cell = self.cells.entry(group).or_default();
            (cell.bus, cell.node) = (bus, node);
            cell.torques += is_torque;
            cell.used += u64::from(is_used);
            cell.sums += is_sum;
            cell.heartbeats +=
                u64::from(matches!(message, Message::Network { page: NetworkPage::Heartbeat(_), .. }));
        }
    }

    /// Counts an entry that is not a frame. `bus` is the bus that it is about.
    pub(super) fn count_note(&mut self, note: &CaptureNote<'_>, bus: Option<usize>) {
        match note.kind {
            NoteKind::Text => {}
            NoteKind::CanXl => self.total.can_xl += 1,
            NoteKind::Unreadable(_) if note.line == 0 => self.total.unreadable_messages += 1,
            NoteKind::Unreadable(_) => self.total.unreadable_lines += 1,
            NoteKind::Dropped(frames) => {
                self.total.lost = self.total.lost.saturating_add(frames);
                if let Some(bus) = bus.and_then(|bus| self.total.buses.get_mut(bus)) {
                    bus.lost = bus.lost.saturating_add(frames);
                }
            }
        }
    }

    /// Returns the counts at the end of the capture.
    pub(super) fn finish(mut self, epochs: u64) -> CaptureAccount {
        self.total.epochs = epochs;
        self.total.cells = self.cells.into_values().collect();
        self.total
    }
}
