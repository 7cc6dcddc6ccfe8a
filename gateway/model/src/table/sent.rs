//! Joints sent to a cell, compared with those that it reports as received.

use protocol::message::ReceivedCounts;

use crate::tracker::HeartbeatKind;

/// The number of joints sent to one cell, and the cell's own count to compare it with.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SentJointCounts {
    since: CountsSinceStart,
    /// The counts before the cell's last start, and its replies then in doubt; kept while that start may still be taken
    /// back.
    before: Option<(CountsSinceStart, u64)>,
}

#[derive(Clone, Copy, Debug, Default)]
struct CountsSinceStart {
    /// The first page of receive counters since the cell or the gateway started.
    first: Option<ReceivedCounts>,
    /// Number of broadcasts since that first page.
    joints: u64,
}

impl SentJointCounts {
    pub(super) const fn count_broadcast(&mut self) {
        self.since.joints += 1;
    }

    /// Sets the number of broadcasts since the first page to zero.
    pub(super) const fn reset_count(&mut self) {
        self.since.joints = 0;
    }

    /// Records a page of receive counters. `passed` is the number of joints that were sent while the page was on its
    /// way. Later pages are compared with the first one.
    pub(super) fn record_counters_page(&mut self, heard: Option<ReceivedCounts>, passed: u64) {
        if self.since.first.is_none() {
            self.since = CountsSinceStart { first: heard, joints: passed };
        }
    }

    /// Confirms the last start, which can no longer be taken back.
    pub(super) const fn confirm_start(&mut self) {
        self.before = None;
    }

    /// Records a start of the cell; `sent` is its counter of sent packets, and `of` has the numbers of replies
    /// outstanding and in doubt. If `taken_back`, the apparent start was none: the earlier counts continue, and the
    /// returned number of replies is in doubt.
    pub(super) fn record_restart(
        &mut self,
        word: HeartbeatKind,
        taken_back: bool,
        sent: u16,
        of: (u32, u64),
    ) -> Option<u64> {
        let (outstanding, in_doubt) = of;
        if let Some((before, _)) = &mut self.before {
            before.joints += self.since.joints;
        } else if word == (HeartbeatKind::Started { again: true }) {
            self.before = Some((self.since, in_doubt));
        }
        if let Some((_, in_doubt)) = &mut self.before {
            *in_doubt += u64::from(outstanding);
        }
        let before = self.before.take_if(|_| taken_back);
        // The cell counts from zero; without its first heartbeat, compare from the next page on.
        let restarted = CountsSinceStart { first: (sent == 0).then(ReceivedCounts::default), joints: 0 };
        self.since = before.map_or(restarted, |(since, _)| since);
        before.map(|(_, in_doubt)| in_doubt)
    }

    /// Returns two counts of joints: those that the cell reports as skipped because they were old, and those that it
    /// does not report as received.
    pub(super) fn unanswered_joint_counts(&self, last: Option<ReceivedCounts>) -> Option<(u64, u64)> {
        let first = self.since.first?;
        let last = last.unwrap_or(first);
        let since = |count: fn(&ReceivedCounts) -> u16| count(&last).wrapping_sub(count(&first));
        let skipped = since(|heard| heard.joints_late);
        let heard = since(|heard| heard.joints).wrapping_add(since(|heard| heard.joints_repeated));
        // The cell counts modulo 2^16, so only the difference modulo 2^16 is known. A page may have crossed some joints
        // on the bus.
        let [low, high, ..] = self.since.joints.to_le_bytes();
        let unheard = u16::from_le_bytes([low, high]).wrapping_sub(heard.wrapping_add(skipped));
        Some((skipped.into(), if unheard > u16::MAX - 64 { 0 } else { unheard.into() }))
    }
}
