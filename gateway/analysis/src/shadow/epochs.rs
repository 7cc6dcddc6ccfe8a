//! Counts the cells that answered each epoch's joints, and measures the times of their replies.

use protocol::id::CellId;
use protocol::packet::Epoch;
use protocol::quantiles::TimeHistogram;

use super::report::{AnsweringCounts, DelayQuantiles, ReplyStatistics};
use bus_model::traffic::RunEvent;

/// A set of cells of a bus.
#[derive(Clone, Copy, Debug, Default)]
struct CellSet([u64; 4]);

impl CellSet {
    fn insert(&mut self, cell: CellId) {
        let (word, bit) = (cell.index() / 64, cell.index() % 64);
        self.0.get_mut(word).into_iter().for_each(|word| *word |= 1 << bit);
    }

    fn len(&self) -> u32 {
        self.0.iter().map(|word| word.count_ones()).sum()
    }
}

/// The joints of one epoch, and the cells that answered them.
#[derive(Clone, Copy, Debug, Default)]
struct EpochAnswers {
    /// Time in ns at which the joints should be sent, by the capture.
    at: u64,
    /// The cells that answered; `None` if cells were halted when the joints were sent.
    answered: Option<CellSet>,
}

/// Follows joints and the answers to them, in bounded memory.
#[derive(Debug, Default)]
pub(super) struct EpochTracker {
    senders: CellSet,
    /// The newest joints of each epoch number.
    numbered: Vec<EpochAnswers>,
    newest: Option<Epoch>,
    halted: bool,
    closed: EpochTotals,
    epochs_halted: u64,
    replies: ReplyStatistics,
    after_joints: TimeHistogram,
}

/// Counts over all epochs.
#[derive(Clone, Copy, Debug, Default)]
struct EpochTotals {
    epochs: u64,
    answers: u64,
    most: u32,
}

impl EpochTotals {
    fn add_epoch(&mut self, answered: CellSet) {
        self.epochs += 1;
        self.answers += u64::from(answered.len());
        self.most = self.most.max(answered.len());
    }
}

impl EpochTracker {
    /// Records the role of a frame at the time `at` in ns. For an answer, returns the epoch that it answers, and true
    /// if later joints have been sent before it.
    pub(super) fn record_event(
        &mut self,
        at: u64,
        says: RunEvent,
        from: Option<CellId>,
    ) -> Option<(Epoch, bool)> {
        from.into_iter().for_each(|cell| self.senders.insert(cell));
        match says {
            RunEvent::Joints(epoch) => self.receive_joints(at, epoch),
            RunEvent::Answer(epoch) => {
                let answered = &mut self.answers_to(epoch).answered;
                from.into_iter().zip(answered).for_each(|(cell, answered)| answered.insert(cell));
                return Some((epoch, self.newest.is_some_and(|newest| newest != epoch)));
            }
            RunEvent::Halt => self.halted = true,
            RunEvent::Resume => self.halted = false,
            RunEvent::Preparation | RunEvent::Other => {}
        }
        None
    }

    /// Records joints at the time `at` in ns; joints that repeat an epoch count once.
    fn receive_joints(&mut self, at: u64, epoch: Epoch) {
        let halted = self.halted;
        let numbered = self.answers_to(epoch);
        numbered.at = at;
        if self.newest.replace(epoch) == Some(epoch) {
            return;
        }
        let numbered = self.answers_to(epoch);
        let before = std::mem::replace(&mut numbered.answered, (!halted).then(CellSet::default));
        before.into_iter().for_each(|answered| self.closed.add_epoch(answered));
        self.epochs_halted += u64::from(halted);
    }

    fn answers_to(&mut self, epoch: Epoch) -> &mut EpochAnswers {
        self.numbered.resize(256, EpochAnswers::default());
        self.numbered.get_mut(usize::from(epoch.0)).expect("an epoch is one byte")
    }

    /// Records the transmission of an answer, which should be sent at `at` and ended at `end`, in ns. `was_late` is
    /// true if the answer came after the next joints in the capture itself.
    pub(super) fn record_answer(&mut self, epoch: Epoch, was_late: bool, (at, end): (u64, u64)) {
        let Some(newest) = self.newest else { return };
        self.replies.count += 1;
        if was_late {
            self.replies.late_before += 1;
            return;
        }
        let joints = self.answers_to(epoch).at;
        if newest != epoch {
            self.replies.late += 1;
            let next = Some(self.answers_to(epoch.next()).at).filter(|&next| next > joints).unwrap_or(end);
            let period = next.saturating_sub(joints);
            let is_slow = at.saturating_sub(joints) > period / 8 * 7;
            self.replies.late_when_ready += u64::from(is_slow);
        }
        self.after_joints.record(end.saturating_sub(joints));
    }

    /// Returns the counts and times of the answers to joints.
    pub(super) fn replies(&self) -> ReplyStatistics {
        ReplyStatistics { after_joints_us: DelayQuantiles::from_times(&self.after_joints), ..self.replies }
    }

    /// Returns the numbers of cells that answered, over all epochs. The number of cells on the bus is the skin's if
    /// given, else that of the cells that sent something.
    pub(super) fn answering_counts(&self, described: Option<u32>) -> AnsweringCounts {
        let mut all = self.closed;
        self.numbered.iter().filter_map(|it| it.answered).for_each(|answered| all.add_epoch(answered));
        AnsweringCounts {
            epochs: all.epochs,
            epochs_halted: self.epochs_halted,
            mean: (all.epochs > 0).then(|| all.answers as f64 / all.epochs as f64),
            most: all.most,
            cells: described.unwrap_or_else(|| self.senders.len()),
            described: described.is_some(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(node: i64) -> CellId {
        CellId::new(node).unwrap()
    }

    #[test]
    fn each_cell_counts_once_an_epoch_however_late_and_halted_epochs_not_at_all() {
        let mut epochs = EpochTracker::default();
        let answer = |epochs: &mut EpochTracker, node, epoch| {
            epochs.record_event(0, RunEvent::Answer(Epoch(epoch)), Some(cell(node)));
        };
        let joints =
            |epochs: &mut EpochTracker, epoch| epochs.record_event(0, RunEvent::Joints(Epoch(epoch)), None);
        answer(&mut epochs, 9, 255);
        for epoch in 0..=255 {
            joints(&mut epochs, epoch);
            let cells = if epoch == 7 { 254 } else { 2 };
            (1..=cells).chain([1]).for_each(|node| answer(&mut epochs, node, epoch));
        }
        // One answer is late, and joints are repeated.
        joints(&mut epochs, 0);
        answer(&mut epochs, 3, 254);
        joints(&mut epochs, 0);
        answer(&mut epochs, 1, 0);
        epochs.record_event(0, RunEvent::Halt, None);
        joints(&mut epochs, 1);
        answer(&mut epochs, 1, 1);
        let report = epochs.answering_counts(None);
        assert_eq!((report.epochs, report.epochs_halted, report.most), (257, 1, 254));
        assert_eq!((report.cells, report.described), (254, false));
        let answers = 256.0 * 2.0 + 252.0 + 1.0 + 1.0;
        assert!((report.mean.unwrap() - answers / 257.0).abs() < 1e-12, "{report:?}");
        assert_eq!(epochs.answering_counts(Some(300)).cells, 300);
        assert_eq!(EpochTracker::default().answering_counts(None).mean, None);
    }
}
