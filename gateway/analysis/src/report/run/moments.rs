//! The times of problems on a bus: late or missing replies, lost packets, cells that fell silent or restarted.

use std::collections::VecDeque;

use model::table::{Notice, Replies};
use model::tracker::MAX_LATE_EPOCHS;

/// Maximum time in s between losses that are listed as one.
const MAX_LOSS_GAP_S: f64 = 0.5;
/// Maximum number of losses, and of notices, that are kept.
const MAX_KEPT_ENTRIES: usize = 500;

/// Late, missing or lost items within a short time, listed as one loss.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ListedLoss {
    /// Times of the first and the last epoch with a loss, in s after the recording's first message.
    pub(super) seconds: (f64, f64),
    pub(super) late: u64,
    pub(super) missing: u64,
    /// Number of packets lost by the cells' own counts, which are known at the next heartbeat.
    pub(super) packets: u64,
}

impl ListedLoss {
    pub(super) const fn total(&self) -> u64 {
        self.late + self.missing + self.packets
    }
}

/// The losses and notices of one bus.
#[derive(Debug, Default)]
pub(super) struct BusProblems {
    /// Start times of the most recent epochs, newest first.
    opened: VecDeque<f64>,
    pub(super) losses: Vec<ListedLoss>,
    pub(super) notices: Vec<(f64, Notice)>,
    /// Number of losses and notices that were not kept.
    pub(super) further: u64,
}

impl BusProblems {
    /// Records the end of an epoch that began at `at`. The counts of replies before and after it show how many became
    /// late or missing, and `packets` is the number of packets found lost.
    pub(super) fn record_epoch(&mut self, at: f64, before: &Replies, now: &Replies, packets: u64) {
        self.opened.push_front(at);
        self.opened.truncate(MAX_LATE_EPOCHS + 1);
        let late = now.late.saturating_sub(before.late);
        let missing = now.missing.saturating_sub(before.missing);
        if late + missing + packets == 0 {
            return;
        }
        // A reply is late for one of the previous epochs, and missing once it can no longer arrive.
        let behind = if missing > 0 { MAX_LATE_EPOCHS } else { usize::from(late > 0) };
        let from = self.opened.get(behind).or_else(|| self.opened.back()).copied().unwrap_or(at);
        let is_full = self.losses.len() >= MAX_KEPT_ENTRIES;
        match self.losses.last_mut() {
            Some(last) if from - last.seconds.1 <= MAX_LOSS_GAP_S => {
                last.seconds.1 = at.max(last.seconds.1);
                last.late += late;
                last.missing += missing;
                last.packets += packets;
            }
            _ if is_full => self.further += 1,
            _ => self.losses.push(ListedLoss { seconds: (from, at), late, missing, packets }),
        }
    }

    /// Records a notice of the bus's table, such as a silent cell.
    pub(super) fn record_notice(&mut self, at: f64, notice: Notice) {
        if self.notices.len() < MAX_KEPT_ENTRIES {
            self.notices.push((at, notice));
        } else {
            self.further += 1;
        }
    }

    /// Returns the loss for which `of` returns the highest count.
    pub(super) fn largest_loss(&self, of: impl Fn(&ListedLoss) -> u64) -> Option<&ListedLoss> {
        self.losses.iter().filter(|loss| of(loss) > 0).max_by_key(|loss| of(loss))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_that_follow_each_other_are_one_and_begin_with_the_epoch_that_lacks_something() {
        let mut moments = BusProblems::default();
        let mut before = Replies::default();
        for epoch in 0..200_u32 {
            let mut now = before;
            now.missing += u64::from((50..60).contains(&epoch)) * 2;
            now.late += u64::from(epoch == 150);
            moments.record_epoch(f64::from(epoch) * 0.016, &before, &now, u64::from(epoch == 61));
            before = now;
        }
        let [first, second] = moments.losses.as_slice() else { panic!("{:?}", moments.losses) };
        assert_eq!((first.late, first.missing, first.packets, first.total()), (0, 20, 1, 21));
        assert!((first.seconds.0 - 47.0 * 0.016).abs() < 1e-9, "three epochs before it was settled");
        assert!((first.seconds.1 - 61.0 * 0.016).abs() < 1e-9, "{first:?}");
        assert!((second.seconds.0 - 149.0 * 0.016).abs() < 1e-9 && second.late == 1, "{second:?}");
        assert_eq!(moments.largest_loss(|loss| loss.late), Some(second));
        assert_eq!(moments.largest_loss(ListedLoss::total), Some(first));
    }
}
