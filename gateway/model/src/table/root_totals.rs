//! Sums along the cells' tree: the roots' sums of each epoch, compared with the expected ones.

use protocol::fixed::TorqueFormat;
use protocol::parameters::MAX_JOINTS;
use serde::Serialize;

use super::errors::Errors;
use crate::tracker::MAX_LATE_EPOCHS;

/// Number of epochs over which errors of sums are averaged.
const AVERAGED_EPOCHS: u32 = 32;

/// Counts of sums.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct SumCounts {
    /// Received sums, from all cells.
    pub received: u64,
    /// The first sum of a root for an epoch.
    pub first: u64,
    /// Further sums of a root for an epoch; the one with the most cells is used.
    pub resent: u64,
    /// Sums of cells that are not roots: their parents' sums contain them.
    pub overheard: u64,
    /// Sums for an epoch that has passed.
    pub stale: u64,
}

/// Cells in the sums of epochs: due = in time + late + missing.
///
/// A cell is due if it is in contact by Algorithm 1 and can be expected to answer. Cells that only forward the sums of
/// others are not due.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Contributions {
    /// Cells due in sums, over all epochs.
    pub due: u64,
    /// Due cells in a sum before the next joints.
    pub in_time: u64,
    /// Due cells in a sum after them.
    pub late: u64,
    /// Due cells in no sum.
    pub missing: u64,
    /// Cells in a sum that were not due.
    pub unasked: u64,
    /// Cells among these in epochs in which the contact of some cell was unknown.
    pub contact_unknown: u64,
}

/// A root's sum for one epoch.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct Sum {
    /// Number of cells in it.
    pub(super) count: u8,
    /// Words in steps of Q7.8.
    pub(super) words: [i32; MAX_JOINTS],
}

impl Sum {
    /// Returns the words in steps of 2^-12 Nm.
    pub(super) fn in_steps(&self) -> [i32; MAX_JOINTS] {
        self.words.map(|word| word << (TorqueFormat::Q3_12.fraction() - TorqueFormat::Q7_8.fraction()))
    }

    pub(super) fn is_saturated(&self) -> bool {
        self.words.iter().any(|&word| word == i32::from(i16::MAX) || word == i32::from(i16::MIN))
    }
}

/// The sums of a root.
#[derive(Clone, Copy, Debug)]
pub(super) struct RootSums {
    /// True if its sums are for the gateway; otherwise another cell receives them.
    pub(super) is_for_gateway: bool,
    /// The best sum of each of the newest epochs.
    pub(super) epochs: [Option<Sum>; MAX_LATE_EPOCHS + 1],
}

impl RootSums {
    pub(super) const fn new(feeds: bool) -> Self {
        Self { is_for_gateway: feeds, epochs: [None; MAX_LATE_EPOCHS + 1] }
    }

    /// Starts an epoch.
    pub(super) fn open(&mut self) {
        self.epochs.rotate_right(1);
        if let Some(newest) = self.epochs.first_mut() {
            *newest = None;
        }
    }
}

/// An epoch that may still be answered.
#[derive(Clone, Copy, Debug)]
struct OpenEpoch {
    due: u32,
    /// True if no other cell can be in it.
    known: bool,
    received_cells: u32,
    /// Number of cells before the next joints.
    in_time: Option<u32>,
    /// Words in steps of Q7.8.
    sum: [i32; MAX_JOINTS],
    saturated: bool,
    expected: Option<Expected>,
}

/// The expected sum by the central computation, in Nm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Expected {
    /// The torque of the whole bus.
    pub(super) torque: [f64; MAX_JOINTS],
    /// Number of joints that some cell in it loads, from the first.
    pub(super) joints: usize,
    /// True if every cell has the same sensor words as in the previous epoch.
    pub(super) constant: bool,
}

impl Expected {
    /// Adds the torque of a cell on this joint.
    pub(super) fn add(&mut self, torque: [f64; MAX_JOINTS], joint: usize) {
        for (sum, torque) in self.torque.iter_mut().zip(torque) {
            *sum += torque;
        }
        self.joints = self.joints.max(joint);
    }
}

/// Errors of sums over consecutive epochs.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SumError {
    pub(super) each: Errors,
    pub(super) averaged: Errors,
    /// Number of words that were skipped because they were saturated.
    pub(super) saturated: u64,
    /// Number of consecutive epochs, and the sum of their errors.
    epochs: u32,
    sum: [f64; MAX_JOINTS],
    /// The errors of the last compared epoch.
    pub(super) last: Option<[f64; MAX_JOINTS]>,
}

impl SumError {
    /// Compares the sum of a complete epoch, in steps of Q7.8.
    pub(super) fn take(&mut self, words: &[i32; MAX_JOINTS], saturated: bool, expected: &Expected) {
        if !expected.constant {
            self.interrupt();
        }
        if saturated {
            self.saturated += expected.joints as u64;
            return self.interrupt();
        }
        let mut errors = [0.0; MAX_JOINTS];
        let compared = errors.iter_mut().zip(words).zip(expected.torque).zip(&mut self.sum);
        for (((error, &word), torque), sum) in compared.take(expected.joints) {
            *error = f64::from(word) / 256.0 - torque;
            self.each.add(*error);
            *sum += *error;
        }
        self.last = Some(errors);
        self.epochs += 1;
        if self.epochs == AVERAGED_EPOCHS {
            let sums = self.sum;
            for sum in sums.iter().take(expected.joints) {
                self.averaged.add(sum / f64::from(AVERAGED_EPOCHS));
            }
            self.interrupt();
        }
    }

    /// Restarts the average with the next epoch.
    pub(super) const fn interrupt(&mut self) {
        (self.epochs, self.sum) = (0, [0.0; MAX_JOINTS]);
    }
}

/// The sums of a bus.
#[derive(Clone, Debug, Default)]
pub(super) struct RootTotals {
    /// Newest first.
    epochs: [Option<OpenEpoch>; MAX_LATE_EPOCHS + 1],
    pub(super) counts: SumCounts,
    pub(super) contributions: Contributions,
    pub(super) error: SumError,
}

/// The use of a received sum.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum SumUse {
    /// It is the root's best for its epoch.
    Best,
    /// A sum with at least as many cells arrived earlier.
    Resent,
}

impl RootTotals {
    /// Records a root's sum for the epoch `lag` before the newest; `best` is its best sum for that epoch so far.
    pub(super) fn take(&mut self, lag: usize, best: &mut Option<Sum>, sum: Sum) -> SumUse {
        let before = *best;
        match before {
            Some(_) => self.counts.resent += 1,
            None => self.counts.first += 1,
        }
        if before.is_some_and(|before| sum.count <= before.count) {
            return SumUse::Resent;
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
        SumUse::Best
    }

    /// Returns the number of cells due in the newest epoch's sum; `None` if the sensors of some are unknown.
    pub(super) fn due(&self) -> Option<u32> {
        self.epochs.first().copied().flatten().filter(|open| open.known).map(|open| open.due)
    }

    /// Starts an epoch: `due` cells should be in its sum, and no others if `known`. Settles the oldest epoch.
    pub(super) fn open(&mut self, due: u32, known: bool, expected: Option<Expected>) {
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
            self.contributions.settle(settled);
        }
    }

    /// Closes the newest epoch. Returns whether cells were due in it, and whether all of them arrived in time.
    pub(super) fn close(&mut self) -> (bool, bool) {
        self.error.last = None;
        let Some(Some(open)) = self.epochs.first_mut() else { return (false, false) };
        open.in_time = Some(open.received_cells);
        let complete = open.received_cells >= open.due;
        if open.due > 0
            && open.known
            && open.received_cells == open.due
            && let Some(expected) = &open.expected
        {
            self.error.take(&open.sum, open.saturated, expected);
        } else {
            self.error.interrupt();
        }
        (open.due > 0, complete)
    }

    /// Ends the run: settles all epochs.
    pub(super) fn finish(&mut self) {
        for open in &mut self.epochs {
            self.contributions.settle(open.take());
        }
    }
}

impl Contributions {
    fn settle(&mut self, open: Option<OpenEpoch>) {
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
            Sum { count: 3, words }.is_saturated()
        };
        let words = [0, i16::MAX, i16::MIN, i16::MAX - 1, i16::MIN + 1];
        assert_eq!(words.map(of), [false, true, true, false, false]);
    }
}
