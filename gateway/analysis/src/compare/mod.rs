//! Compares two captures of one skin, epoch by epoch: `skinbus compare`.
//!
//! ```text
//!   frames of A ──> Side: Moments by Key ──┐
//!                                          ├──> the same Key ──> Tally, First ──> Report
//!   frames of B ──> Side: Moments by Key ──┘
//! ```
//!
//! A `Key` is the number of a joints packet since the run began. The captures are read in lockstep, always the one that
//! is behind ([`Comparison::next_side`]), so that memory does not grow with their length: about 100 joints per bus are
//! held.

mod align;
mod numbering;
mod outcome;
mod pair;
mod report;
mod side;

use protocol::id::CellId;
use protocol::message::Message;
use protocol::skin::Skin;
use serde::Serialize;

use self::numbering::JointsKey;
use self::pair::{ComparisonCounts, FirstDifferences, FoundDifference, compare_joints};
use self::side::{AnsweredJoints, ComparedCapture};
use crate::explain::JointsNotFound;

pub use self::align::{JointTrace, first_joints_numbers};
pub use self::report::{
    COMPARED_ASPECTS, CaptureFigures, CellLosses, CompareReport, ComparedCellRow, ContactCounts, EpochCounts,
    ExtraCell, FirstDifference, JointCounts, ReplyCounts, UnpairedCounts,
};

/// One of the two captures that are compared.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum CaptureSide {
    /// The first one.
    A,
    /// The second one.
    B,
}

impl CaptureSide {
    const fn other_side(self) -> Self {
        if matches!(self, Self::A) { Self::B } else { Self::A }
    }
}

/// A pair of values, one for each capture.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct PerCapture<T> {
    /// The value of capture A.
    pub a: T,
    /// The value of capture B.
    pub b: T,
}

impl<T> PerCapture<T> {
    /// Returns the value of one capture.
    #[must_use]
    pub const fn get(&self, which: CaptureSide) -> &T {
        match which {
            CaptureSide::A => &self.a,
            CaptureSide::B => &self.b,
        }
    }

    /// Returns the mutable value of one capture.
    pub const fn get_mut(&mut self, which: CaptureSide) -> &mut T {
        match which {
            CaptureSide::A => &mut self.a,
            CaptureSide::B => &mut self.b,
        }
    }
}

/// The tolerances of a comparison, above which two captures count as different.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct CompareOptions {
    /// Tolerance for words of torques (in 1/4096 Nm) and sums (in 1/256 Nm).
    pub tolerance: u32,
    /// Tolerance for words of joints, in steps of 2^-14 quarter turns, or m for prismatic joints.
    pub joints_tolerance: u32,
    /// Number of replies and joints that may be missing from one of the captures.
    pub missing: u64,
}

/// Compares two captures.
#[derive(Debug)]
pub struct Comparison<'a> {
    skin: &'a Skin,
    options: CompareOptions,
    sides: PerCapture<ComparedCapture<'a>>,
    tallies: Vec<ComparisonCounts>,
    epochs: EpochCounts,
    /// The first difference that counts in any case, and the first missing item, each with its joints and bus.
    first: Option<(JointsKey, usize, FirstDifference)>,
    first_missing: Option<(JointsKey, usize, FirstDifference)>,
}

/// Returns the period of epochs, in ns.
fn period_ns(skin: &Skin) -> u64 {
    skin.timing.tick_nanos() * u64::from(skin.timing.ticks_per_broadcast)
}

impl<'a> Comparison<'a> {
    /// Creates a comparison of two captures that have not been read yet. The first joints of each capture get the
    /// number in `starts`, or else the number of their epoch.
    #[must_use]
    pub fn new(skin: &'a Skin, options: CompareOptions, starts: PerCapture<Option<u64>>) -> Self {
        let period = period_ns(skin);
        let side = |start| ComparedCapture::new(skin, period, start);
        Self {
            skin,
            options,
            sides: PerCapture { a: side(starts.a), b: side(starts.b) },
            tallies: skin.buses.iter().map(|_| ComparisonCounts::default()).collect(),
            epochs: EpochCounts::default(),
            first: None,
            first_missing: None,
        }
    }

    /// Returns the capture whose next frame must be read: the one that is behind in the run. Returns `None` when both
    /// have ended.
    #[must_use]
    pub fn next_side(&self) -> Option<CaptureSide> {
        let PerCapture { a, b } = &self.sides;
        match (a.is_ended, b.is_ended) {
            (true, true) => None,
            (true, false) => Some(CaptureSide::B),
            (false, true) => Some(CaptureSide::A),
            (false, false) => Some(if a.newest() <= b.newest() { CaptureSide::A } else { CaptureSide::B }),
        }
    }

    /// Handles a packet from before the start of a capture, which still has an effect: a recording begins with these.
    pub fn receive_latched(&mut self, which: CaptureSide, nanos: u64, bus: &str, message: &Message) {
        self.sides.get_mut(which).receive_latched(nanos, bus, message);
    }

    /// Handles the next frame of a capture; `message` is the decoded message, if the frame completes one.
    pub fn receive(&mut self, which: CaptureSide, nanos: u64, bus: &str, message: Option<&Message>) {
        if self.sides.get_mut(which).receive(nanos, bus, message) {
            self.compare_complete_joints();
        }
    }

    /// Counts frames that the recorder of a capture lost.
    pub fn record_dropped(&mut self, which: CaptureSide, frames: u64) {
        let dropped = &mut self.sides.get_mut(which).counts.dropped;
        *dropped = dropped.saturating_add(frames);
    }

    /// Declares that the time stamps of a capture are meaningless.
    pub fn mark_untimed(&mut self, which: CaptureSide) {
        self.sides.get_mut(which).has_times = false;
    }

    /// Declares the end of a capture; `is_unfinished` if it was cut off.
    pub fn end_capture(&mut self, which: CaptureSide, is_unfinished: bool) {
        let side = self.sides.get_mut(which);
        side.counts.unfinished = is_unfinished;
        side.end_capture();
        self.compare_complete_joints();
    }

    /// Returns the reason why a capture that has been read to its end has no joints of the skin; `None` if it has some.
    pub fn not_found_reason(&mut self, which: CaptureSide) -> Option<JointsNotFound> {
        self.sides.get_mut(which).not_found()
    }

    /// Returns two numbers of cells: those that reported a configuration, and those of them that have the skin's.
    /// Returns `None` if these are at least half.
    #[must_use]
    pub fn reported_and_matching_cells(&self, which: CaptureSide) -> Option<(usize, usize)> {
        let hash = |bus: usize, node| {
            let cell = self.sides.get(which).buses.get(bus)?.cells.get(node)?;
            cell.tracked.claim().heartbeat().map(|it| it.configuration).filter(|hash| *hash != 0)
        };
        let reported = self.skin.cells.iter().filter_map(|cell| Some((cell, hash(cell.bus, cell.node)?)));
        let (all, same) = reported.fold((0, 0), |(all, same), (cell, hash)| {
            (all + 1, same + usize::from(hash == self.skin.parameters(cell).hash()))
        });
        (same * 2 < all).then_some((all, same))
    }

    /// Compares the next joints of all buses, as long as their answers are complete in both captures.
    fn compare_complete_joints(&mut self) {
        for bus in 0..self.skin.buses.len() {
            while self.compare_next_joints(bus).is_some() {}
        }
    }

    /// Compares the next joints of one bus; `None` if their answers may not be complete.
    fn compare_next_joints(&mut self, bus: usize) -> Option<()> {
        let front =
            |side: &ComparedCapture<'_>| side.buses.get(bus).and_then(|it| it.ready.front()).map(|it| it.key);
        let both = (front(&self.sides.a), front(&self.sides.b));
        let which = match both {
            (Some(a), Some(b)) if a == b => {
                let mut take = |which| self.sides.get_mut(which).buses.get_mut(bus)?.ready.pop_front();
                let (a, b) = (take(CaptureSide::A)?, take(CaptureSide::B)?);
                self.compare_answered_joints(bus, &a, &b);
                return Some(());
            }
            (Some(a), Some(b)) => {
                if a < b {
                    CaptureSide::A
                } else {
                    CaptureSide::B
                }
            }
            (Some(a), None) if self.sides.b.is_past(bus, a) => CaptureSide::A,
            (None, Some(b)) if self.sides.a.is_past(bus, b) => CaptureSide::B,
            _ => return None,
        };
        let moment = self.sides.get_mut(which).buses.get_mut(bus)?.ready.pop_front()?;
        self.count_unpaired_joints(bus, which, &moment);
        Some(())
    }

    fn compare_answered_joints(&mut self, bus: usize, a: &AnsweredJoints, b: &AnsweredJoints) {
        self.epochs.compared += 1;
        let Some(tally) = self.tallies.get_mut(bus) else { return };
        let found = compare_joints(tally, (self.skin, bus), PerCapture { a, b }, &self.options);
        self.keep_first_differences(bus, PerCapture { a: Some(a), b: Some(b) }, found);
    }

    /// Counts joints that only one capture has.
    fn count_unpaired_joints(&mut self, bus: usize, which: CaptureSide, moment: &AnsweredJoints) {
        let other = self.sides.get(which.other_side());
        let is_a = which == CaptureSide::A;
        match (other.first, other.newest()) {
            (Some((first, _)), _) if moment.key < first => self.epochs.before.count_item(is_a),
            (None, _) => self.epochs.before.count_item(is_a),
            (_, Some(last)) if other.is_ended && moment.key > last && !other.counts.unfinished => {
                self.epochs.after.count_item(is_a);
            }
            _ => {
                let missing =
                    if is_a { &mut self.epochs.missing_in_b } else { &mut self.epochs.missing_in_a };
                *missing += 1;
                let moments = match which {
                    CaptureSide::A => PerCapture { a: Some(moment), b: None },
                    CaptureSide::B => PerCapture { a: None, b: Some(moment) },
                };
                self.keep_first_differences(bus, moments, FoundDifference::missing_epoch(!is_a));
            }
        }
    }

    /// Keeps the first differences of these joints if they are the earliest so far; buses are not compared in order of
    /// time.
    fn keep_first_differences(
        &mut self,
        bus: usize,
        moments: PerCapture<Option<&AnsweredJoints>>,
        firsts: FirstDifferences,
    ) {
        let Some(key) = moments.a.or(moments.b).map(|moment| moment.key) else { return };
        let is_first = |kept: &Option<(JointsKey, usize, FirstDifference)>| {
            kept.as_ref().is_none_or(|(first, on, _)| (*first, *on) > (key, bus))
        };
        if let Some(found) = firsts.other.filter(|_| is_first(&self.first)) {
            self.first = self.describe_difference(bus, &moments, found).map(|first| (key, bus, first));
        }
        if let Some(found) = firsts.missing.filter(|_| is_first(&self.first_missing)) {
            self.first_missing =
                self.describe_difference(bus, &moments, found).map(|first| (key, bus, first));
        }
    }

    fn describe_difference(
        &self,
        bus: usize,
        moments: &PerCapture<Option<&AnsweredJoints>>,
        mut found: FoundDifference,
    ) -> Option<FirstDifference> {
        if let Some(cell) = found.cell()
            && self.restart_count(bus, cell, CaptureSide::A) != self.restart_count(bus, cell, CaptureSide::B)
        {
            found.inputs.push("restart");
        }
        let PerCapture { a, b } = &self.sides;
        let time_s = PerCapture {
            a: moments.a.and_then(|moment| a.run_seconds_at(moment.watched.at_ns)),
            b: moments.b.and_then(|moment| b.run_seconds_at(moment.watched.at_ns)),
        };
        found.describe_difference((self.skin, bus), moments, time_s)
    }

    fn restart_count(&self, bus: usize, cell: CellId, which: CaptureSide) -> u32 {
        let cell = self.sides.get(which).buses.get(bus).and_then(|bus| bus.cells.get(cell));
        cell.map_or(0, |cell| cell.tracked.account.uplink().restarts)
    }

    /// Returns the number of joints that wait in memory to be compared.
    #[cfg(test)]
    fn held(&self) -> usize {
        self.sides.a.held() + self.sides.b.held()
    }
}

#[cfg(test)]
mod tests;
