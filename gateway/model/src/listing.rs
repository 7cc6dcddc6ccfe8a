//! A list of the cells of a bus, made only from the cells' own reports.

use std::collections::BTreeMap;

use protocol::can::Format;
use protocol::message::{Heartbeat, Message, NetworkPage, NetworkPages};
use protocol::time::{Micros, Span};

use crate::tracker::{AddressClaim, HeartbeatKind};

/// Formats sorted node ids as text. Three or more consecutive ids become a range: `1-3`, `5`.
#[must_use]
pub fn node_id_ranges(nodes: &[u8]) -> Vec<String> {
    let in_a_row = nodes.chunk_by(|one, next| one.checked_add(1) == Some(*next));
    let text = |row: &[u8]| match row {
        [first, _, .., last] => vec![format!("{first}-{last}")],
        few => few.iter().map(u8::to_string).collect(),
    };
    in_a_row.flat_map(text).collect()
}

/// The last reports of one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ListedCell {
    /// The last heartbeat, with the identity and the state of the cell.
    pub heartbeat: Option<Heartbeat>,
    /// Its last other pages.
    pub pages: NetworkPages,
    /// The serial number of another cell that claims this node id, or held it before.
    pub other_serial: Option<u32>,
    claim: AddressClaim,
    /// Arrival time of the last packet of the cell.
    last_packet: Micros,
}

impl ListedCell {
    /// Returns the time since the last packet of the cell.
    #[must_use]
    pub const fn time_since_last_packet(&self, now: Micros) -> Span {
        now.elapsed_since(self.last_packet)
    }

    fn record_page(&mut self, now: Micros, page: &NetworkPage) {
        self.pages.record_page(page);
        if let NetworkPage::Heartbeat(heartbeat) = page {
            let before = self.claim.serial();
            if matches!(self.claim.receive(now, heartbeat), HeartbeatKind::Claimant | HeartbeatKind::Outsider)
            {
                self.other_serial = Some(heartbeat.serial);
            } else if before.is_some_and(|before| before != heartbeat.serial) {
                // The reports so far belong to the previous cell: start again.
                *self = Self {
                    other_serial: before,
                    claim: self.claim,
                    last_packet: self.last_packet,
                    ..Self::default()
                };
            }
            self.heartbeat = self.claim.heartbeat();
        }
    }
}

/// All cells that were seen on a bus.
#[derive(Clone, Debug, Default)]
pub struct CellListing {
    cells: BTreeMap<u8, ListedCell>,
    gateway: bool,
    format: Option<Format>,
}

impl CellListing {
    /// Creates an empty list.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Records a message, which arrived in frames of this format.
    pub fn receive(&mut self, now: Micros, format: Format, message: &Message) {
        let Some(from) = message.sender() else {
            self.gateway |= matches!(message, Message::Joints { .. } | Message::Network { .. });
            return;
        };
        self.format.get_or_insert(format);
        let cell = self.cells.entry(from.get()).or_default();
        cell.last_packet = now;
        if let Message::Network { page, .. } = message {
            cell.record_page(now, page);
        }
    }

    /// Returns the cells by node id.
    pub fn cells(&self) -> impl ExactSizeIterator<Item = (u8, &ListedCell)> {
        self.cells.iter().map(|(&node, cell)| (node, cell))
    }

    /// Returns true if a gateway sends on the bus.
    #[must_use]
    pub const fn has_gateway(&self) -> bool {
        self.gateway
    }

    /// Returns the frame format of the first cell's packets.
    #[must_use]
    pub const fn format(&self) -> Option<Format> {
        self.format
    }

    /// Returns the node id of the cell with this serial number, if it is on the bus.
    #[must_use]
    pub fn node_id(&self, serial: u32) -> Option<u8> {
        let is = |cell: &ListedCell| cell.claim.serial() == Some(serial);
        self.cells.iter().find(|(_, cell)| is(cell)).map(|(&number, _)| number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::id::{CellId, Node};
    use protocol::message::{ReceivedCounts, RejectedCounts, State};
    use protocol::packet::Epoch;

    fn says(number: i64, page: NetworkPage) -> Message {
        Message::Network { from: Node::Cell(CellId::new(number).unwrap()), epoch: Epoch(0), page }
    }

    #[test]
    fn node_ids_in_a_row_are_folded() {
        assert_eq!(node_id_ranges(&[1, 2, 4, 5, 6, 253, 254, 255]), ["1", "2", "4-6", "253-255"]);
        assert_eq!(node_id_ranges(&[]), [""; 0]);
    }

    #[test]
    fn only_reports_of_a_cell_are_listed() {
        let mut listing = CellListing::new();
        let heartbeat = Heartbeat { serial: 7, state: State(0x1101), ..Heartbeat::default() };
        listing.receive(Micros(10), Format::Classic, &says(3, NetworkPage::Heartbeat(heartbeat)));
        listing.receive(
            Micros(20),
            Format::Classic,
            &says(4, NetworkPage::Rejected(RejectedCounts::default())),
        );
        let cells: Vec<_> = listing.cells().collect();
        let [(3, third), (4, fourth)] = cells.as_slice() else { panic!("{cells:?}") };
        assert_eq!((third.heartbeat, third.pages.rejected, third.pages.tree), (Some(heartbeat), None, None));
        assert_eq!((fourth.heartbeat, fourth.pages.rejected), (None, Some(RejectedCounts::default())));
        assert_eq!(
            (third.time_since_last_packet(Micros(110)), listing.node_id(7), listing.node_id(8)),
            (Span(100), Some(3), None)
        );
        assert_eq!((listing.format(), listing.has_gateway()), (Some(Format::Classic), false));
    }

    #[test]
    fn another_cell_with_a_node_id_has_no_reports_of_the_one_before_it() {
        let mut listing = CellListing::new();
        let of = |serial| NetworkPage::Heartbeat(Heartbeat { serial, ..Heartbeat::default() });
        for page in [of(7), NetworkPage::Received(ReceivedCounts::default()), of(8)] {
            listing.receive(Micros(0), Format::Fd, &says(3, page));
        }
        let (_, cell) = listing.cells().next().unwrap();
        assert_eq!((cell.other_serial, cell.pages.received), (Some(7), None));
    }

    #[test]
    fn a_cell_that_takes_a_node_id_is_as_old_as_its_last_packet() {
        let mut listing = CellListing::new();
        let beat = |serial| NetworkPage::Heartbeat(Heartbeat { serial, sent: 9, ..Heartbeat::default() });
        listing.receive(Micros(10), Format::Fd, &says(3, beat(7)));
        listing.receive(Micros(900_000), Format::Fd, &says(3, beat(8)));
        let (_, cell) = listing.cells().next().unwrap();
        assert_eq!((cell.time_since_last_packet(Micros(900_400)), cell.other_serial), (Span(400), Some(7)));
    }
}
