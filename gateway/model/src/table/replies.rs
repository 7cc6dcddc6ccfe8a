//! Due replies compared with received ones.

use derive_more::{Add, Sum};
use protocol::parameters::MAX_JOINTS;

use super::errors::Errors;
use super::stuck::StuckDetector;
use crate::tracker::MAX_LATE_EPOCHS;

/// Replies of one cell: due = in time + late + missing.
///
/// A reply is due when the cell is configured, awake, and in contact by Algorithm 1.
#[derive(Add, Clone, Copy, Debug, Default, Eq, PartialEq, Sum)]
pub struct Replies {
    /// Number of epochs with a due reply.
    pub due: u64,
    /// Replies before the next broadcast.
    pub in_time: u64,
    /// Replies after it.
    pub late: u64,
    /// Epochs without a reply.
    pub missing: u64,
    /// Missing replies of a cell that was dead or restarted, or whose bus was lost.
    pub in_doubt: u64,
    /// Torques that were not due: ends of contacts, and the next two counts.
    pub unasked: u64,
    /// Torques among these from cells with an unknown contact state.
    pub contact_unknown: u64,
    /// Non-zero torques among these from cells with a known contact state: they were not touched, or could not be
    /// expected to answer.
    pub unexpected: u64,
    /// Torques that arrived after their epoch, or after a torque of the same cell for a later epoch, and were dropped.
    pub too_late: u64,
}

impl Replies {
    /// Sums the accounts of several cells.
    #[must_use]
    pub fn total(all: impl Iterator<Item = Self>) -> Self {
        all.sum()
    }

    pub(super) fn miss(&mut self, count: u32, is_in_doubt: bool) {
        self.missing += u64::from(count);
        self.in_doubt += if is_in_doubt { u64::from(count) } else { 0 };
    }
}

/// The expectation of a received torque.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum ReplyExpectation {
    /// It was due.
    Due,
    /// It was not due, by the known contact state of the cell.
    NotDue,
    /// The contact state of its cell was unknown.
    Unknown,
}

/// The central torques of one epoch, in Nm.
#[derive(Clone, Copy, Debug)]
pub(super) struct Expected {
    pub(super) number: u64,
    pub(super) quantised: [f64; MAX_JOINTS],
    pub(super) unquantised: [f64; MAX_JOINTS],
}

/// The outstanding replies of a cell for the newest epochs.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Outstanding {
    /// Bit n: the n-th broadcast before the newest one is due and not answered yet.
    due: u8,
    /// Bit n: the cell's contact was known at the n-th broadcast before the newest one.
    known: u8,
    expected: [Option<Expected>; MAX_LATE_EPOCHS + 1],
    /// Errors of its answers.
    pub(super) errors: Errors,
    /// Its words compared with the expected ones.
    pub(super) stuck: StuckDetector,
}

impl Outstanding {
    /// Starts a broadcast, to be answered if `due`; `is_known` if the cell's contact is known. Returns true if the
    /// oldest broadcast is unanswered and can no longer be answered.
    pub(super) fn open(&mut self, due: bool, is_known: bool) -> bool {
        let oldest = 1 << MAX_LATE_EPOCHS;
        let unanswered = self.due & oldest != 0;
        self.due = (self.due & (oldest - 1)) << 1 | u8::from(due);
        self.known = (self.known & (oldest - 1)) << 1 | u8::from(is_known);
        unanswered
    }

    /// Resets the due replies.
    pub(super) fn begin_accounts(&mut self) {
        *self = Self { known: self.known, ..Self::default() };
    }

    /// Starts a broadcast and drops all earlier ones.
    pub(super) fn open_only(&mut self, due: bool, is_known: bool) {
        (self.due, self.known) = (u8::from(due), u8::from(is_known));
    }

    /// Returns true if the newest broadcast must be answered.
    pub(super) const fn is_due(&self) -> bool {
        self.due & 1 != 0
    }

    /// Records the answer to the broadcast `lag` before the newest; returns whether it was due.
    pub(super) const fn answer(&mut self, lag: usize) -> ReplyExpectation {
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

    /// Clears the outstanding replies, and the knowledge of the contact at their broadcasts. Returns the number of
    /// outstanding replies.
    pub(super) const fn clear(&mut self) -> u32 {
        let due = self.due.count_ones();
        (self.due, self.known) = (0, 0);
        due
    }

    /// Records the expected newest answer.
    pub(super) fn expect(&mut self, expected: Expected) {
        self.expected.rotate_right(1);
        if let Some(newest) = self.expected.first_mut() {
            *newest = Some(expected);
        }
    }

    /// Returns the expected answer to a broadcast.
    pub(super) fn expected(&self, number: u64) -> Option<Expected> {
        self.expected.iter().flatten().find(|expected| expected.number == number).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_to_the_broadcast_so_many_before_the_newest_and_counts_once() {
        let mut outstanding = Outstanding::default();
        use ReplyExpectation::{Due, NotDue, Unknown};
        let broadcasts = [(false, false), (true, true), (false, true), (true, true)];
        broadcasts.into_iter().for_each(|(due, is_known)| _ = outstanding.open(due, is_known));
        assert!(outstanding.is_due());
        let answers = [0, 0, 1, 2, 2, 3].map(|lag| outstanding.answer(lag));
        assert_eq!(answers, [Due, NotDue, NotDue, Due, NotDue, Unknown]);
        assert_eq!(outstanding.clear(), 0);
        (0..5).for_each(|_| _ = outstanding.open(true, true));
        assert_eq!(outstanding.clear(), 4, "the newest, and three before it");
        assert_eq!(outstanding.answer(0), Unknown, "what was known is in doubt");
    }
}
