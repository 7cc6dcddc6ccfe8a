//! Values over time in bounded memory: the smallest and the largest value of each interval.

use std::ops::Range;

/// An interval without a value.
const EMPTY: [f32; 2] = [f32::NAN, f32::NAN];

/// Some quantities over time. When the memory is used up, the intervals become twice as long.
#[derive(Debug, Default)]
pub struct Series {
    /// The number of quantities.
    quantities: usize,
    /// The beginning of the first interval, in ns since 1970.
    first: u64,
    /// The length of an interval in ns.
    width: u64,
    /// The maximum number of intervals.
    limit: usize,
    /// The smallest and the largest value of each quantity in the first interval, then those in the next one.
    ranges: Vec<[f32; 2]>,
}

/// A part of the values over time.
#[derive(Clone, Debug, PartialEq)]
pub struct SeriesPart {
    /// The beginning of the first interval, in ns since 1970.
    pub from: u64,
    /// The length of an interval in ns.
    pub width: u64,
    /// For each requested quantity: the smallest and the largest value in each interval, NaN without a value.
    pub ranges: Vec<Vec<[f32; 2]>>,
}

impl Series {
    /// Creates values of some quantities from `first` on, in ns since 1970, with intervals of at least `width` ns and
    /// with at most `bytes` of memory.
    #[must_use]
    pub fn new(quantities: usize, first: u64, width: u64, bytes: usize) -> Self {
        let limit = bytes / (quantities.max(1) * size_of::<[f32; 2]>());
        Self { quantities, first, width: width.max(1), limit: limit.max(2), ranges: Vec::new() }
    }

    /// Returns the number of quantities.
    #[must_use]
    pub const fn quantity_count(&self) -> usize {
        self.quantities
    }

    /// Adds a value of each quantity at a time in ns since 1970. A value that is not a number is left out.
    pub fn add(&mut self, at: u64, values: impl IntoIterator<Item = f32>) {
        let since = at.saturating_sub(self.first);
        while usize::try_from(since / self.width).map_or(true, |place| place >= self.limit) {
            self.halve();
        }
        let begin = usize::try_from(since / self.width).unwrap_or(0) * self.quantities;
        if self.ranges.len() < begin + self.quantities {
            self.ranges.resize(begin + self.quantities, EMPTY);
        }
        for (range, value) in self.ranges.iter_mut().skip(begin).take(self.quantities).zip(values) {
            widen(range, [value, value]);
        }
    }

    /// Makes the intervals twice as long.
    fn halve(&mut self) {
        self.width = self.width.saturating_mul(2);
        let count = self.ranges.len() / self.quantities.max(1);
        for place in 0..count.div_ceil(2) {
            for quantity in 0..self.quantities {
                let mut range = EMPTY;
                for from in [2 * place, 2 * place + 1] {
                    let old = self.ranges.get(from * self.quantities + quantity);
                    widen(&mut range, old.copied().unwrap_or(EMPTY));
                }
                if let Some(new) = self.ranges.get_mut(place * self.quantities + quantity) {
                    *new = range;
                }
            }
        }
        self.ranges.truncate(count.div_ceil(2) * self.quantities);
    }

    /// Returns some quantities from `from` to `to`, in ns since 1970, in about `count` intervals or fewer.
    #[must_use]
    pub fn part(&self, quantities: Range<usize>, (from, to): (u64, u64), count: u64) -> SeriesPart {
        let length = to.saturating_sub(from).div_ceil(count.max(1));
        let joined = length.div_ceil(self.width.max(1)).max(1);
        let width = self.width.max(1).saturating_mul(joined);
        let all = (self.ranges.len() / self.quantities.max(1)) as u64;
        let place = |at: u64| at.saturating_sub(self.first) / width;
        let begin = place(from);
        let end = (place(to) + 1).min(all.div_ceil(joined)).max(begin);
        let ranges = quantities.map(|quantity| {
            (begin..end).map(|interval| self.joined(quantity, interval * joined, joined)).collect()
        });
        let from = self.first.saturating_add(begin.saturating_mul(width));
        SeriesPart { from, width, ranges: ranges.collect() }
    }

    /// Joins the ranges of a quantity in some intervals.
    fn joined(&self, quantity: usize, from: u64, count: u64) -> [f32; 2] {
        let begin = usize::try_from(from).unwrap_or(usize::MAX).saturating_mul(self.quantities);
        let count = usize::try_from(count).unwrap_or(usize::MAX);
        let of_it = self.ranges.iter().skip(begin.saturating_add(quantity)).step_by(self.quantities.max(1));
        of_it.take(count).fold(EMPTY, |mut all, range| {
            widen(&mut all, *range);
            all
        })
    }
}

/// Widens a range so that it contains another one.
const fn widen(range: &mut [f32; 2], [low, high]: [f32; 2]) {
    // The minimum and the maximum of a number and NaN are the number.
    *range = [range[0].min(low), range[1].max(high)];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_extremes_of_all_values_stay_when_memory_is_short() {
        // Room for 8 intervals of two quantities.
        let mut series = Series::new(2, 1_000, 10, 8 * 2 * 8);
        for at in 0..100_u8 {
            let value = f32::from(at);
            series.add(1_000 + 10 * u64::from(at), [value, if at == 50 { -7.0 } else { f32::NAN }]);
        }
        let part = series.part(0..2, (1_000, 2_000), 600);
        assert_eq!((part.from, part.width), (1_000, 160), "100 intervals of 10 ns in 8");
        assert_eq!(
            part.ranges[0],
            [[0.0, 15.0], [16.0, 31.0], [32.0, 47.0], [48.0, 63.0], [64.0, 79.0], [80.0, 95.0], [96.0, 99.0]]
        );
        let only = part.ranges[1].iter().filter(|range| !range[0].is_nan());
        assert_eq!(only.collect::<Vec<_>>(), [&[-7.0, -7.0]]);
    }

    #[test]
    fn a_part_has_no_more_intervals_than_asked_for() {
        let mut series = Series::new(1, 0, 20, 1 << 20);
        for at in 0..1_000_u16 {
            series.add(20 * u64::from(at), [f32::from(at)]);
        }
        let part = series.part(0..1, (5_000, 15_000), 50);
        assert_eq!((part.from, part.width), (5_000, 200));
        assert!(part.ranges[0].len() <= 51);
        assert_eq!(part.ranges[0].first(), Some(&[250.0, 259.0]));
        let fine = series.part(0..1, (5_000, 5_100), 600);
        assert_eq!((fine.width, fine.ranges[0].len()), (20, 6));
        assert_eq!(series.part(0..1, (1 << 40, 1 << 41), 9).ranges, [Vec::<[f32; 2]>::new()]);
        assert_eq!(Series::default().part(0..1, (0, 9), 9).ranges, [Vec::<[f32; 2]>::new()]);
        series.add(u64::MAX, [1.0]);
        assert!(series.part(0..1, (0, u64::MAX), 600).ranges[0].len() <= 601);
    }
}
