//! The outcome of a comparison, as printed by `skinbus compare --json`.

use model::quantiles::Quantiles;
use serde::Serialize;

use super::Both;

/// The outcome of a comparison.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// True without relevant differences.
    pub equal: bool,
    /// The aspects that differ, in the order of [`ASPECTS`].
    pub differs: Vec<&'static str>,
    /// The two captures.
    pub captures: Both<Source>,
    /// Counts of joints that are in both captures or missing from one.
    pub epochs: Epochs,
    /// Words of joints.
    pub joints: Joints,
    /// Epochs at which only one run was halted.
    pub halts: UnpairedCounts,
    /// Touches, by cell and epoch.
    pub contacts: Contacts,
    /// Torques of single cells.
    pub torques: Replies,
    /// Sums of roots.
    pub sums: Replies,
    /// Cells with differences or losses, by bus and node id.
    pub cells: Vec<CellRow>,
    /// Cells without packets in one of the captures.
    pub extra_cells: Vec<ExtraCell>,
    /// The first difference.
    pub first: Option<FirstDifference>,
}

/// The compared aspects.
pub const ASPECTS: [&str; 7] = ["epochs", "joints", "halts", "contacts", "torques", "sums", "cells"];

/// The figures of one capture.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Source {
    /// Frames.
    pub frames: u64,
    /// Joints on all buses.
    pub epochs: u64,
    /// The number of the first joints since the run began.
    pub first: Option<u64>,
    /// The number of the last joints.
    pub last: Option<u64>,
    /// The time of the last joints in s of the run; absent if the log has no times.
    pub last_s: Option<f64>,
    /// Number of runs, each with epochs from 0.
    pub countings: u32,
    /// Number of joints out of order, which are skipped.
    pub out_of_order: u64,
    /// Frames that the recorder lost.
    pub dropped: u64,
    /// True if the capture was cut off.
    pub unfinished: bool,
    /// Torques that arrived in time to be used.
    pub torques: u64,
    /// Sums of roots that arrived in time to be used.
    pub sums: u64,
    /// Replies after the next joints.
    pub late: u64,
    /// Late replies that were too late to be used.
    pub too_late: u64,
    /// Packets that cells counted but that are not in the capture.
    pub lost: u64,
    /// Restarts of cells.
    pub restarts: u64,
    /// Times from joints to their replies, in µs; absent without replies, and if the log has no times.
    pub reply_us: Option<Quantiles>,
}

/// Counts of joints by number, over all buses.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Epochs {
    /// Joints in both captures.
    pub compared: u64,
    /// Joints missing from A, but in B within the common time.
    pub missing_in_a: u64,
    /// Joints missing from B, but in A within the common time.
    pub missing_in_b: u64,
    /// Joints in one capture before the start of the other.
    pub before: UnpairedCounts,
    /// Joints in one capture after the end of the other.
    pub after: UnpairedCounts,
}

/// Counts of items that only one capture has.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct UnpairedCounts {
    /// Items in A only.
    pub only_a: u64,
    /// Items in B only.
    pub only_b: u64,
}

impl UnpairedCounts {
    pub(super) const fn count(&mut self, is_a: bool) {
        *(if is_a { &mut self.only_a } else { &mut self.only_b }) += 1;
    }

    /// Returns the sum of both counts.
    #[must_use]
    pub const fn sum(self) -> u64 {
        self.only_a + self.only_b
    }
}

/// Words of joints in epochs that both captures have.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Joints {
    /// Epochs with equal words.
    pub equal: u64,
    /// Epochs with differences within the tolerance.
    pub tolerated: u64,
    /// Epochs with larger differences.
    pub different: u64,
    /// The largest difference of a word.
    pub max_steps: u32,
}

/// Touches; each counts a cell in an epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Contacts {
    /// Touches in both captures.
    pub both: u64,
    /// Touches in one capture only.
    #[serde(flatten)]
    pub only: UnpairedCounts,
}

/// Replies in epochs that both captures have.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Replies {
    /// Replies with equal words.
    pub equal: u64,
    /// Replies with differences within the tolerance.
    pub tolerated: u64,
    /// Replies with larger differences.
    pub different: u64,
    /// Different replies despite the same joints, contact state and configuration.
    pub different_with_same_inputs: u64,
    /// Replies in B only.
    pub missing_in_a: u64,
    /// Replies in A only.
    pub missing_in_b: u64,
    /// Replies in one capture only, at the last joints of the other, which ended before the reply.
    pub open: u64,
    /// The largest difference of a word.
    pub max_steps: u32,
}

impl Replies {
    /// Returns the number of replies that only one capture has.
    #[must_use]
    pub const fn missing(&self) -> u64 {
        self.missing_in_a + self.missing_in_b
    }
}

/// The figures of one cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellRow {
    /// Its bus.
    pub bus: String,
    /// Its node id.
    pub node: u8,
    /// Its torques or sums.
    #[serde(flatten)]
    pub replies: Replies,
    /// Its losses in each capture.
    pub losses: Both<Losses>,
}

/// Losses of a cell in one capture.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Losses {
    /// Replies after the next joints.
    pub late: u64,
    /// Late replies that were too late to be used.
    pub too_late: u64,
    /// Packets that it counted but that are not in the capture.
    pub lost: u64,
    /// Restarts.
    pub restarts: u64,
}

/// A cell that occurs in one capture only.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct ExtraCell {
    /// Its bus.
    pub bus: String,
    /// Its node id.
    pub node: u8,
    /// The capture that has it: `a` or `b`.
    pub only_in: &'static str,
}

/// The first difference.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FirstDifference {
    /// The item: `epoch`, `joints`, `halt`, `contact`, `torque` or `sum`.
    pub what: &'static str,
    /// The difference: `different`, `missing in a` or `missing in b`.
    pub how: &'static str,
    /// The bus.
    pub bus: String,
    /// The cell, if the difference belongs to one.
    pub cell: Option<u8>,
    /// The robot's joint, from 1, if words differ.
    pub joint: Option<u8>,
    /// The epoch.
    pub epoch: u8,
    /// The number of its joints since the run began.
    pub number: u64,
    /// The time of the joints in s of each run; absent without joints, and if a log has no times.
    pub time_s: Both<Option<f64>>,
    /// The words.
    pub words: Both<Option<i16>>,
    /// The values of the words, in [`First::unit`].
    pub values: Both<Option<f64>>,
    /// Nm, N, rad or m; absent without words.
    pub unit: Option<&'static str>,
    /// The difference in steps of the tolerance; absent without words.
    pub steps: Option<u32>,
    /// The inputs of the cell that differ: `joints`, `halt`, `stimulus`, `configuration`, `restart`, `cells`.
    pub inputs: Vec<&'static str>,
    /// The inputs that are unknown in at least one capture.
    pub unknown_inputs: Vec<&'static str>,
    /// The occurrence of this epoch in each capture, as counted by `skinbus explain --occurrence`.
    pub occurrence: Both<Option<u32>>,
}
