//! Lags: the times of readings relative to those of their joints, for each stretch of a recording.
//!
//! Readings may be shifted after a broadcast that was not in time, because the sensors of simulated cells follow the
//! planned motion in time while the loop counts broadcasts. All cells of a bus are shifted alike. The shift of each
//! stretch between gaps is therefore well determined by all of them, and does not affect the individual age of a
//! sensor. Long stretches are divided, because slightly late broadcasts and differing clocks shift readings without a
//! gap.

use crate::observe::BusObservations;

/// The maximum number of broadcasts in a stretch, about 4 s.
const MAX_STRETCH_BROADCASTS: usize = 256;

/// The lags of a bus: the additional age of the readings of each stretch, in s.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct StretchLags {
    pub(crate) by_stretch: Vec<f64>,
    /// The standard deviations of the lags, in s; 0 for lags that were not estimated.
    pub(crate) deviations: Vec<f64>,
    /// The first broadcast of each stretch except the first one.
    pub(crate) starts: Vec<usize>,
}

impl StretchLags {
    /// Returns lags of zero for all stretches of a bus.
    pub(crate) fn zero_lags(bus: &BusObservations) -> Self {
        let mut starts = Vec::new();
        let mut begin = 0;
        for end in bus.gaps.iter().map(|gap| gap.place).chain([bus.joints.len()]) {
            let parts = end.saturating_sub(begin).div_ceil(MAX_STRETCH_BROADCASTS).max(1);
            starts.extend((1..parts).map(|part| begin + (end - begin) * part / parts));
            starts.push(end);
            begin = end;
        }
        starts.pop();
        let none = vec![0.0; starts.len() + 1];
        Self { by_stretch: none.clone(), deviations: none, starts }
    }

    /// Returns the index of the stretch that contains a broadcast.
    pub(crate) fn stretch_index(&self, index: usize) -> usize {
        self.starts.partition_point(|start| *start <= index)
    }

    /// Returns the lag of the stretch that contains a broadcast, in s.
    pub(crate) fn lag_at(&self, index: usize) -> f64 {
        self.by_stretch.get(self.stretch_index(index)).copied().unwrap_or_default()
    }

    /// Returns the standard deviation of the lag of each stretch, in s.
    pub(crate) fn lag_deviations(&self) -> &[f64] {
        &self.deviations
    }

    /// Returns the difference between the largest and the smallest lag, in s.
    pub(crate) fn lag_range_s(&self) -> f64 {
        let all = || self.by_stretch.iter().copied();
        (all().fold(f64::NEG_INFINITY, f64::max) - all().fold(f64::INFINITY, f64::min)).max(0.0)
    }

    /// Returns the first broadcast and the lag in s of the stretch with the largest absolute lag.
    pub(crate) fn stretch_with_largest_lag(&self) -> (usize, f64) {
        let all = core::iter::once(0).chain(self.starts.iter().copied()).zip(self.by_stretch.iter().copied());
        all.max_by(|(_, one), (_, other)| one.abs().total_cmp(&other.abs())).unwrap_or_default()
    }
}
