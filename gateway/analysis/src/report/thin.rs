//! Reduces many points to the columns of a picture. Of each column, the first, minimum, maximum and last points are
//! kept: a line through them covers the same pixels as a line through all points (Jugel, Jerzak, Hackenbroich and
//! Markl, *M4: A Visualization-Oriented Time Series Data Aggregation*, 2014).

/// The first, minimum, maximum and last point of a column of a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
struct PointColumn {
    first: (f64, f64),
    min: (f64, f64),
    max: (f64, f64),
    last: (f64, f64),
}

impl PointColumn {
    const fn new(point: (f64, f64)) -> Self {
        Self { first: point, min: point, max: point, last: point }
    }

    fn merge_later(&mut self, later: &Self) {
        if later.min.1 < self.min.1 {
            self.min = later.min;
        }
        if later.max.1 > self.max.1 {
            self.max = later.max;
        }
        self.last = later.last;
    }

    /// Returns the points of the column without repetitions, in order.
    fn points(&self) -> impl Iterator<Item = (f64, f64)> + use<> {
        let (a, b) = if self.min.0 <= self.max.0 { (self.min, self.max) } else { (self.max, self.min) };
        let mut before = None;
        [self.first, a, b, self.last].into_iter().filter(move |point| before.replace(*point) != Some(*point))
    }
}

/// A line with any number of points, reduced to bounded memory. Points arrive by increasing x. When there are too many
/// columns, pairs of columns are merged.
#[derive(Clone, Debug)]
pub struct ThinnedLine {
    most: usize,
    /// Width of a column in units of x; it doubles with each merge.
    width: f64,
    /// Start of the first column, in units of x.
    from: Option<f64>,
    /// Columns by their index, each with true if the line has a gap before it.
    columns: Vec<(u64, bool, PointColumn)>,
    /// Number of points that were added, without gaps.
    count: u64,
    /// True if a gap follows the last point.
    gap: bool,
}

impl Default for ThinnedLine {
    /// Creates a line with as many columns as a page can show, each 2 ms wide at first.
    fn default() -> Self {
        Self::new(1_000, 0.002)
    }
}

impl ThinnedLine {
    /// Creates an empty line with at most `most` columns (at least 2). The columns are `width` wide at first.
    #[must_use]
    pub fn new(most: usize, width: f64) -> Self {
        Self { most: most.max(2), width, from: None, columns: Vec::new(), count: 0, gap: false }
    }

    /// Returns the number of points so far.
    #[must_use]
    pub const fn point_count(&self) -> u64 {
        self.count
    }

    /// Adds the next point. A value that is not a number makes a gap in the line. Points to the left of the first one
    /// are skipped.
    pub fn push(&mut self, x: f64, y: f64) {
        if !(x.is_finite() && y.is_finite()) {
            self.gap = !self.columns.is_empty();
            return;
        }
        let from = *self.from.get_or_insert(x);
        if x < from {
            return;
        }
        self.count += 1;
        let mut at = self.column_index(x - from);
        while self.columns.len() >= self.most && self.columns.last().is_some_and(|(last, ..)| *last != at)
            || self.columns.first().is_some_and(|(first, ..)| at - first >= 2 * self.most as u64)
        {
            self.merge_column_pairs();
            at = self.column_index(x - from);
        }
        let (gap, new) = (std::mem::take(&mut self.gap), PointColumn::new((x, y)));
        append_or_merge(&mut self.columns, (at, gap, new));
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "not negative; far ones saturate, and merge"
    )]
    fn column_index(&self, distance: f64) -> u64 {
        (distance / self.width) as u64
    }

    /// Merges pairs of columns.
    fn merge_column_pairs(&mut self) {
        self.width *= 2.0;
        let mut merged = Vec::with_capacity(self.columns.len());
        self.columns
            .iter()
            .for_each(|&(at, gap, column)| append_or_merge(&mut merged, (at / 2, gap, column)));
        self.columns = merged;
    }

    /// Returns the points that are kept: at most four for each column, by increasing x. A gap is a point whose value is
    /// not a number.
    #[must_use]
    pub fn points(&self) -> Vec<(f64, f64)> {
        let mut points = Vec::with_capacity(self.columns.len() * 4);
        for (_, gap, column) in &self.columns {
            points.extend(gap.then_some((column.first.0, f64::NAN)));
            points.extend(column.points());
        }
        points
    }
}

/// Appends a column, or merges it into the last one if it is not to the right of it: a late point counts to the newest
/// column.
fn append_or_merge(columns: &mut Vec<(u64, bool, PointColumn)>, (at, gap, column): (u64, bool, PointColumn)) {
    match columns.last_mut() {
        Some((last, before, joined)) if *last >= at => {
            *before |= gap;
            joined.merge_later(&column);
        }
        _ => columns.push((at, gap, column)),
    }
}

/// Reduces a list of points: at most four are kept for each of `columns` equal parts of the range 0 to 1 in x.
#[must_use]
pub fn thin_points(points: &[(f64, f64)], columns: u32) -> Vec<(f64, f64)> {
    if points.len() <= 4 * columns as usize {
        return points.to_vec();
    }
    let place = |x: f64| (x * f64::from(columns)).floor();
    points
        .chunk_by(|a, b| (place(a.0) - place(b.0)).abs() < 0.5)
        .filter_map(|points| {
            points.iter().map(|point| PointColumn::new(*point)).reduce(|mut sum, next| {
                sum.merge_later(&next);
                sum
            })
        })
        .flat_map(|column| column.points())
        .collect()
}

/// Sums of amounts over equal bins of x, in bounded memory. When there are too many bins, pairs of bins are merged.
#[derive(Clone, Debug)]
pub struct BinnedSums {
    most: usize,
    width: f64,
    from: Option<f64>,
    bins: Vec<f64>,
}

impl Default for BinnedSums {
    /// Creates 600 bins, 0.1 s wide at first.
    fn default() -> Self {
        Self::new(600, 0.1)
    }
}

impl BinnedSums {
    /// Creates at most `most` empty bins (at least 2), each `width` wide at first.
    #[must_use]
    pub fn new(most: usize, width: f64) -> Self {
        Self { most: most.max(2), width, from: None, bins: Vec::new() }
    }

    /// Adds `amount` to the bin at `x`. A position to the left of the first bin counts to the first one.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "not negative; far ones saturate, and merge"
    )]
    pub fn add(&mut self, x: f64, amount: f64) {
        if !x.is_finite() {
            return;
        }
        let distance = (x - *self.from.get_or_insert(x)).max(0.0);
        while distance / self.width >= self.most as f64 {
            self.width *= 2.0;
            self.bins = self.bins.chunks(2).map(|pair| pair.iter().sum()).collect();
        }
        let at = (distance / self.width) as usize;
        if self.bins.len() <= at {
            self.bins.resize(at + 1, 0.0);
        }
        if let Some(bin) = self.bins.get_mut(at) {
            *bin += amount;
        }
    }

    /// Returns the present width of a bin, in units of x.
    #[must_use]
    pub const fn bin_width(&self) -> f64 {
        self.width
    }

    /// Returns the start of each bin, and the sum in it divided by its width. The last bin may be incomplete, and is
    /// omitted unless it is the only one.
    #[must_use]
    pub fn bin_rates(&self) -> Vec<(f64, f64)> {
        let from = self.from.unwrap_or(0.0);
        let whole = self.bins.len().saturating_sub(1).max(1);
        let bins = self.bins.iter().take(whole).enumerate();
        bins.map(|(at, sum)| (from + at as f64 * self.width, sum / self.width)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ends(points: &[(f64, f64)]) -> (f64, f64) {
        points
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), (_, y)| (min.min(*y), max.max(*y)))
    }

    #[test]
    fn a_peak_of_one_point_in_a_million_stays_where_it_was() {
        let mut line = ThinnedLine::new(500, 0.002);
        for n in 0..1_000_000_u32 {
            let y = if n == 654_321 { 99.0 } else { f64::from(n % 7) };
            line.push(f64::from(n) * 0.002, y);
        }
        let points = line.points();
        assert!((500..=2_000).contains(&points.len()), "{}", points.len());
        assert_eq!(line.point_count(), 1_000_000);
        assert!(points.contains(&(654_321.0 * 0.002, 99.0)));
        assert_eq!(points.first(), Some(&(0.0, 0.0)));
        assert_eq!(points.last(), Some(&(999_999.0 * 0.002, f64::from(999_999 % 7))));
        assert!(points.is_sorted_by(|a, b| a.0 <= b.0));
    }

    #[test]
    fn a_gap_stays_a_gap_when_columns_become_wider() {
        let mut line = ThinnedLine::new(16, 1.0);
        for n in 0..1_000_u32 {
            line.push(n.into(), if (300..700).contains(&n) { f64::NAN } else { 1.0 });
        }
        let points = line.points();
        let gaps: Vec<_> = points.iter().filter(|(_, y)| y.is_nan()).map(|(x, _)| *x).collect();
        assert_eq!(gaps.len(), 1, "{points:?}");
        let before = points.iter().take_while(|(_, y)| !y.is_nan()).last().unwrap().0;
        let after = points.iter().skip_while(|(_, y)| !y.is_nan()).nth(1).unwrap().0;
        assert_eq!((before, after), (299.0, 700.0));
    }

    #[test]
    fn what_is_added_to_bins_is_all_there_when_they_become_wider() {
        let mut bins = BinnedSums::new(10, 0.1);
        for n in 0..1_000_u32 {
            bins.add(5.0 + f64::from(n) * 0.01, 2.0);
        }
        assert!((bins.bin_width() - 1.6).abs() < 1e-12, "10 s in at most 10 bins: {}", bins.bin_width());
        let rates = bins.bin_rates();
        assert_eq!(rates.len(), 6, "the last is not full");
        for (at, (x, rate)) in (0_u32..).zip(&rates) {
            assert!((x - 5.0 - f64::from(at) * 1.6).abs() < 1e-9, "{x}");
            assert!((rate - 200.0).abs() < 2.5, "{rate}");
        }
    }

    proptest! {
        /// The reduction keeps the extremes of every column and adds no new points; checked by brute force.
        #[test]
        fn thinning_keeps_the_extremes_of_every_column(
            ys in proptest::collection::vec(-100..100_i32, 1..4_000), columns in 2_u32..40,
        ) {
            let count = ys.len() as f64;
            let points: Vec<_> = ys.iter().enumerate().map(|(n, y)| (n as f64 / count, f64::from(*y))).collect();
            let thin = thin_points(&points, columns);
            prop_assert!(thin.len() <= points.len() && (points.len() <= 4 * columns as usize || thin.len() <= 4 * columns as usize));
            prop_assert!(thin.iter().all(|point| points.contains(point)));
            for column in 0..columns {
                let place = |x: f64| (x * f64::from(columns)).floor();
                let inside = |(x, _): &&(f64, f64)| (place(*x) - f64::from(column)).abs() < 0.5;
                let of = |points: &[(f64, f64)]| ends(&points.iter().filter(inside).copied().collect::<Vec<_>>());
                prop_assert_eq!(of(&points), of(&thin));
            }
        }

        #[test]
        fn a_stream_keeps_its_ends_and_stays_small(ys in proptest::collection::vec(-100..100_i32, 1..4_000), most in 2_usize..60) {
            let mut line = ThinnedLine::new(most, 0.5);
            let mut all = Vec::new();
            for (n, y) in ys.iter().enumerate() {
                let point = (n as f64 * 0.3, f64::from(*y));
                line.push(point.0, point.1);
                all.push(point);
            }
            let points = line.points();
            prop_assert!(points.len() <= 4 * most);
            prop_assert_eq!(ends(&points), ends(&all));
            prop_assert_eq!((points.first(), points.last()), (all.first(), all.last()));
            prop_assert!(points.iter().all(|point| all.contains(point)));
        }
    }
}
