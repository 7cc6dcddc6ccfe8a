//! The outcome of a comparison; `skinbus compare --json` prints it.

use model::quantiles::Quantiles;
use serde::Serialize;

use super::Both;

/// The outcome of a comparison.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// True if nothing differs that counts.
    pub equal: bool,
    /// The aspects that differ, in the order of [`ASPECTS`].
    pub differs: Vec<&'static str>,
    /// The two captures.
    pub captures: Both<Source>,
    /// Joints that both, one or none has.
    pub epochs: Epochs,
    /// Words of joints.
    pub joints: Joints,
    /// Joints at which one run was halted and the other was not.
    pub halts: Only,
    /// Touches, cell by cell and epoch by epoch.
    pub contacts: Contacts,
    /// Torques of single cells.
    pub torques: Replies,
    /// Sums of roots.
    pub sums: Replies,
    /// Cells that differ, or lost something, by bus and node id.
    pub cells: Vec<CellRow>,
    /// Cells of which one capture has no packet.
    pub extra_cells: Vec<ExtraCell>,
    /// The first difference.
    pub first: Option<First>,
}

/// The aspects that are compared.
pub const ASPECTS: [&str; 7] = ["epochs", "joints", "halts", "contacts", "torques", "sums", "cells"];

/// One capture.
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
    /// The time of the last joints in s of the run; absent where a log has no times.
    pub last_s: Option<f64>,
    /// How often epochs were counted from 0.
    pub countings: u32,
    /// Joints out of order, which are left out.
    pub out_of_order: u64,
    /// Frames that the recorder lost.
    pub dropped: u64,
    /// Whether the capture has no end.
    pub unfinished: bool,
    /// Torques that came in time to be used.
    pub torques: u64,
    /// Sums of roots that came in time to be used.
    pub sums: u64,
    /// Replies after the next joints.
    pub late: u64,
    /// Of these, replies too late to be used.
    pub too_late: u64,
    /// Packets that cells counted and that are not in the capture.
    pub lost: u64,
    /// Restarts of cells.
    pub restarts: u64,
    /// Times from joints to their replies, in µs; absent without replies, and where a log has no times.
    pub reply_us: Option<Quantiles>,
}

/// Joints by number, those of each bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Epochs {
    /// In both.
    pub compared: u64,
    /// Not in A, and in B within the time of both.
    pub missing_in_a: u64,
    /// Not in B, and in A within the time of both.
    pub missing_in_b: u64,
    /// In one before the other begins.
    pub before: Only,
    /// In one after the other has ended.
    pub after: Only,
}

/// Counts of what one has and the other has not.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Only {
    /// In A.
    pub only_a: u64,
    /// In B.
    pub only_b: u64,
}

impl Only {
    pub(super) const fn count(&mut self, is_a: bool) {
        *(if is_a { &mut self.only_a } else { &mut self.only_b }) += 1;
    }

    /// Returns the count of both.
    #[must_use]
    pub const fn sum(self) -> u64 {
        self.only_a + self.only_b
    }
}

/// Words of joints in epochs that both have.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Joints {
    /// The same words.
    pub equal: u64,
    /// Other words within the tolerance.
    pub tolerated: u64,
    /// Other words.
    pub different: u64,
    /// The largest difference of a word.
    pub max_steps: u32,
}

/// Touches: a cell in an epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Contacts {
    /// In both.
    pub both: u64,
    /// In one and not in the other.
    #[serde(flatten)]
    pub only: Only,
}

/// Replies in epochs that both have.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Replies {
    /// The same words.
    pub equal: u64,
    /// Other words within the tolerance.
    pub tolerated: u64,
    /// Other words.
    pub different: u64,
    /// Of these, with the same joints, contact state and configuration.
    pub different_with_same_inputs: u64,
    /// In B and not in A.
    pub missing_in_a: u64,
    /// In A and not in B.
    pub missing_in_b: u64,
    /// In one alone, at the last joints of the other, which ended before it answered.
    pub open: u64,
    /// The largest difference of a word.
    pub max_steps: u32,
}

impl Replies {
    /// Returns the count of those that one capture alone has.
    #[must_use]
    pub const fn missing(&self) -> u64 {
        self.missing_in_a + self.missing_in_b
    }
}

/// One cell.
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
    /// Of these, replies too late to be used.
    pub too_late: u64,
    /// Packets that it counted and that are not in the capture.
    pub lost: u64,
    /// Restarts.
    pub restarts: u64,
}

/// A cell of one capture alone.
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
pub struct First {
    /// What differs: `epoch`, `joints`, `halt`, `contact`, `torque` or `sum`.
    pub what: &'static str,
    /// How: `different`, `missing in a` or `missing in b`.
    pub how: &'static str,
    /// The bus.
    pub bus: String,
    /// The cell, if it is one's.
    pub cell: Option<u8>,
    /// The robot's joint, from 1, if words differ.
    pub joint: Option<u8>,
    /// The epoch.
    pub epoch: u8,
    /// The number of its joints since the run began.
    pub number: u64,
    /// The time of the joints in s of each run; absent where there are none, and where a log has no times.
    pub time_s: Both<Option<f64>>,
    /// The words.
    pub words: Both<Option<i16>>,
    /// The same in [`First::unit`].
    pub values: Both<Option<f64>>,
    /// Nm, N, rad or m; absent without words.
    pub unit: Option<&'static str>,
    /// The difference in steps of the tolerance; absent without words.
    pub steps: Option<u32>,
    /// The inputs of the cell that differ: `joints`, `halt`, `stimulus`, `configuration`, `restart`, `cells`.
    pub inputs: Vec<&'static str>,
    /// The inputs that one capture or both do not show.
    pub unknown_inputs: Vec<&'static str>,
    /// Which joints of this epoch they are in each capture, as `skinbus explain --occurrence` counts them.
    pub occurrence: Both<Option<u32>>,
}
