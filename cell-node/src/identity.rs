//! A cell's identity, and the identifiers that it receives for that.

use protocol::id::{CellId, Command, Id, Kind, Node as Address};

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
    /// The identifiers that this cell receives whatever the state of the network: halt, joints, sync, resume, report;
    /// its own heartbeats' (to notice another cell under its number); what configures and presses it, alone
    /// or with everyone. A cell without a node id receives only what comes in at its ports.
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
