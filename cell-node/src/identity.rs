//! Who a cell is, and what it hears for that.

use protocol::id::{CellId, Command, Id, Kind, Node as Address};

/// Identifiers that every cell with a number hears.
pub const OWN: usize = 10;

/// Who a cell is, from the factory on.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Identity {
    /// Its number on the bus; none until the network gives it one.
    pub cell: Option<CellId>,
    /// Its serial number.
    pub serial: u32,
}

impl Identity {
    /// The identifiers that this cell hears whatever the network is like: halt, joints, sync, resume, report;
    /// its own heartbeats' (to notice another cell under its number); what configures and presses it, alone
    /// or with everyone. A cell without a number hears nothing but its ports.
    #[must_use]
    pub fn hears(&self) -> [Option<Id>; OWN] {
        let all = |cell| {
            let cell = Address::Cell(cell);
            [
                Id::command(Command::Halt),
                Id::command(Command::Joints),
                Id::command(Command::Sync),
                Id::command(Command::Resume),
                Id::command(Command::Report),
                Id::new(Kind::Network, cell),
                Id::new(Kind::Configure, cell),
                Id::new(Kind::Configure, Address::Everyone),
                Id::new(Kind::Stimulus, cell),
                Id::new(Kind::Stimulus, Address::Everyone),
            ]
            .map(Some)
        };
        self.cell.map_or([None; OWN], all)
    }
}
