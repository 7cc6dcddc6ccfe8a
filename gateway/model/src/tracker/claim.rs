//! Which cell has a node id, and whether a heartbeat is of a cell that has restarted.

use protocol::message::{Heartbeat, State};

/// What a heartbeat of a node id means.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Word {
    /// The first one of the cell that has the id; when it started is not known.
    First,
    /// A further one of the cell that has the id.
    Known,
    /// An old one of that cell: a later one came before it.
    Overtaken,
    /// The first one since the cell started.
    Started {
        /// Whether the cell, or another one that had the id before, sent something before that.
        again: bool,
    },
    /// Of the cell that had the id before, which did not claim it again: two cells use it in turn.
    Shared,
    /// Another cell claims the id, and will give up the claim.
    Claimant,
}

/// A counter that falls back by more than this is of a cell that has restarted, not of an overtaken heartbeat.
const OVERTAKES: u16 = 128;

/// The address claim of one node id: which cell has it.
///
/// A cell is identified by its serial number. While it claims the id it yields to a cell that has it already, so a
/// claim of a settled cell's id does not change that cell's state.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Claim {
    owner: Option<Heartbeat>,
    /// Of the last one before it that was another cell.
    previous: Option<Heartbeat>,
}

impl Claim {
    /// Takes a heartbeat of this node id. This is the one place that detects a restart.
    pub fn hear(&mut self, heartbeat: &Heartbeat) -> Word {
        let word = self.word(heartbeat);
        if !matches!(word, Word::Overtaken | Word::Claimant) {
            let before = self.owner.replace(*heartbeat);
            self.previous = before.filter(|owner| owner.serial != heartbeat.serial).or(self.previous);
        }
        word
    }

    fn word(&self, heartbeat: &Heartbeat) -> Word {
        let claims = heartbeat.state.has(State::CLAIMING);
        let Some(owner) = &self.owner else {
            // A cell claims its id for half a second at most.
            return if claims { Word::Started { again: false } } else { Word::First };
        };
        if owner.serial != heartbeat.serial {
            return match (self.is_settled(), claims) {
                (_, true) => Word::Claimant,
                (true, false) if self.had_it_before(heartbeat.serial) => Word::Shared,
                (true, false) => Word::Started { again: true },
                // The claimant did not get the id.
                (false, false) => Word::First,
            };
        }
        let back = owner.sent.wrapping_sub(heartbeat.sent);
        match back.cast_signed() {
            // The first packet of a life is a claim.
            _ if claims && heartbeat.sent == 0 => Word::Started { again: true },
            ..=0 => Word::Known,
            // The second heartbeat of a life is the one after the claim.
            _ if heartbeat.sent <= 1 || back > OVERTAKES => Word::Started { again: true },
            _ => Word::Overtaken,
        }
    }

    /// The last heartbeat of the cell that has the id, or is the first one to claim it.
    #[must_use]
    pub const fn heartbeat(&self) -> Option<Heartbeat> {
        self.owner
    }

    /// The serial number of that cell.
    #[must_use]
    pub fn serial(&self) -> Option<u32> {
        self.owner.map(|owner| owner.serial)
    }

    /// The serial number of the cell that had the id before that one, or claimed it.
    #[must_use]
    pub fn previous(&self) -> Option<u32> {
        self.previous.map(|owner| owner.serial)
    }

    /// Whether this cell had the id before the one that has it, and did not only claim it.
    fn had_it_before(&self, serial: u32) -> bool {
        self.previous.is_some_and(|owner| owner.serial == serial && !owner.state.has(State::CLAIMING))
    }

    /// Whether that cell reports this state.
    #[must_use]
    pub fn says(&self, state: State) -> bool {
        self.owner.is_some_and(|owner| owner.state.has(state))
    }

    /// Whether a cell has the id, and so answers.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.owner.is_some() && !self.says(State::CLAIMING)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AGAIN: Word = Word::Started { again: true };

    fn words(said: &[(u32, u16, State)]) -> Vec<Word> {
        let mut claim = Claim::default();
        said.iter()
            .map(|&(serial, sent, state)| {
                claim.hear(&Heartbeat { serial, sent, state, ..Heartbeat::default() })
            })
            .collect()
    }

    #[test]
    fn a_restart_is_a_claim_or_a_counter_that_falls_back() {
        let (claims, settled) = (State::CLAIMING, State::default());
        let life = [(7, 0, claims), (7, 1, settled), (7, 65_535, settled), (7, 2, settled)];
        let started = Word::Started { again: false };
        assert_eq!(words(&life), [started, Word::Known, Word::Overtaken, Word::Known]);
        assert_eq!(words(&[(7, 900, settled), (7, 0, claims)]), [Word::First, AGAIN]);
        assert_eq!(words(&[(7, 900, settled), (7, 1, settled)]), [Word::First, AGAIN], "its claim was lost");
        assert_eq!(words(&[(7, 900, settled), (7, 771, settled)]), [Word::First, AGAIN]);
        assert_eq!(words(&[(7, 900, settled), (7, 772, settled)]), [Word::First, Word::Overtaken]);
        // A cell that wins when two claim at once sends a heartbeat, still claiming.
        assert_eq!(words(&[(7, 0, claims), (7, 1, claims)]), [started, Word::Known]);
    }

    #[test]
    fn a_claimed_id_keeps_its_owner_until_the_claimant_settles() {
        let (claims, settled) = (State::CLAIMING, State::default());
        let said = [(7, 9, settled), (8, 0, claims), (7, 10, settled), (8, 1, settled), (8, 2, settled)];
        assert_eq!(words(&said), [Word::First, Word::Claimant, Word::Known, AGAIN, Word::Known]);
        let said = [(8, 0, claims), (7, 10, settled), (7, 11, settled)];
        assert_eq!(
            words(&said),
            [Word::Started { again: false }, Word::First, Word::Known],
            "it gave up the claim"
        );
    }

    #[test]
    fn two_cells_that_use_one_id_in_turn_do_not_restart_each_time() {
        let settled = State::default();
        let said = [(7, 90, settled), (9, 40, settled), (7, 91, settled), (9, 41, settled), (9, 42, settled)];
        assert_eq!(words(&said), [Word::First, AGAIN, Word::Shared, Word::Shared, Word::Known]);
    }

    #[test]
    fn the_cell_that_had_the_id_before_is_remembered() {
        let mut claim = Claim::default();
        let mut hear = |serial, state| {
            claim.hear(&Heartbeat { serial, state, ..Heartbeat::default() });
            (claim.serial(), claim.previous(), claim.is_settled())
        };
        let (claims, settled) = (State::CLAIMING, State::default());
        assert_eq!(hear(7, claims), (Some(7), None, false));
        assert_eq!(hear(7, settled), (Some(7), None, true));
        assert_eq!(hear(8, claims), (Some(7), None, true));
        assert_eq!(hear(8, settled), (Some(8), Some(7), true));
        assert_eq!(hear(8, settled), (Some(8), Some(7), true));
        assert_eq!(hear(7, settled), (Some(7), Some(8), true));
    }
}
