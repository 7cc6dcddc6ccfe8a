//! Counts of replies: due, in time, late and missing.

use derive_more::{Add, Sum};
use protocol::parameters::MAX_JOINTS;

use super::errors::TorqueErrors;
use super::stuck::StuckDetector;
use crate::tracker::MAX_LATE_EPOCHS;

/// Replies of one cell: due = in time + late + missing.
///
/// A reply is due when the cell is configured, awake, and in contact by Algorithm 1.
#[derive(Add, Clone, Copy, Debug, Default, Eq, PartialEq, Sum)]
pub struct Replies {
    /// Number of epochs in which a reply was due.
    pub due: u64,
    /// Due replies that arrived before the next broadcast.
    pub in_time: u64,
    /// Due replies that arrived after the next broadcast.
    pub late: u64,
    /// Epochs in which a due reply never arrived.
    pub missing: u64,
    /// Missing replies that the cell may not be to blame for: it had died or restarted, or its bus was lost.
    pub in_doubt: u64,
    /// Torques that were not due: ends of contacts, and those in `contact_unknown` and `unexpected`.
    pub unasked: u64,
    /// Torques from cells whose contact state was unknown.
    pub contact_unknown: u64,
    /// Non-zero torques from cells that were known not to be in contact, or could not be expected to answer.
    pub unexpected: u64,
    /// Torques that were dropped because they arrived after their epoch had closed, or after a torque of the same cell
    /// for a later epoch.
    pub too_late: u64,
}

impl Replies {
    /// Adds up the counts of several cells.
    #[must_use]
    pub fn total(all: impl Iterator<Item = Self>) -> Self {
        all.sum()
    }

    pub(super) fn count_missing(&mut self, count: u32, is_in_doubt: bool) {
        self.missing += u64::from(count);
        self.in_doubt += if is_in_doubt { u64::from(count) } else { 0 };
    }
}

/// The classification of a received torque as due or not.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum ReplyExpectation {
    /// The torque was due.
    Due,
    /// The torque was not due, by the known contact state of the cell.
    NotDue,
    /// The contact state of its cell was unknown.
    Unknown,
}

/// The central torques of one epoch that a cell's answer is compared with, in Nm.
#[derive(Clone, Copy, Debug)]
pub(super) struct ExpectedTorques {
    pub(super) number: u64,
    pub(super) quantised: [f64; MAX_JOINTS],
    pub(super) unquantised: [f64; MAX_JOINTS],
}

/// The replies of one cell that are still outstanding for the newest epochs.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct OutstandingReplies {
    /// Bit n is set if the n-th broadcast before the newest one is due and not answered yet.
    due: u8,
    /// Bit n is set if the cell's contact was known at the n-th broadcast before the newest one.
    known: u8,
    expected: [Option<ExpectedTorques>; MAX_LATE_EPOCHS + 1],
    /// Errors of the cell's torques.
    pub(super) errors: TorqueErrors,
    /// The cell's words beside the expected ones, to detect words that stay constant.
    pub(super) stuck: StuckDetector,
}

impl OutstandingReplies {
    /// Starts a broadcast, which the cell must answer if `due`; `is_known` is true if its contact is known. Returns
    /// true if the oldest broadcast was due and can no longer be answered.
    pub(super) fn open_broadcast(&mut self, due: bool, is_known: bool) -> bool {
        let oldest = 1 << MAX_LATE_EPOCHS;
        let unanswered = self.due & oldest != 0;
        self.due = (self.due & (oldest - 1)) << 1 | u8::from(due);
        self.known = (self.known & (oldest - 1)) << 1 | u8::from(is_known);
        unanswered
    }

    /// Drops the outstanding replies, so that earlier epochs do not count.
    pub(super) fn reset_counts(&mut self) {
        *self = Self { known: self.known, ..Self::default() };
    }

    /// Starts a broadcast, and drops all earlier outstanding replies.
    pub(super) fn restart_with(&mut self, due: bool, is_known: bool) {
        (self.due, self.known) = (u8::from(due), u8::from(is_known));
    }

    /// Returns true if the cell must answer the newest broadcast.
    pub(super) const fn is_reply_due(&self) -> bool {
        self.due & 1 != 0
    }

    /// Records the answer to the broadcast `lag` broadcasts before the newest one. Returns whether the answer was due.
    pub(super) const fn record_answer(&mut self, lag: usize) -> ReplyExpectation {
        let bit = 1 << lag;
        let was_due = self.due & bit != 0;
        self.due &= !bit;
        if was_due {
            ReplyExpectation::Due
        } else if self.known & bit != 0 {
            ReplyExpectation::NotDue
        } else {
            ReplyExpectation::Unknown
        }
    }

    /// Clears the outstanding replies, and marks the contact at their broadcasts as unknown. Returns the number of
    /// replies that were outstanding.
    pub(super) const fn clear_outstanding(&mut self) -> u32 {
        let due = self.due.count_ones();
        (self.due, self.known) = (0, 0);
        due
    }

    /// Sets the torques that are expected in answer to the newest broadcast.
    pub(super) fn expect_torques(&mut self, expected: ExpectedTorques) {
        self.expected.rotate_right(1);
        if let Some(newest) = self.expected.first_mut() {
            *newest = Some(expected);
        }
    }

    /// Returns the torques that are expected in answer to the broadcast with this number, if known.
    pub(super) fn expected_torques(&self, number: u64) -> Option<ExpectedTorques> {
        self.expected.iter().flatten().find(|expected| expected.number == number).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_to_the_broadcast_so_many_before_the_newest_and_counts_once() {
        let mut outstanding = OutstandingReplies::default();
        use ReplyExpectation::{Due, NotDue, Unknown};
        let broadcasts = [(false, false), (true, true), (false, true), (true, true)];
        broadcasts.into_iter().for_each(|(due, is_known)| _ = outstanding.open_broadcast(due, is_known));
        assert!(outstanding.is_reply_due());
        let answers = [0, 0, 1, 2, 2, 3].map(|lag| outstanding.record_answer(lag));
        assert_eq!(answers, [Due, NotDue, NotDue, Due, NotDue, Unknown]);
        assert_eq!(outstanding.clear_outstanding(), 0);
        (0..5).for_each(|_| _ = outstanding.open_broadcast(true, true));
        assert_eq!(outstanding.clear_outstanding(), 4, "the newest, and three before it");
        assert_eq!(outstanding.record_answer(0), Unknown, "what was known is in doubt");
    }
}
