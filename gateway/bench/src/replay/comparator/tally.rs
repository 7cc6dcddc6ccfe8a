//! How replies and recorded ones compare, in counts.

use protocol::packet::Words;
use serde::Serialize;

use crate::replay::difference::How;

/// Counts of compared replies.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Tally {
    /// Replies that came back as they were recorded.
    pub equal: u64,
    /// Replies that came back with other words.
    pub different: u64,
    /// Recorded replies that did not come back.
    pub missing: u64,
    /// Replies that were not recorded, and the recording does not explain it.
    pub extra: u64,
    /// Recorded replies to joints that a bus did not take from this replay.
    pub not_requested: u64,
    /// Among the equal ones, sums less their children.
    pub sums: u64,
    /// Among the equal ones, torques and sums that are so only because differences are tolerated.
    pub tolerated: u64,
    /// Words of torques, in steps of Q3.12.
    pub torque_words: Steps,
    /// Words of sums less their children, in steps of Q7.8.
    pub sum_words: Steps,
    /// What the recording itself lacks.
    pub lacking: Lacking,
}

/// By how many steps words differ from the recorded ones.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Steps {
    /// How many differ by 0, by 1, ...; the last by so many or more.
    pub by_steps: [u64; 9],
    /// The largest difference.
    pub max: u32,
}

impl Steps {
    /// Counts the words of one reply; the largest difference among them.
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
pub struct Lacking {
    /// The cell was silent then: absent, killed, hung, or claiming its node id.
    pub silent: u64,
    /// The cell did not take so many joints, by its own counters.
    pub untaken: u64,
    /// The cell sent more packets than were recorded, by its own counters.
    pub unrecorded: u64,
    /// The last joints, or the last `configure`, of the recording: it ended before they were answered.
    pub ended: u64,
    /// The end of a contact, sent later because the cell did not take the joints at which it was.
    pub said_later: u64,
    /// Replies of touched cells, at joints for which no counters tell how many the cell took: in a part of a recording
    /// before the first report and after the last one.
    pub uncounted: u64,
    /// Recorded replies whose joints were not recorded.
    pub joints_unrecorded: u64,
    /// Recorded replies whose joints were on the bus before the part began.
    pub joints_earlier: u64,
    /// Recorded answers to `configure` messages from before the part.
    pub requested_earlier: u64,
    /// Recorded replies of cells that measured: their measured forces were not recorded.
    pub measured: u64,
    /// Unrequested sensors frames, sent at another time than now.
    pub sensed_otherwise: u64,
    /// Sums of cells that had sent one, had not sent the end, and did not come to their slot in time.
    pub slot_skipped: u64,
    /// Sums of cells that, or whose children, were changing their parent in that epoch, then or now.
    pub parent_changing: u64,
    /// Sums of epochs in which a cell had not reported where its sums go, then or now.
    pub tree_unknown: u64,
    /// Sums that do not contain all their children's, then or now.
    pub sums_not_taken: u64,
}

impl Tally {
    /// Counts a reply that is not as it was recorded; one to joints that a bus did not take cannot come.
    pub(super) const fn count(&mut self, how: How, is_unsent: bool) {
        let count = match how {
            How::Missing if is_unsent => &mut self.not_requested,
            How::Missing => &mut self.missing,
            How::Different => &mut self.different,
            How::Extra => &mut self.extra,
        };
        *count += 1;
    }

    /// Compares a torque's words, each within so many steps; whether it is equal.
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

    /// Whether there are sums, and not one of them could be compared, because nothing tells which children they contain.
    #[must_use]
    pub const fn lacks_the_tree(&self) -> bool {
        self.sums == 0 && self.lacking.tree_unknown > 0
    }

    /// Whether all came back, and nothing else.
    #[must_use]
    pub const fn is_good(&self) -> bool {
        self.different == 0
            && self.missing == 0
            && self.extra == 0
            && self.not_requested == 0
            && !self.lacks_the_tree()
    }
}
