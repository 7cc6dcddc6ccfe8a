//! A heartbeat compared with one life of a cell, from a start to the next.

use protocol::message::{Heartbeat, State};
use protocol::time::{Micros, Span};

use crate::tracker::DEAD_AFTER;

/// A counter that falls back by more than this is of a cell that has restarted, not of an overtaken heartbeat.
pub(super) const OVERTAKES: u16 = 128;

/// More than a cell sends until it is found dead: three packets for each of 500 joints a second are 900.
pub(super) const AT_MOST: u16 = 2_048;

/// More than a cell sends between two heartbeats.
pub(super) const LEAP: u16 = 256;

/// A cell whose counter goes on after so long without a heartbeat is not looked for any more.
pub(super) const GONE_AFTER: Span = Span::from_millis(10_000);

/// A cell claims its id for 250 ms or longer; less 10 ms, by which a frame may have been late.
pub(super) const CLAIM_TAKES: Span = Span::from_millis(240);

/// A cell from one start to the next: its last heartbeat.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct Life {
    pub(super) heartbeat: Heartbeat,
    pub(super) at: Micros,
    /// Time of its claim, if that was received.
    pub(super) claimed: Option<Micros>,
}

impl Life {
    /// A life of which this is the first heartbeat.
    pub(super) fn new(at: Micros, heartbeat: &Heartbeat) -> Self {
        let claimed = heartbeat.state.has(State::CLAIMING).then_some(at);
        Self { heartbeat: *heartbeat, at, claimed }
    }

    /// The same life after another heartbeat.
    pub(super) const fn with_last(self, last: Self) -> Self {
        Self { claimed: self.claimed, ..last }
    }

    /// Returns whether it has the id, and does not only claim it.
    pub(super) fn is_settled(&self) -> bool {
        !self.heartbeat.state.has(State::CLAIMING)
    }

    /// Returns whether its last heartbeat is the first packet of a cell since it started, which is a claim.
    pub(super) fn has_just_started(&self) -> bool {
        !self.is_settled() && self.heartbeat.sent == 0
    }

    pub(super) const fn is_same_cell(&self, other: &Self) -> bool {
        self.heartbeat.serial == other.heartbeat.serial
    }

    pub(super) fn is_alive(&self, at: Micros) -> bool {
        at.since(self.at) <= DEAD_AFTER
    }

    /// Returns whether it may go on; its bus may have been lost.
    pub(super) fn may_go_on(&self, at: Micros) -> bool {
        at.since(self.at) <= GONE_AFTER
    }

    /// Returns how far another one's counter is behind its own, modulo 2^16.
    pub(super) const fn back(&self, other: &Self) -> u16 {
        self.heartbeat.sent.wrapping_sub(other.heartbeat.sent)
    }

    /// Returns how many packets it has sent since its last heartbeat, if this one can be its next.
    pub(super) fn sent(&self, next: &Self) -> Option<u16> {
        let sent = next.back(self);
        let is_next = self.is_same_cell(next) && self.may_go_on(next.at) && sent.cast_signed() > 0;
        (is_next && self.has_time_for(next.at, sent)).then_some(sent)
    }

    /// Returns whether a cell can have sent so many packets since this one's last heartbeat.
    pub(super) fn has_time_for(&self, at: Micros, sent: u16) -> bool {
        u64::from(sent) <= u64::from(AT_MOST) * (1 + at.since(self.at).0 / DEAD_AFTER.0)
    }

    /// Returns whether a heartbeat is an old one of it, or its last one again.
    pub(super) fn is_past(&self, old: &Self) -> bool {
        let back = self.back(old);
        self.is_same_cell(old) && (back == 0 || back <= OVERTAKES && old.heartbeat.sent > 1)
    }

    /// Returns whether it still claims the id, so that a heartbeat without CLAIMING is not its.
    pub(super) fn claims_until(&self, next: &Self) -> bool {
        let settles = !self.is_settled() && next.is_settled();
        settles && self.claimed.is_some_and(|claimed| next.at.since(claimed) < CLAIM_TAKES)
    }
}
