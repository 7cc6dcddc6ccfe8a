//! The address claim of one node id: the cell that owns it, and whether a heartbeat is of a cell that has restarted.
//!
//! ```text
//!   heartbeat ──> [Ownership] ── Outsider ──> [Candidate]
//!                   │     ▲                        │
//!                   │     └─────── Succeeds ───────┘
//!                   └─> Word
//! ```
//!
//! [`ownership`] has the states, what a heartbeat can show, and the table of both; [`candidate`] has the same of an
//! outsider that may own the id when its owner is silent; [`life`] compares a heartbeat with one start of a cell.

mod candidate;
mod life;
mod ownership;
#[cfg(test)]
mod tests;

use protocol::message::{Heartbeat, State};
use protocol::time::Micros;

use candidate::Candidate;
use life::Life;
use ownership::{Evidence, Ownership};

/// What a heartbeat of a node id means.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Word {
    /// The first one of the cell that has the id; when it started is not known.
    First,
    /// A further one of the cell that has the id.
    Known,
    /// An old one of that cell, or its last one again: it tells nothing new.
    Overtaken,
    /// The first one since the cell started.
    Started {
        /// Whether the cell, or another one that had the id before, sent something before that.
        again: bool,
    },
    /// Of the sender that had the id before, which goes on: two use it in turn, and what seemed a start was none.
    Shared,
    /// Of another sender, while the cell that has the id is alive: after two used it in turn, or when no cell can have
    /// sent so much since that one was heard.
    Outsider,
    /// Another cell claims the id, and will give up the claim.
    Claimant,
}

/// The address claim of one node id: which cell has it.
///
/// A cell is identified by its serial number. While it claims the id it yields to a cell that has it already, so a
/// claim of a settled cell's id does not change that cell's state.
///
/// A heartbeat is not signed, and old ones may be sent again. So a start is believed at once, and taken back when the
/// counter before it goes on; from then on a start is believed only of an id whose cell is silent.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Claim {
    ownership: Ownership,
    /// The outsider that sent the last heartbeat, unless one of the owner's came since.
    candidate: Option<Candidate>,
    /// Serial number of the last owner before this one that was another cell.
    previous: Option<u32>,
}

impl Claim {
    /// Takes a heartbeat of this node id, which came at `at`. This is the one place that detects a restart.
    pub fn hear(&mut self, at: Micros, heartbeat: &Heartbeat) -> Word {
        let new = Life::new(at, heartbeat);
        let (mut next, mut word) = self.ownership.next(self.ownership.evidence(&new), new);
        if word == Word::Outsider {
            let candidate = Candidate::next(self.candidate, new);
            self.candidate = Some(candidate);
            if candidate.succeeds(self.ownership.owner()) {
                (next, word) = self.ownership.next(Evidence::Succeeds, new);
            }
        }
        match word {
            Word::Overtaken | Word::Outsider | Word::Claimant => {}
            Word::First | Word::Known | Word::Started { .. } | Word::Shared => {
                self.candidate = None;
                let before = self.serial().filter(|serial| *serial != heartbeat.serial);
                self.previous = before.or(self.previous);
                self.ownership = next;
            }
        }
        word
    }

    /// Whether a start that was heard may still be taken back.
    pub(super) fn is_in_question(&self, at: Micros) -> bool {
        self.ownership.former().is_some_and(|former| former.may_go_on(at))
    }

    /// The last heartbeat of the cell that has the id, or is the first one to claim it.
    #[must_use]
    pub fn heartbeat(&self) -> Option<Heartbeat> {
        self.ownership.owner().map(|owner| owner.heartbeat)
    }

    /// The serial number of that cell.
    #[must_use]
    pub fn serial(&self) -> Option<u32> {
        self.ownership.owner().map(|owner| owner.heartbeat.serial)
    }

    /// The serial number of the cell that had the id before that one, or claimed it.
    #[must_use]
    pub const fn previous(&self) -> Option<u32> {
        self.previous
    }

    /// Whether that cell reports this state.
    #[must_use]
    pub fn says(&self, state: State) -> bool {
        self.ownership.owner().is_some_and(|owner| owner.heartbeat.state.has(state))
    }

    /// Whether a cell has the id, and so answers.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.ownership.owner().is_some_and(Life::is_settled)
    }
}
