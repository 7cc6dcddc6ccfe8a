//! Counts of the comparison of replies with recorded ones.

use protocol::packet::Words;
use serde::Serialize;

use crate::replay::difference::DifferenceKind;

/// Counts of compared replies.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Tally {
    /// Replies equal to the recorded ones.
    pub equal: u64,
    /// Replies with other words.
    pub different: u64,
    /// Recorded replies that did not come.
    pub missing: u64,
    /// Replies that were not recorded, without an explanation in the recording.
    pub extra: u64,
    /// Recorded replies to joints that a bus refused in this replay.
    pub not_requested: u64,
    /// Sums, less their children, among the equal replies.
    pub sums: u64,
    /// Torques and sums among the equal replies that are equal only within the tolerance.
    pub tolerated: u64,
    /// Words of torques, in steps of Q3.12.
    pub torque_words: Steps,
    /// Words of sums less their children, in steps of Q7.8.
    pub sum_words: Steps,
    /// Replies that the recording lacks, or whose joints it lacks.
    pub lacking: Uncompared,
}

/// Histogram of the differences between words and recorded ones, in steps.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Steps {
    /// Number of words that differ by 0, 1, ... steps; the last entry counts all larger differences too.
    pub by_steps: [u64; 9],
    /// Largest difference.
    pub max: u32,
}

impl Steps {
    /// Counts the words of one reply. Returns the largest difference among them.
    pub(super) fn count(&mut self, differences: impl IntoIterator<Item = u32>) -> u32 {
        let mut max = 0;
        for steps in differences {
            max = max.max(steps);
            let last = self.by_steps.len() - 1;
            if let Some(count) = self.by_steps.get_mut(usize::try_from(steps).map_or(last, |it| it.min(last)))
            {
                *count += 1;
            }
        }
        self.max = self.max.max(max);
        max
    }
}

/// Replies that were not recorded, or not with their joints, by the reason that the recording shows.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Uncompared {
    /// The cell was silent in the recording: absent, killed, hung, or claiming its node id.
    pub silent: u64,
    /// The cell missed this many joints, by its own counters.
    pub untaken: u64,
    /// The cell sent more packets than were recorded, by its own counters.
    pub unrecorded: u64,
    /// The recording ended before its last joints, or its last `configure`, were answered.
    pub ended: u64,
    /// The end of a contact, sent later because the cell missed the joints at which it ended.
    pub said_later: u64,
    /// Replies of touched cells at joints for which no counters tell how many the cell received: in a part of a
    /// recording, before the first report and after the last one.
    pub uncounted: u64,
    /// Recorded replies whose joints were not recorded.
    pub joints_unrecorded: u64,
    /// Recorded replies whose joints were on the bus before the part began.
    pub joints_earlier: u64,
    /// Recorded answers to `configure` messages from before the part.
    pub requested_earlier: u64,
    /// Recorded replies of cells that measured: the recording has no measured forces.
    pub measured: u64,
    /// Unrequested sensor frames, sent at another time than now.
    pub sensed_otherwise: u64,
    /// Sums of cells that had started a contact but missed their slot.
    pub slot_skipped: u64,
    /// Sums of cells that were changing their parent in that epoch, or whose children were, then or now.
    pub parent_changing: u64,
    /// Sums of epochs in which a cell had not reported its parent, then or now.
    pub tree_unknown: u64,
    /// Sums that do not contain those of all children, then or now.
    pub sums_not_taken: u64,
}

impl Tally {
    /// Counts a reply that differs from the recorded one. Joints that a bus refused get no reply.
    pub(super) const fn count(&mut self, how: DifferenceKind, is_unsent: bool) {
        let count = match how {
            DifferenceKind::Missing if is_unsent => &mut self.not_requested,
            DifferenceKind::Missing => &mut self.missing,
            DifferenceKind::Different => &mut self.different,
            DifferenceKind::Extra => &mut self.extra,
        };
        *count += 1;
    }

    /// Compares a torque's words within `tolerance` steps. Returns true if they are equal.
    pub(super) fn compare_torque(&mut self, recorded: &Words, now: &Words, tolerance: u16) -> bool {
        let steps = recorded
            .as_slice()
            .iter()
            .zip(now.as_slice())
            .map(|(recorded, now)| recorded.abs_diff(*now).into());
        let max = self.torque_words.count(steps);
        let is_equal = recorded.length() == now.length() && max <= u32::from(tolerance);
        self.tolerated += u64::from(is_equal && max > 0);
        is_equal
    }

    /// Returns true if no sum could be compared because their trees are unknown.
    #[must_use]
    pub const fn lacks_the_tree(&self) -> bool {
        self.sums == 0 && self.lacking.tree_unknown > 0
    }

    /// Returns true if all replies are equal and no other replies came.
    #[must_use]
    pub const fn is_good(&self) -> bool {
        self.different == 0
            && self.missing == 0
            && self.extra == 0
            && self.not_requested == 0
            && !self.lacks_the_tree()
    }
}
