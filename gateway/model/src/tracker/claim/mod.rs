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
use ownership::{HeartbeatEvidence, Ownership};

/// The meaning of a heartbeat for the owner of its node id.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum HeartbeatKind {
    /// The first heartbeat of the owner, whose start was not observed.
    First,
    /// A further heartbeat of the owner.
    Continued,
    /// An old heartbeat of the owner, or a copy of its last one; it contains nothing new.
    Overtaken,
    /// The first heartbeat since the cell started.
    Started {
        /// True if this cell, or an earlier owner of the node id, has sent packets before.
        again: bool,
    },
    /// A heartbeat that continues the counter of the previous owner. So two senders use the node id in turn, and the
    /// apparent start of the owner was not one.
    Shared,
    /// A heartbeat of another sender while the owner is alive: either two senders have used the node id in turn, or no
    /// cell can have reached its counter since the owner's last heartbeat.
    Outsider,
    /// A claim by another cell, which will yield to the owner.
    Claimant,
}

/// The owner of one node id, and the other senders that use or claim it.
///
/// A cell is identified by its serial number. A claiming cell yields to a cell that owns the node id already, so a
/// claim for a settled cell's node id does not change that cell's state.
///
/// Heartbeats are not authenticated, and old ones may be repeated. So a start is accepted at once, and taken back if a
/// later heartbeat continues the counter from before the start; after that, a start is accepted only if the owner is
/// silent.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct AddressClaim {
    ownership: Ownership,
    /// The sender of the last heartbeat that was not the owner's; `None` if the owner has sent one since.
    candidate: Option<Candidate>,
    /// Serial number of the last cell that owned the node id before the present owner.
    previous: Option<u32>,
}

impl AddressClaim {
    /// Records a heartbeat with this node id that arrived at `at`, and returns its meaning. Restarts are detected only
    /// here.
    pub fn receive(&mut self, at: Micros, heartbeat: &Heartbeat) -> HeartbeatKind {
        let new = Incarnation::new(at, heartbeat);
        let (mut next, mut word) = self.ownership.after_heartbeat(self.ownership.evidence(&new), new);
        if word == HeartbeatKind::Outsider {
            let candidate = Candidate::after_heartbeat(self.candidate, new);
            self.candidate = Some(candidate);
            if candidate.becomes_owner(self.ownership.owner()) {
                (next, word) = self.ownership.after_heartbeat(HeartbeatEvidence::Succeeds, new);
            }
        }
        match word {
            HeartbeatKind::Overtaken | HeartbeatKind::Outsider | HeartbeatKind::Claimant => {}
            HeartbeatKind::First
            | HeartbeatKind::Continued
            | HeartbeatKind::Started { .. }
            | HeartbeatKind::Shared => {
                self.candidate = None;
                let before = self.serial().filter(|serial| *serial != heartbeat.serial);
                self.previous = before.or(self.previous);
                self.ownership = next;
            }
        }
        word
    }

    /// Returns true if an accepted start of the owner may still be taken back.
    pub(super) fn is_in_question(&self, at: Micros) -> bool {
        self.ownership.former_incarnation().is_some_and(|former| former.may_still_be_alive(at))
    }

    /// Returns the last heartbeat of the owner of the node id, or of the first cell to claim it.
    #[must_use]
    pub fn heartbeat(&self) -> Option<Heartbeat> {
        self.ownership.owner().map(|owner| owner.heartbeat)
    }

    /// Returns the serial number of the owner of the node id, or of the first cell to claim it.
    #[must_use]
    pub fn serial(&self) -> Option<u32> {
        self.ownership.owner().map(|owner| owner.heartbeat.serial)
    }

    /// Returns the serial number of the previous owner or claimant.
    #[must_use]
    pub const fn previous(&self) -> Option<u32> {
        self.previous
    }

    /// Returns true if the last heartbeat of the owner has this state flag.
    #[must_use]
    pub fn has_state(&self, state: State) -> bool {
        self.ownership.owner().is_some_and(|owner| owner.heartbeat.state.has(state))
    }

    /// Returns true if a cell owns the node id, and so answers joints.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.ownership.owner().is_some_and(Incarnation::owns_node_id)
    }
}
