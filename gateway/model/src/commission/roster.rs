//! Who speaks under which number.

use protocol::id::CellId;
use protocol::message::{Heartbeat, State};

/// What is known of a number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seat {
    /// Whose it is.
    pub(super) serial: u32,
    /// Whose it was before that.
    before: Option<u32>,
    /// How its holder is.
    pub(super) state: State,
}

/// All numbers of a bus.
#[derive(Debug)]
pub(super) struct Roster {
    seats: [Option<Seat>; CellId::COUNT],
}

impl Roster {
    pub(super) const fn new() -> Self {
        Self { seats: [None; CellId::COUNT] }
    }

    /// Takes a heartbeat; two serial numbers that both come back under one number are returned.
    ///
    /// One change is a cell that took another's place; it is the way back that shows that both are there. A cell
    /// that claims a number gives way where it is taken, and says nothing of who has it.
    pub(super) fn hear(&mut self, number: CellId, heartbeat: &Heartbeat) -> Option<[u32; 2]> {
        let seat = self.seats.get_mut(number.index())?;
        let (serial, state) = (heartbeat.serial, heartbeat.state);
        let new = Seat { serial, before: None, state };
        match seat {
            Some(there) if there.serial == serial => there.state = state,
            Some(_) if state.has(State::CLAIMING) => {}
            Some(there) => {
                let shared = (there.before == Some(serial)).then_some([serial, there.serial]);
                *there = Seat { before: Some(there.serial), ..new };
                return shared;
            }
            None => *seat = Some(new),
        }
        None
    }

    /// Who has a number.
    pub(super) fn holder(&self, number: CellId) -> Option<u32> {
        self.seats.get(number.index()).copied().flatten().map(|seat| seat.serial)
    }

    /// All that were heard.
    pub(super) fn all(&self) -> impl Iterator<Item = (CellId, Seat)> {
        CellId::all().zip(self.seats).filter_map(|(number, seat)| Some((number, seat?)))
    }
}
