//! Compares a heartbeat with a *life* of a cell: the time from one start of the cell to the next.

use protocol::message::{Heartbeat, State};
use protocol::time::{Micros, Span};

use crate::tracker::DEAD_AFTER;

/// A packet counter that falls back by more than this proves a restart. A smaller step back may be a heartbeat that was
/// overtaken by others.
pub(super) const MAX_OVERTAKEN_PACKETS: u16 = 128;

/// Upper bound of the packets that a cell sends until it counts as dead: three packets for each of 500 joints per
/// second make 900 in that time.
pub(super) const MAX_PACKETS_BEFORE_DEAD: u16 = 2_048;

/// Upper bound of the packets that a cell sends between two heartbeats.
pub(super) const MAX_PACKETS_PER_HEARTBEAT: u16 = 256;

/// The time without a heartbeat after which a cell is no longer expected to continue its counter.
pub(super) const COUNTER_FORGOTTEN_AFTER: Span = Span::from_millis(10_000);

/// The minimum duration of a claim: 250 ms, minus 10 ms by which a frame may have been late.
pub(super) const MIN_CLAIM_TIME: Span = Span::from_millis(240);

/// A life of a cell, from one start to the next, with the last heartbeat in it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct Incarnation {
    pub(super) heartbeat: Heartbeat,
    pub(super) at: Micros,
    /// Time of the claim with which the life began, if the claim was received.
    pub(super) claimed: Option<Micros>,
}

impl Incarnation {
    /// Creates a life from its first heartbeat.
    pub(super) fn new(at: Micros, heartbeat: &Heartbeat) -> Self {
        let claimed = heartbeat.state.has(State::CLAIMING_NODE_ID).then_some(at);
        Self { heartbeat: *heartbeat, at, claimed }
    }

    /// Returns this life, with the last heartbeat of `last`.
    pub(super) const fn with_heartbeat_of(self, last: Self) -> Self {
        Self { claimed: self.claimed, ..last }
    }

    /// Returns true if the cell owns the node id, and does not only claim it.
    pub(super) fn owns_node_id(&self) -> bool {
        !self.heartbeat.state.has(State::CLAIMING_NODE_ID)
    }

    /// Returns true if the last heartbeat is the first packet since the start of the cell, which is a claim.
    pub(super) fn has_just_started(&self) -> bool {
        !self.owns_node_id() && self.heartbeat.sent == 0
    }

    pub(super) const fn is_same_cell(&self, other: &Self) -> bool {
        self.heartbeat.serial == other.heartbeat.serial
    }

    pub(super) fn is_alive(&self, at: Micros) -> bool {
        at.elapsed_since(self.at) <= DEAD_AFTER
    }

    /// Returns true if the cell may still be alive at `at`, though silent because its bus was lost.
    pub(super) fn may_still_be_alive(&self, at: Micros) -> bool {
        at.elapsed_since(self.at) <= COUNTER_FORGOTTEN_AFTER
    }

    /// Returns how far the counter of `other` is behind this one, modulo 2^16.
    pub(super) const fn packets_ahead_of(&self, other: &Self) -> u16 {
        self.heartbeat.sent.wrapping_sub(other.heartbeat.sent)
    }

    /// Returns the number of packets that the cell sent between its last heartbeat and `next`; `None` if `next` cannot
    /// be its next heartbeat.
    pub(super) fn packets_until(&self, next: &Self) -> Option<u16> {
        let sent = next.packets_ahead_of(self);
        let is_next = self.is_same_cell(next) && self.may_still_be_alive(next.at) && sent.cast_signed() > 0;
        (is_next && self.can_have_sent(next.at, sent)).then_some(sent)
    }

    /// Returns true if the cell can have sent this number of packets from its last heartbeat to the time `at`.
    pub(super) fn can_have_sent(&self, at: Micros, sent: u16) -> bool {
        u64::from(sent)
            <= u64::from(MAX_PACKETS_BEFORE_DEAD) * (1 + at.elapsed_since(self.at).0 / DEAD_AFTER.0)
    }

    /// Returns true if a heartbeat is an old one of this life, or a copy of its last one.
    pub(super) fn is_own_old_heartbeat(&self, old: &Self) -> bool {
        let back = self.packets_ahead_of(old);
        self.is_same_cell(old) && (back == 0 || back <= MAX_OVERTAKEN_PACKETS && old.heartbeat.sent > 1)
    }

    /// Returns true if this life still claims the node id at the time of `next`, so that a heartbeat without CLAIMING
    /// cannot be from it.
    pub(super) fn is_still_claiming_at(&self, next: &Self) -> bool {
        let settles = !self.owns_node_id() && next.owns_node_id();
        settles && self.claimed.is_some_and(|claimed| next.at.elapsed_since(claimed) < MIN_CLAIM_TIME)
    }
}
