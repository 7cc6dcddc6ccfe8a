//! The state of cells, derived from the traffic on the bus. All other parts of the program that follow cells use this
//! module.
//!
//! ```text
//!                                ┌─ Claim    the owner of the node id, and its restarts
//!   a cell's packets ─> Tracked ─┼─ Account  packets sent and lost
//!                                ├─ Pages    its last pages since it started
//!                                └─          alive or silent
//!   stimuli, joints ──> Contact ────────────> contact state, and pending stimuli
//! ```
//!
//! Live tables, statistics, explanations, replays, the recorder and listings build on these types. The work per packet
//! is bounded, without allocation.

mod claim;
mod contact;
mod per_cell;
mod uplink;

use protocol::message::{Message, NetworkPage, NetworkPages};
use protocol::time::{Micros, Span};

pub use claim::{AddressClaim, HeartbeatKind};
pub use contact::{ContactState, MAX_PENDING_STIMULI, is_stimulus_late};
pub use per_cell::PerCell;
pub use uplink::{UplinkAccount, UplinkCounts};

/// The time of silence after which a cell counts as dead: two periods of its heartbeat plus the jitter of a busy
/// machine, so that one lost frame is tolerated.
pub const DEAD_AFTER: Span = Span::from_millis(600);

/// Maximum age of an answer, in broadcasts before the newest one; older answers are dropped.
pub const MAX_LATE_EPOCHS: usize = 3;

/// The effect of a packet on a cell's state.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct CellUpdate {
    /// The meaning of the packet as a heartbeat, if it is one.
    pub word: Option<HeartbeatKind>,
    /// True if the cell counted as dead before the packet.
    pub revived: bool,
    /// True for the cell's first heartbeat after the bus was lost, if it has not restarted since.
    pub returned: bool,
    /// True if the packet proves that the cell's last start was not one, so that the earlier account continues.
    pub taken_back: bool,
}

/// The state of one cell, from the packets with its node id.
#[derive(Clone, Debug, Default)]
pub struct CellTracker {
    /// Counts of packets that the cell sent and that arrived.
    pub account: UplinkAccount,
    claim: AddressClaim,
    pages: NetworkPages,
    last_packet: Option<Micros>,
    dead: bool,
}

impl CellTracker {
    /// Records a packet that arrived at `at`, and returns its effect; `joints` is the number of the newest joints.
    pub fn record_packet(&mut self, at: Micros, message: &Message, joints: Option<u64>) -> CellUpdate {
        let is_first = self.last_packet.replace(at).is_none();
        let revived = core::mem::take(&mut self.dead);
        self.account.count_packet();
        let Message::Network { page, .. } = message else {
            return CellUpdate { revived, ..CellUpdate::default() };
        };
        let NetworkPage::Heartbeat(heartbeat) = page else {
            self.pages.record_page(page);
            if let NetworkPage::Tree(tree) = page {
                self.account.record_sums_sent(tree.sent, joints);
            }
            return CellUpdate { revived, ..CellUpdate::default() };
        };
        let away = self.account.is_interrupted();
        if !self.claim.is_in_question(at) {
            self.account.confirm_start();
        }
        let mut word = self.claim.receive(at, heartbeat);
        if let HeartbeatKind::Started { again } = &mut word {
            *again |= !is_first;
        }
        let mut taken_back = false;
        match word {
            HeartbeatKind::Continued => self.account.record_heartbeat(heartbeat.sent),
            HeartbeatKind::First => self.account.record_start(heartbeat.sent, false),
            HeartbeatKind::Shared => {
                taken_back = self.account.revoke_start(heartbeat.sent);
                // Some pages may be from the other sender.
                self.pages = NetworkPages::default();
            }
            HeartbeatKind::Started { again } => {
                self.account.record_start(heartbeat.sent, again);
                self.pages = NetworkPages::default();
            }
            HeartbeatKind::Overtaken => self.account.count_overtaken_heartbeat(),
            HeartbeatKind::Claimant | HeartbeatKind::Outsider => self.account.count_foreign_heartbeat(),
        }
        self.account.set_joints_at_heartbeat(joints);
        let returned = away
            && matches!(
                word,
                HeartbeatKind::First | HeartbeatKind::Continued | HeartbeatKind::Started { again: false }
            );
        CellUpdate { word: Some(word), revived, returned, taken_back }
    }

    /// Returns the owner of the node id, and its last heartbeat.
    #[must_use]
    pub const fn claim(&self) -> &AddressClaim {
        &self.claim
    }

    /// Returns the last page of each kind since the cell started.
    #[must_use]
    pub const fn pages(&self) -> &NetworkPages {
        &self.pages
    }

    /// Returns the arrival time of the cell's last packet.
    #[must_use]
    pub const fn last_packet(&self) -> Option<Micros> {
        self.last_packet
    }

    /// Handles the timeout of a silent cell. Returns true if the cell counts as dead from this call on.
    pub fn handle_timeout(&mut self, now: Micros) -> bool {
        let silent = self.is_silent(now);
        let falls = silent && !self.dead;
        self.dead |= silent;
        falls
    }

    /// Returns true if the cell counts as dead: its timeout has expired, and it has sent nothing since.
    #[must_use]
    pub const fn is_dead(&self) -> bool {
        self.dead
    }

    /// Returns true if the cell has sent packets and has then been silent for longer than [`DEAD_AFTER`].
    #[must_use]
    pub fn is_silent(&self, now: Micros) -> bool {
        self.last_packet.is_some_and(|last| now.elapsed_since(last) > DEAD_AFTER)
    }
}
