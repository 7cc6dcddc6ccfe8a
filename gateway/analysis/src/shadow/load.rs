//! Measures the highest load of a bus in any time window, and the stretches in which the bus has no pause.

use std::collections::VecDeque;

use super::report::{BusyStretches, Peak};

/// Maximum number of different times within a window; requests beyond that count to the last of them.
const MAX_WINDOW_TIMES: usize = 1 << 16;

/// Finds the highest load in any window of `SPAN` ns, wherever it starts.
#[derive(Debug, Default)]
pub(super) struct LoadWindow<const SPAN: u64> {
    /// Time in ns of each request within the window, and the transmission time in ns that it requests.
    requested: VecDeque<(u64, u64)>,
    sum: u64,
    /// The highest load of a window as a share of `SPAN`, and the start of that window.
    pub(super) most: Peak,
}

impl<const SPAN: u64> LoadWindow<SPAN> {
    /// Records a request at `at` for `nanos` ns of transmission; times never decrease.
    pub(super) fn record_request(&mut self, at: u64, nanos: u64) {
        while let Some(&(then, gone)) = self.requested.front().filter(|(then, _)| then + SPAN <= at) {
            self.requested.pop_front();
            self.sum -= gone;
            debug_assert!(then <= at, "time runs forwards");
        }
        let is_full = self.requested.len() >= MAX_WINDOW_TIMES;
        match self.requested.back_mut() {
            Some((then, sum)) if *then == at || is_full => *sum += nanos,
            _ => self.requested.push_back((at, nanos)),
        }
        self.sum += nanos;
        self.most
            .raise_to(self.sum as f64 / SPAN as f64, self.requested.front().map_or(at, |(first, _)| *first));
    }
}

/// Stretches of time in which the bus carries frames without a pause.
#[derive(Debug, Default)]
pub(super) struct BusyTime {
    /// Time in which the bus was busy, in ns.
    pub(super) total: u64,
    begin: u64,
    end: u64,
    stretches: BusyStretches,
}

impl BusyTime {
    /// Records a transmission from `start` to `end`, in order of time. A stretch of at least `saturated` ns counts as
    /// saturated.
    pub(super) fn record_transmission(&mut self, start: u64, end: u64, saturated: u64) {
        self.total += end - start;
        if start > self.end {
            self.close_busy_stretch(saturated);
            self.begin = start;
        }
        self.end = end;
    }

    fn close_busy_stretch(&mut self, saturated: u64) {
        let length = self.end - self.begin;
        if length >= saturated {
            self.stretches.count += 1;
            self.stretches.total_s += length as f64 / 1e9;
        }
        self.stretches.longest_s.raise_to(length as f64 / 1e9, self.begin);
    }

    /// Returns the number, total and longest of the stretches. Those of at least `saturated` ns count as saturated.
    pub(super) fn stretches(&self, saturated: u64) -> BusyStretches {
        let mut last = Self { stretches: self.stretches, ..Self::default() };
        (last.begin, last.end) = (self.begin, self.end);
        last.close_busy_stretch(saturated);
        last.stretches
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_most_is_that_of_every_span_that_ends_with_a_request(steps in proptest::collection::vec((0..30_u64, 1..9_u64), 1..80)) {
            let mut window = LoadWindow::<50>::default();
            let mut now = 0;
            let requested: Vec<_> = steps.into_iter().map(|(step, nanos)| { now += step; (now, nanos) }).collect();
            requested.iter().for_each(|&(at, nanos)| window.record_request(at, nanos));
            let within = |end: u64| -> u64 { requested.iter().filter(|(at, _)| *at <= end && at + 50 > end).map(|(_, n)| n).sum() };
            let most = requested.iter().map(|(at, _)| within(*at)).max().unwrap();
            prop_assert!((window.most.value - most as f64 / 50.0).abs() < 1e-12);
        }
    }

    #[test]
    fn stretches_end_where_the_wire_is_free() {
        let mut busy = BusyTime::default();
        for (start, end) in [(10, 20), (20, 45), (50, 55), (60, 90), (90, 100)] {
            busy.record_transmission(start, end, 30);
        }
        let stretches = busy.stretches(30);
        assert_eq!((busy.total, stretches.count, stretches.longest_s.at_ns), (80, 2, 60));
        assert!(
            (stretches.total_s - 75e-9).abs() < 1e-15 && (stretches.longest_s.value - 40e-9).abs() < 1e-15
        );
    }
}
