//! The identity of a cell: its node id and serial number.

use protocol::id::{CellId, Id};

/// Number of identifiers that every cell receives because of its node id.
pub const CELL_RECEIVED_ID_COUNT: usize = 10;

/// The identity of a cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Identity {
    /// The node id; `None` until the network assigns one.
    pub cell: Option<CellId>,
    /// The serial number.
    pub serial: u32,
}

impl Identity {
    /// Returns the identifiers that this cell receives in every network state ([`Id::ids_received_by_cell`]). A cell
    /// without a node id receives no identifiers, only messages at its ports.
    #[must_use]
    pub fn received_ids(&self) -> [Option<Id>; CELL_RECEIVED_ID_COUNT] {
        self.cell.map_or([None; CELL_RECEIVED_ID_COUNT], |cell| Id::ids_received_by_cell(cell).map(Some))
    }
}
