//! A cell's identity, and the identifiers that it receives for that.

use protocol::id::{CellId, Id};

/// Identifiers that every cell with a node id receives.
pub const OWN: usize = 10;

/// A cell's identity.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Identity {
    /// Its number on the bus; none until the network gives it one.
    pub cell: Option<CellId>,
    /// Its serial number.
    pub serial: u32,
}

impl Identity {
    /// The identifiers that this cell receives whatever the state of the network ([`Id::of_cell`]). A cell without a
    /// node id receives only what comes in at its ports.
    #[must_use]
    pub fn hears(&self) -> [Option<Id>; OWN] {
        self.cell.map_or([None; OWN], |cell| Id::of_cell(cell).map(Some))
    }
}
