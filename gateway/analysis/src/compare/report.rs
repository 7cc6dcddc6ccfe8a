//! The outcome of a comparison, as printed by `skinbus compare --json`.

use protocol::quantiles::Quantiles;
use serde::Serialize;

use super::PerCapture;

/// The outcome of a comparison.
#[derive(Clone, Debug, Serialize)]
pub struct CompareReport {
    /// True if the captures have no difference beyond the tolerances.
    pub equal: bool,
    /// The aspects that differ, in the order of [`COMPARED_ASPECTS`].
    pub differs: Vec<&'static str>,
    /// The two captures.
    pub captures: PerCapture<CaptureFigures>,
    /// Counts of joints packets that are in both captures or missing from one.
    pub epochs: EpochCounts,
    /// Comparison of the words of joints.
    pub joints: JointCounts,
    /// Epochs at which only one capture was halted.
    pub halts: UnpairedCounts,
    /// Comparison of touches, counted by cell and epoch.
    pub contacts: ContactCounts,
    /// Comparison of the torques of single cells.
    pub torques: ReplyCounts,
    /// Comparison of the sums of roots.
    pub sums: ReplyCounts,
    /// Cells with differences or losses, by bus and node id.
    pub cells: Vec<ComparedCellRow>,
    /// Cells that send packets in only one of the captures.
    pub extra_cells: Vec<ExtraCell>,
    /// The first difference; `None` if the captures are equal.
    pub first: Option<FirstDifference>,
}

/// The compared aspects.
pub const COMPARED_ASPECTS: [&str; 7] = ["epochs", "joints", "halts", "contacts", "torques", "sums", "cells"];

/// Counts and times of one of the two captures.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CaptureFigures {
    /// Number of frames.
    pub frames: u64,
    /// Number of joints packets on all buses.
    pub epochs: u64,
    /// The number of the first joints since the run began.
    pub first: Option<u64>,
    /// The number of the last joints.
    pub last: Option<u64>,
    /// The time of the last joints in s since the run began; absent if the log has no times.
    pub last_s: Option<f64>,
    /// Number of times that the epochs began anew at 0, counted as runs.
    pub countings: u32,
    /// Number of joints packets out of order, which are skipped.
    pub out_of_order: u64,
    /// Frames that the recorder lost.
    pub dropped: u64,
    /// True if the capture was cut off.
    pub unfinished: bool,
    /// Torques that arrived in time to be used.
    pub torques: u64,
    /// Sums of roots that arrived in time to be used.
    pub sums: u64,
    /// Replies that arrived after the next joints.
    pub late: u64,
    /// Late replies that arrived too late to be used for their epoch; `late` includes them.
    pub too_late: u64,
    /// Packets that cells sent by their own counters but that are not in the capture.
    pub lost: u64,
    /// Restarts of cells.
    pub restarts: u64,
    /// Times from joints to their replies, in µs; absent without replies, and if the log has no times.
    pub reply_us: Option<Quantiles>,
}

/// Counts of joints packets by their number in the run, over all buses.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct EpochCounts {
    /// Joints packets that are in both captures.
    pub compared: u64,
    /// Joints packets that B has and A lacks, at times that both captures cover.
    pub missing_in_a: u64,
    /// Joints packets that A has and B lacks, at times that both captures cover.
    pub missing_in_b: u64,
    /// Joints packets of one capture from before the start of the other.
    pub before: UnpairedCounts,
    /// Joints packets of one capture from after the end of the other.
    pub after: UnpairedCounts,
}

/// Counts of items that only one capture has.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct UnpairedCounts {
    /// Number of items in A only.
    pub only_a: u64,
    /// Number of items in B only.
    pub only_b: u64,
}

impl UnpairedCounts {
    pub(super) const fn count_item(&mut self, is_a: bool) {
        *(if is_a { &mut self.only_a } else { &mut self.only_b }) += 1;
    }

    /// Returns the sum of both counts.
    #[must_use]
    pub const fn total(self) -> u64 {
        self.only_a + self.only_b
    }
}

/// Comparison of the words of joints in epochs that both captures have.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct JointCounts {
    /// Epochs whose words are equal.
    pub equal: u64,
    /// Epochs whose words differ within the tolerance.
    pub tolerated: u64,
    /// Epochs whose words differ by more than the tolerance.
    pub different: u64,
    /// The largest difference of a joint word, in steps of 2^-14.
    pub max_steps: u32,
}

/// Counts of touches; a touch of one cell counts once in each epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct ContactCounts {
    /// Touches in both captures.
    pub both: u64,
    /// Touches in one capture only.
    #[serde(flatten)]
    pub only: UnpairedCounts,
}

/// Comparison of replies in epochs that both captures have.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct ReplyCounts {
    /// Replies whose words are equal.
    pub equal: u64,
    /// Replies whose words differ within the tolerance.
    pub tolerated: u64,
    /// Replies whose words differ by more than the tolerance.
    pub different: u64,
    /// Different replies of a cell that has the same joints, contact state and configuration in both captures.
    pub different_with_same_inputs: u64,
    /// Replies in B only.
    pub missing_in_a: u64,
    /// Replies in A only.
    pub missing_in_b: u64,
    /// Replies in one capture only, where the other capture ended before the reply was due.
    pub open: u64,
    /// The largest difference of a word, in steps of the tolerance.
    pub max_steps: u32,
}

impl ReplyCounts {
    /// Returns the number of replies that only one capture has.
    #[must_use]
    pub const fn missing_count(&self) -> u64 {
        self.missing_in_a + self.missing_in_b
    }
}

/// The comparison of one cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ComparedCellRow {
    /// Name of the cell's bus.
    pub bus: String,
    /// Node id of the cell.
    pub node: u8,
    /// Comparison of the cell's torques or sums.
    #[serde(flatten)]
    pub replies: ReplyCounts,
    /// Losses of the cell in each capture.
    pub losses: PerCapture<CellLosses>,
}

/// Losses of a cell in one capture.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct CellLosses {
    /// Replies that arrived after the next joints.
    pub late: u64,
    /// Late replies that arrived too late to be used; `late` includes them.
    pub too_late: u64,
    /// Packets that the cell sent by its own counter but that are not in the capture.
    pub lost: u64,
    /// Restarts of the cell.
    pub restarts: u64,
}

/// A cell that sends packets in only one of the captures.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct ExtraCell {
    /// Name of the cell's bus.
    pub bus: String,
    /// Node id of the cell.
    pub node: u8,
    /// The capture in which the cell sends: `a` or `b`.
    pub only_in: &'static str,
}

/// The first difference between the captures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FirstDifference {
    /// The item that differs: `epoch`, `joints`, `halt`, `contact`, `torque` or `sum`.
    pub what: &'static str,
    /// The kind of difference: `different`, `missing in a` or `missing in b`.
    pub how: &'static str,
    /// Name of the bus.
    pub bus: String,
    /// Node id of the cell; `None` for a difference of joints or halts.
    pub cell: Option<u8>,
    /// The robot's joint whose words differ most, from 1; `None` if words do not differ.
    pub joint: Option<u8>,
    /// The epoch of the difference.
    pub epoch: u8,
    /// The number of that epoch's joints since the run began.
    pub number: u64,
    /// The time of the joints in s of each run; absent if a capture lacks the joints or has no times.
    pub time_s: PerCapture<Option<f64>>,
    /// The differing words in each capture.
    pub words: PerCapture<Option<i16>>,
    /// The values of the differing words, in [`FirstDifference::unit`].
    pub values: PerCapture<Option<f64>>,
    /// Unit of `values`: Nm, N, rad or m; absent without words.
    pub unit: Option<&'static str>,
    /// The difference in steps of the tolerance; absent without words.
    pub steps: Option<u32>,
    /// The inputs of the cell that differ between the captures: `joints`, `halt`, `stimulus`, `configuration`,
    /// `restart`, `cells`.
    pub inputs: Vec<&'static str>,
    /// The inputs of the cell that are unknown in at least one capture.
    pub unknown_inputs: Vec<&'static str>,
    /// The number of the epoch's occurrence in each capture, from 1, for `skinbus explain --occurrence`.
    pub occurrence: PerCapture<Option<u32>>,
}
