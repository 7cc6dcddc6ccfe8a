//! The identity of a cell: its node id and serial number.

use protocol::id::{CellId, Id};

/// Number of identifiers that every cell receives because of its node id.
pub const OWN_IDS: usize = 10;

/// The identity of a cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Identity {
    /// The node id; `None` until the network assigns one.
    pub cell: Option<CellId>,
    /// The serial number.
    pub serial: u32,
}

impl Identity {
    /// Returns the identifiers that this cell receives in every network state ([`Id::received_by_cell`]). A cell without a node
    /// id receives no identifiers, only messages at its ports.
    #[must_use]
    pub fn received_ids(&self) -> [Option<Id>; OWN_IDS] {
        self.cell.map_or([None; OWN_IDS], |cell| Id::received_by_cell(cell).map(Some))
    }
}
