//! The address claim of one node id: its owner, and the detection of restarts from heartbeats.
//!
//! ```text
//!   heartbeat ──> [Ownership] ── Outsider ──> [Candidate]
//!                   │     ▲                        │
//!                   │     └─────── Succeeds ───────┘
//!                   └─> Word
//! ```
//!
//! [`ownership`] has the states, the evidence of heartbeats, and their transition table; [`candidate`] has those of an
//! outsider that may own the id if its owner is silent; [`life`] compares a heartbeat with one life of a cell.

mod candidate;
mod life;
mod ownership;
#[cfg(test)]
mod tests;

use protocol::message::{Heartbeat, State};
use protocol::time::Micros;

use candidate::Candidate;
use life::Incarnation;
use ownership::{Evidence, Ownership};

/// The meaning of a heartbeat for its node id.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum HeartbeatKind {
    /// The first heartbeat of the owner, whose start was not observed.
    First,
    /// A further heartbeat of the owner.
    Known,
    /// An old heartbeat of the owner, or its last one again, without new information.
    Overtaken,
    /// The first heartbeat since the cell started.
    Started {
        /// True if the cell, or an earlier owner of the id, sent packets before.
        again: bool,
    },
    /// A heartbeat of the previous owner, which continues: two senders use the id in turn, and the apparent start was
    /// none.
    Shared,
    /// A heartbeat of another sender while the owner is alive: after two senders used the id in turn, or with a counter
    /// that no cell can have reached since the owner's last heartbeat.
    Outsider,
    /// A claim by another cell, which will give it up.
    Claimant,
}

/// The address claim of one node id.
///
/// A cell is identified by its serial number. A claiming cell yields to a cell that owns the id already, so a claim of
/// a settled cell's id does not change that cell's state.
///
/// Heartbeats are not authenticated, and old ones may be repeated. So a start is accepted at once, and taken back if
/// the counter before it continues; after that, a start is accepted only if the owner is silent.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct AddressClaim {
    ownership: Ownership,
    /// The outsider that sent the last heartbeat, unless the owner has sent one since.
    candidate: Option<Candidate>,
    /// Serial number of the last owner that was another cell than the current one.
    previous: Option<u32>,
}

impl AddressClaim {
    /// Records a heartbeat of this node id that arrived at `at`. Only this function detects restarts.
    pub fn receive(&mut self, at: Micros, heartbeat: &Heartbeat) -> HeartbeatKind {
        let new = Incarnation::new(at, heartbeat);
        let (mut next, mut word) = self.ownership.next(self.ownership.evidence(&new), new);
        if word == HeartbeatKind::Outsider {
            let candidate = Candidate::next(self.candidate, new);
            self.candidate = Some(candidate);
            if candidate.succeeds(self.ownership.owner()) {
                (next, word) = self.ownership.next(Evidence::Succeeds, new);
            }
        }
        match word {
            HeartbeatKind::Overtaken | HeartbeatKind::Outsider | HeartbeatKind::Claimant => {}
            HeartbeatKind::First | HeartbeatKind::Known | HeartbeatKind::Started { .. } | HeartbeatKind::Shared => {
                self.candidate = None;
                let before = self.serial().filter(|serial| *serial != heartbeat.serial);
                self.previous = before.or(self.previous);
                self.ownership = next;
            }
        }
        word
    }

    /// Returns true if an accepted start may still be taken back.
    pub(super) fn is_in_question(&self, at: Micros) -> bool {
        self.ownership.former().is_some_and(|former| former.may_go_on(at))
    }

    /// Returns the last heartbeat of the cell that owns the id, or of the first one to claim it.
    #[must_use]
    pub fn heartbeat(&self) -> Option<Heartbeat> {
        self.ownership.owner().map(|owner| owner.heartbeat)
    }

    /// Returns the serial number of that cell.
    #[must_use]
    pub fn serial(&self) -> Option<u32> {
        self.ownership.owner().map(|owner| owner.heartbeat.serial)
    }

    /// Returns the serial number of the previous owner or claimant.
    #[must_use]
    pub const fn previous(&self) -> Option<u32> {
        self.previous
    }

    /// Returns true if that cell reports this state.
    #[must_use]
    pub fn has_state(&self, state: State) -> bool {
        self.ownership.owner().is_some_and(|owner| owner.heartbeat.state.has(state))
    }

    /// Returns true if a cell owns the id, and so answers.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.ownership.owner().is_some_and(Incarnation::is_settled)
    }
}
