//! Who speaks under which number.

use protocol::id::CellId;
use protocol::message::Heartbeat;

use crate::tracker::{Claim, PerCell, Word};

/// All numbers of a bus.
#[derive(Debug, Default)]
pub(super) struct Roster(PerCell<Claim>);

impl Roster {
    /// Takes a heartbeat; two serial numbers that both come back under one number are returned.
    ///
    /// One change is a cell that took another's place; it is the way back that shows that both are there. A cell
    /// that claims a number gives way where it is taken, and says nothing of who has it.
    pub(super) fn hear(&mut self, number: CellId, heartbeat: &Heartbeat) -> Option<[u32; 2]> {
        let claim = self.0.get_mut(number)?;
        let before = *claim;
        let again = claim.hear(heartbeat) == Word::Started { again: true };
        let [holder, earlier] = [before.serial()?, before.previous()?];
        (again && claim.serial() == Some(earlier) && earlier != holder).then_some([earlier, holder])
    }

    /// Who has a number.
    pub(super) fn holder(&self, number: CellId) -> Option<u32> {
        self.0.get(number).and_then(Claim::serial)
    }

    /// All that were heard, with their serial numbers.
    pub(super) fn all(&self) -> impl Iterator<Item = (CellId, u32)> {
        self.0.iter().filter_map(|(number, claim)| Some((number, claim.serial()?)))
    }
}
