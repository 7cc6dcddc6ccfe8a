//! Counts of the comparison of replies with recorded ones.

use protocol::packet::Words;
use serde::Serialize;

use crate::replay::difference::DifferenceKind;

/// Counts of compared replies.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct ReplyTally {
    /// Replies equal to the recorded ones.
    pub equal: u64,
    /// Replies with other words.
    pub different: u64,
    /// Recorded replies that did not come.
    pub missing: u64,
    /// Replies that were not recorded, without a reason in the recording for their absence.
    pub extra: u64,
    /// Recorded replies to joints that a bus refused in this replay.
    pub not_requested: u64,
    /// Number of sums among the equal replies. Sums are compared after the children's sums are subtracted.
    pub sums: u64,
    /// Torques and sums among the equal replies that are equal only within the tolerance.
    pub tolerated: u64,
    /// Differences between words of torques, in steps of Q3.12 (2
    /// -12 Nm).
    pub torque_words: StepHistogram,
    /// Differences between words of sums without the children's sums, in steps of Q7.8 (2
    /// -8 Nm).
    pub sum_words: StepHistogram,
    /// Replies that have no recorded counterpart, or whose joints were not recorded.
    pub lacking: UncomparedReplies,
}

/// Histogram of the differences between words in this replay and in the recording, in steps.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct StepHistogram {
    /// Number of words that differ by 0, 1, ... steps; the last entry counts all larger differences too.
    pub by_steps: [u64; 9],
    /// Largest difference in steps.
    pub max: u32,
}

impl StepHistogram {
    /// Counts the differences between the words of one reply and the recorded ones. Returns the largest of them.
    pub(super) fn count_step_differences(&mut self, differences: impl IntoIterator<Item = u32>) -> u32 {
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

/// Replies that lack a recorded counterpart or recorded joints, by the reason that the recording shows.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct UncomparedReplies {
    /// Replies of cells that were silent in the recording: absent, killed, hung, or claiming their node id.
    pub silent: u64,
    /// Replies to joints that the cell missed in the recording, by its own counters.
    pub untaken: u64,
    /// Replies that the cell sent in the recording, by its own counters, but that were not recorded.
    pub unrecorded: u64,
    /// Replies to the last joints or the last `configure`, after which the recording ended.
    pub ended: u64,
    /// Ends of contacts that the cell sent later in the recording, because it had missed the joints at which the
    /// contact ended.
    pub said_later: u64,
    /// Replies of touched cells at joints for which counters do not show how many the cell received. In a part of a
    /// recording, these are the joints before the first report and after the last one.
    pub uncounted: u64,
    /// Recorded replies whose joints were not recorded.
    pub joints_unrecorded: u64,
    /// Recorded replies whose joints were on the bus before the part began.
    pub joints_earlier: u64,
    /// Recorded answers to `configure` messages from before the part.
    pub requested_earlier: u64,
    /// Recorded replies of cells that measured. They are not compared, because the recording does not contain the
    /// measured forces.
    pub measured: u64,
    /// Sensor frames that cells sent without request, at other times than in the recording.
    pub sensed_otherwise: u64,
    /// Sums of cells whose contact had begun in the recording but that missed their slot.
    pub slot_skipped: u64,
    /// Sums in an epoch in which the cell or one of its children changed its parent, in the recording or in this
    /// replay.
    pub parent_changing: u64,
    /// Sums in an epoch in which some cell had not reported its parent, in the recording or in this replay.
    pub tree_unknown: u64,
    /// Sums that do not contain the sums of all children, in the recording or in this replay.
    pub sums_not_taken: u64,
}

impl ReplyTally {
    /// Counts a reply that differs from the recorded one. A missing reply to joints that the bus refused (`is_unsent`)
    /// counts as not requested.
    pub(super) const fn count_difference(&mut self, how: DifferenceKind, is_unsent: bool) {
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
        let max = self.torque_words.count_step_differences(steps);
        let is_equal = recorded.length() == now.length() && max <= u32::from(tolerance);
        self.tolerated += u64::from(is_equal && max > 0);
        is_equal
    }

    /// Returns true if sums had to be left out because their trees are unknown, and none could be compared.
    #[must_use]
    pub const fn lacks_known_trees(&self) -> bool {
        self.sums == 0 && self.lacking.tree_unknown > 0
    }

    /// Returns true if all recorded replies came and are equal, and no others came.
    #[must_use]
    pub const fn has_only_equal_replies(&self) -> bool {
        self.different == 0
            && self.missing == 0
            && self.extra == 0
            && self.not_requested == 0
            && !self.lacks_known_trees()
    }
}
