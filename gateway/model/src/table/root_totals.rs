//! Sums along the cells' tree: the roots' sums of each epoch, compared with the expected ones.

use protocol::fixed::TorqueFormat;
use protocol::parameters::MAX_JOINTS;
use serde::Serialize;

use super::errors::TorqueErrors;
use crate::tracker::MAX_LATE_EPOCHS;

/// Number of epochs over which errors of sums are averaged.
const AVERAGED_EPOCHS: u32 = 32;

/// Counts of the sums that arrived on a bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct SumCounts {
    /// All sums that arrived, from roots and from other cells.
    pub received: u64,
    /// Sums that were the first of their root for an epoch.
    pub first: u64,
    /// Sums that were not the first of their root for an epoch; the one with the most cells is used.
    pub resent: u64,
    /// Sums of cells that are not roots; the sums of their parents contain them.
    pub overheard: u64,
    /// Sums that arrived after their epoch had closed.
    pub stale: u64,
}

/// Counts of cells whose torque was due in the sums of epochs: due = in time + late + missing.
///
/// A cell is due if it is in contact by Algorithm 1 and can be expected to answer. Cells that only forward the sums of
/// others are not due.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Contributions {
    /// Cells due in sums, over all epochs.
    pub due: u64,
    /// Due cells in a sum that arrived before the next joints.
    pub in_time: u64,
    /// Due cells in a sum that arrived after the next joints.
    pub late: u64,
    /// Due cells that no sum contained.
    pub missing: u64,
    /// Cells in a sum that were not due in it.
    pub unasked: u64,
    /// Cells that were not due, in epochs in which the contact of some cell was unknown.
    pub contact_unknown: u64,
}

/// A root's sum for one epoch.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct RootSum {
    /// Number of cells in the sum.
    pub(super) count: u8,
    /// The torque of each joint, in steps of Q7.8.
    pub(super) words: [i32; MAX_JOINTS],
}

impl RootSum {
    /// Returns the words in steps of 2^-12 Nm.
    pub(super) fn words_in_q3_12(&self) -> [i32; MAX_JOINTS] {
        self.words
            .map(|word| word << (TorqueFormat::Q3_12.fraction_bits() - TorqueFormat::Q7_8.fraction_bits()))
    }

    pub(super) fn is_saturated(&self) -> bool {
        self.words.iter().any(|&word| word == i32::from(i16::MAX) || word == i32::from(i16::MIN))
    }
}

/// The sums of a root.
#[derive(Clone, Copy, Debug)]
pub(super) struct RootSums {
    /// True if the root sends its sums to the gateway; otherwise another cell receives them.
    pub(super) is_for_gateway: bool,
    /// For each of the newest epochs, the sum with the most cells.
    pub(super) epochs: [Option<RootSum>; MAX_LATE_EPOCHS + 1],
}

impl RootSums {
    pub(super) const fn new(feeds: bool) -> Self {
        Self { is_for_gateway: feeds, epochs: [None; MAX_LATE_EPOCHS + 1] }
    }

    /// Starts a new epoch, for which no sum has arrived yet.
    pub(super) fn open_epoch(&mut self) {
        self.epochs.rotate_right(1);
        if let Some(newest) = self.epochs.first_mut() {
            *newest = None;
        }
    }
}

/// An epoch whose sums may still arrive.
#[derive(Clone, Copy, Debug)]
struct OpenEpoch {
    due: u32,
    /// True if the contact of every cell is known, so that no other cell than the due ones can be in the sum.
    known: bool,
    received_cells: u32,
    /// Number of cells in the sum when the next joints were sent; `None` before that.
    in_time: Option<u32>,
    /// The sum of all roots for each joint, in steps of Q7.8.
    sum: [i32; MAX_JOINTS],
    saturated: bool,
    expected: Option<ExpectedSum>,
}

/// The sum that is expected by the central computation, in Nm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ExpectedSum {
    /// The torque of the whole bus, for each joint.
    pub(super) torque: [f64; MAX_JOINTS],
    /// Number of joints, counted from the base, that some cell in the sum loads.
    pub(super) joints: usize,
    /// True if every cell has the same sensor words as in the previous epoch.
    pub(super) constant: bool,
}

impl ExpectedSum {
    /// Adds the torque of a cell that sits on the joint `joint`.
    pub(super) fn add_cell_torque(&mut self, torque: [f64; MAX_JOINTS], joint: usize) {
        for (sum, torque) in self.torque.iter_mut().zip(torque) {
            *sum += torque;
        }
        self.joints = self.joints.max(joint);
    }
}

/// Errors of sums over consecutive epochs.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SumError {
    pub(super) single: TorqueErrors,
    pub(super) averaged: TorqueErrors,
    /// Number of words that were skipped because they were saturated.
    pub(super) saturated: u64,
    /// Number of consecutive epochs that are averaged, and the sum of their errors.
    epochs: u32,
    sum: [f64; MAX_JOINTS],
    /// The errors in the last epoch that was compared.
    pub(super) last: Option<[f64; MAX_JOINTS]>,
}

impl SumError {
    /// Compares the sum of a complete epoch, in steps of Q7.8, with the expected one.
    pub(super) fn compare(&mut self, words: &[i32; MAX_JOINTS], saturated: bool, expected: &ExpectedSum) {
        if !expected.constant {
            self.restart_average();
        }
        if saturated {
            self.saturated += expected.joints as u64;
            return self.restart_average();
        }
        let mut errors = [0.0; MAX_JOINTS];
        let compared = errors.iter_mut().zip(words).zip(expected.torque).zip(&mut self.sum);
        for (((error, &word), torque), sum) in compared.take(expected.joints) {
            *error = f64::from(word) / 256.0 - torque;
            self.single.add(*error);
            *sum += *error;
        }
        self.last = Some(errors);
        self.epochs += 1;
        if self.epochs == AVERAGED_EPOCHS {
            let sums = self.sum;
            for sum in sums.iter().take(expected.joints) {
                self.averaged.add(sum / f64::from(AVERAGED_EPOCHS));
            }
            self.restart_average();
        }
    }

    /// Restarts the average with the next epoch.
    pub(super) const fn restart_average(&mut self) {
        (self.epochs, self.sum) = (0, [0.0; MAX_JOINTS]);
    }
}

/// The sums of all roots of a bus, by epoch.
#[derive(Clone, Debug, Default)]
pub(super) struct RootTotals {
    /// Epochs whose sums may still arrive, newest first.
    epochs: [Option<OpenEpoch>; MAX_LATE_EPOCHS + 1],
    pub(super) counts: SumCounts,
    pub(super) contributions: Contributions,
    pub(super) error: SumError,
    /// True if the wires to the roots, and not their tree pages, tell which root sends its sums to the gateway.
    pub(super) follows_wires: bool,
}

/// The classification of a root's sum.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum RootSumUse {
    /// The sum has the most cells so far for its epoch, and is used.
    Best,
    /// An earlier sum for the same epoch has at least as many cells; this one is not used.
    Resent,
}

impl RootTotals {
    /// Records a root's sum for the epoch `lag` before the newest; `best` is the root's sum with the most cells for
    /// that epoch so far.
    pub(super) fn record_sum(&mut self, lag: usize, best: &mut Option<RootSum>, sum: RootSum) -> RootSumUse {
        let before = *best;
        match before {
            Some(_) => self.counts.resent += 1,
            None => self.counts.first += 1,
        }
        if before.is_some_and(|before| sum.count <= before.count) {
            return RootSumUse::Resent;
        }
        *best = Some(sum);
        if let Some(Some(open)) = self.epochs.get_mut(lag) {
            let (count, words) = before.map_or((0, [0; MAX_JOINTS]), |before| (before.count, before.words));
            open.received_cells += u32::from(sum.count) - u32::from(count);
            for ((total, word), before) in open.sum.iter_mut().zip(sum.words).zip(words) {
                *total += word - before;
            }
            open.saturated |= sum.is_saturated();
        }
        RootSumUse::Best
    }

    /// Returns the number of cells due in the sum of the newest epoch; `None` if the contact of some cell is unknown.
    pub(super) fn due_cell_count(&self) -> Option<u32> {
        self.epochs.first().copied().flatten().filter(|open| open.known).map(|open| open.due)
    }

    /// Starts an epoch in whose sum `due` cells should be. If `known`, no other cells can be in it. Ends the counting
    /// of the oldest epoch.
    pub(super) fn open_epoch(&mut self, due: u32, known: bool, expected: Option<ExpectedSum>) {
        self.epochs.rotate_right(1);
        if let Some(oldest) = self.epochs.first_mut() {
            let settled = oldest.replace(OpenEpoch {
                due,
                known,
                received_cells: 0,
                in_time: None,
                sum: [0; MAX_JOINTS],
                saturated: false,
                expected,
            });
            self.contributions.count_epoch(settled);
        }
    }

    /// Ends the time for in-time sums of the newest epoch. Returns whether cells were due in its sum, and whether all
    /// of them arrived in time.
    pub(super) fn close_epoch(&mut self) -> (bool, bool) {
        self.error.last = None;
        let Some(Some(open)) = self.epochs.first_mut() else { return (false, false) };
        open.in_time = Some(open.received_cells);
        let complete = open.received_cells >= open.due;
        if open.due > 0
            && open.known
            && open.received_cells == open.due
            && let Some(expected) = &open.expected
        {
            self.error.compare(&open.sum, open.saturated, expected);
        } else {
            self.error.restart_average();
        }
        (open.due > 0, complete)
    }

    /// Ends the run: ends the counting of all epochs.
    pub(super) fn finish_epochs(&mut self) {
        for open in &mut self.epochs {
            self.contributions.count_epoch(open.take());
        }
    }
}

impl Contributions {
    fn count_epoch(&mut self, open: Option<OpenEpoch>) {
        let Some(OpenEpoch { due, known, received_cells: came, in_time, .. }) = open else { return };
        let in_time = in_time.unwrap_or(came).min(due);
        let all = came.min(due);
        self.due += u64::from(due);
        self.in_time += u64::from(in_time);
        self.late += u64::from(all - in_time);
        self.missing += u64::from(due - all);
        self.unasked += u64::from(came - all);
        self.contact_unknown += if known { 0 } else { u64::from(came - all) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sum_with_one_word_at_either_end_of_its_range_is_saturated() {
        let of = |word: i16| {
            let mut words = [1; MAX_JOINTS];
            words[2] = word.into();
            RootSum { count: 3, words }.is_saturated()
        };
        let words = [0, i16::MAX, i16::MIN, i16::MAX - 1, i16::MIN + 1];
        assert_eq!(words.map(of), [false, true, true, false, false]);
    }
}
