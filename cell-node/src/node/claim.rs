//! The address claim of a cell: it claims its node id at the start, defends it, and repeats it in each heartbeat.

use protocol::message::{Heartbeat, NetworkPage, RejectedCounts, State};
use protocol::time::{Micros, Span};

use super::Node;
use crate::identity::Identity;
use crate::phase;

/// Interval of heartbeats.
pub const HEARTBEAT_INTERVAL: Span = Span::from_millis(250);
/// Minimum time for which a new cell checks whether another cell uses its node id.
pub const MIN_CLAIM_TIME: Span = Span::from_millis(250);
/// Time over which the first heartbeats of cells are spread by serial number. Without it, two cells with one node id
/// that are switched on together would send different data with one identifier in the same bit time.
const FIRST_HEARTBEAT_SPREAD: Span = Span::from_millis(64);
/// Minimum interval between two defences of the node id.
const MIN_DEFENCE_INTERVAL: Span = Span::from_millis(10);

/// The stage of an address claim.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum ClaimStage {
    /// The claim has not been sent yet.
    Unsent,
    /// The claim has been sent. The cell waits for objections of another cell with the node id.
    Sent,
    /// The cell owns the node id.
    Settled,
}

/// The state of the address claim, and of the heartbeats that carry it.
#[derive(Debug)]
pub(super) struct AddressClaim {
    pub(super) stage: ClaimStage,
    pub(super) next_heartbeat: Micros,
    /// True if a sync has requested a heartbeat, which is sent at the end of the present epoch.
    pub(super) sync_waits: bool,
    /// The time of the last defence of the node id.
    defended: Option<Micros>,
    /// The serial number of another cell that owns this cell's node id.
    pub(super) other_owner: Option<u32>,
}

impl AddressClaim {
    /// Starts a claim. Without a node id, the claim is never sent.
    pub(super) fn new(identity: Identity, now: Micros) -> Self {
        let wait = phase::send_offset_by_serial(FIRST_HEARTBEAT_SPREAD, identity.serial);
        let next_heartbeat = identity.cell.map_or(Micros(u64::MAX), |_| now + wait);
        Self {
            stage: ClaimStage::Unsent,
            next_heartbeat,
            sync_waits: false,
            defended: None,
            other_owner: None,
        }
    }

    /// Returns true if this cell owns the node id.
    pub(super) fn owns_node_id(&self) -> bool {
        self.stage == ClaimStage::Settled
    }
}

impl Node {
    /// Sends a heartbeat if it is due. The first one is the address claim; with the second the cell owns the node id.
    pub(super) fn send_due_heartbeat(&mut self, now: Micros) {
        let Some(cell) = self.identity.cell.filter(|_| now >= self.claim.next_heartbeat) else { return };
        if self.claim.stage == ClaimStage::Unsent {
            self.claim.stage = ClaimStage::Sent;
            self.claim.next_heartbeat =
                now + MIN_CLAIM_TIME + phase::send_offset_by_node_id(HEARTBEAT_INTERVAL, cell);
            return self.push_heartbeat();
        }
        self.claim.stage = ClaimStage::Settled;
        self.send_regular_heartbeat(now);
    }

    /// Sends a heartbeat, and all pages that have changed, four times a second.
    pub(super) fn send_regular_heartbeat(&mut self, now: Micros) {
        self.push_heartbeat();
        self.report_tree_with_heartbeat(now);
        let pages = self.sensing.heartbeat_pages(now);
        self.push_sensor_pages(pages);
        self.report_zero_with_heartbeat();
        self.claim.next_heartbeat = phase::next_send_time(self.claim.next_heartbeat, HEARTBEAT_INTERVAL, now);
    }

    /// Handles a frame that another cell has sent with this cell's node id. During its claim, this cell gives way,
    /// unless the other cell also claims the node id and has the larger serial number. Once this cell owns the node id,
    /// it defends it, but only against claims: otherwise two cells that own it would answer each other forever.
    pub(super) fn handle_own_node_id(&mut self, now: Micros, page: &NetworkPage) {
        self.flags = self.flags.with_flags(State::DUPLICATE, true);
        let other = if let NetworkPage::Heartbeat(other) = page { Some(other) } else { None };
        let claims = other.is_some_and(|other| other.state.has(State::CLAIMING_NODE_ID));
        let stays = claims && other.is_some_and(|other| other.serial > self.identity.serial);
        if !self.claim.owns_node_id() && !stays {
            self.claim.other_owner = Some(other.map_or(0, |other| other.serial));
        } else if claims && self.claim.defended.is_none_or(|at| now.elapsed_since(at) >= MIN_DEFENCE_INTERVAL)
        {
            self.claim.defended = Some(now);
            self.push_heartbeat();
        }
    }

    /// Returns the state word: the stored flags and those that follow from other values.
    pub(super) fn state(&self) -> State {
        let in_use = self.configuration.active_parameters();
        self.flags
            .with_flags(State::CONFIGURED, in_use.is_some())
            .with_flags(State::ACTIVE, self.active)
            .with_flags(State::CLAIMING_NODE_ID, !self.claim.owns_node_id())
            .with_joint(in_use.map_or(0, |in_use| in_use.parameters.joint))
    }

    pub(super) fn push_heartbeat(&mut self) {
        let RejectedCounts { length, crc, foreign, meaning, incomplete, stimuli } = self.receiver.refused;
        let rejected =
            [length, crc, foreign, meaning, incomplete, stimuli].into_iter().fold(0, u16::wrapping_add);
        let heartbeat = Heartbeat {
            serial: self.identity.serial,
            configuration: self.configuration.parameters_hash(),
            // The packets before this one.
            sent: self.sent.wrapping_add(self.outbox.len().into()),
            rejected,
            state: self.state(),
        };
        self.flags = self.flags.with_flags(State::SATURATED, false).with_flags(State::DUPLICATE, false);
        self.push_network_page(NetworkPage::Heartbeat(heartbeat));
    }
}
