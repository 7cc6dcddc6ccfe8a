//! Times of readings against those of their joints, stretch by stretch.
//!
//! Where joints were not broadcast in time, what follows may be shifted: sensors of simulated cells follow a plan, the loop
//! counts broadcasts. All cells of a bus are shifted alike, so that the shift of each stretch between gaps is known
//! well from all of them, while the age that a single sensor has of its own is not touched. Long stretches are divided:
//! broadcasts that were a little late, or clocks that differ, shift readings without a gap.

use crate::observe::BusObservations;

/// Broadcasts of a stretch at most, about 4 s.
const LONGEST: usize = 256;

/// By stretch of a bus, how much older its readings are than the others', in s.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Lags {
    pub(crate) by_stretch: Vec<f64>,
    /// Standard deviations of these, in s; 0 of those that were not estimated.
    pub(crate) deviations: Vec<f64>,
    /// The first broadcast of each stretch but the first.
    pub(crate) starts: Vec<usize>,
}

impl Lags {
    /// Returns lags of zero.
    pub(crate) fn none(bus: &BusObservations) -> Self {
        let mut starts = Vec::new();
        let mut begin = 0;
        for end in bus.gaps.iter().map(|gap| gap.place).chain([bus.joints.len()]) {
            let parts = end.saturating_sub(begin).div_ceil(LONGEST).max(1);
            starts.extend((1..parts).map(|part| begin + (end - begin) * part / parts));
            starts.push(end);
            begin = end;
        }
        starts.pop();
        let none = vec![0.0; starts.len() + 1];
        Self { by_stretch: none.clone(), deviations: none, starts }
    }

    /// The stretch of a broadcast.
    pub(crate) fn stretch(&self, index: usize) -> usize {
        self.starts.partition_point(|start| *start <= index)
    }

    /// Returns the lag of a broadcast, in s.
    pub(crate) fn at(&self, index: usize) -> f64 {
        self.by_stretch.get(self.stretch(index)).copied().unwrap_or_default()
    }

    /// The standard deviation of the lag of each stretch, in s.
    pub(crate) fn deviations(&self) -> &[f64] {
        &self.deviations
    }

    /// From the smallest lag to the largest one, in s.
    pub(crate) fn range(&self) -> f64 {
        let all = || self.by_stretch.iter().copied();
        (all().fold(f64::NEG_INFINITY, f64::max) - all().fold(f64::INFINITY, f64::min)).max(0.0)
    }

    /// The stretch that is off most: its first broadcast, and by how much, in s.
    pub(crate) fn most(&self) -> (usize, f64) {
        let all = core::iter::once(0).chain(self.starts.iter().copied()).zip(self.by_stretch.iter().copied());
        all.max_by(|(_, one), (_, other)| one.abs().total_cmp(&other.abs())).unwrap_or_default()
    }
}
