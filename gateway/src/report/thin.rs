//! Many points in a picture of few columns: what a column shows is its first, least, greatest and last point, and
//! so these four are kept. A line through them covers the same pixels as a line through all (Jugel, Jerzak,
//! Hackenbroich and Markl, *M4: A Visualization-Oriented Time Series Data Aggregation*, 2014).

/// A column's first, least, greatest and last point.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Column {
    first: (f64, f64),
    least: (f64, f64),
    greatest: (f64, f64),
    last: (f64, f64),
}

impl Column {
    const fn new(point: (f64, f64)) -> Self {
        Self { first: point, least: point, greatest: point, last: point }
    }

    fn join(&mut self, later: &Self) {
        if later.least.1 < self.least.1 {
            self.least = later.least;
        }
        if later.greatest.1 > self.greatest.1 {
            self.greatest = later.greatest;
        }
        self.last = later.last;
    }

    /// The points that are different, in their order.
    fn points(&self) -> impl Iterator<Item = (f64, f64)> + use<> {
        let (a, b) = if self.least.0 <= self.greatest.0 {
            (self.least, self.greatest)
        } else {
            (self.greatest, self.least)
        };
        let mut before = None;
        [self.first, a, b, self.last].into_iter().filter(move |point| before.replace(*point) != Some(*point))
    }
}

/// A line of any length in bounded memory: points come by increasing x, and when there are too many columns, each
/// two become one.
#[derive(Clone, Debug)]
pub struct Thinned {
    most: usize,
    /// A column's width; it doubles.
    width: f64,
    /// Where the first column begins.
    from: Option<f64>,
    columns: Vec<(u64, Column)>,
    /// Points that were pushed, gaps not among them.
    count: u64,
    /// Where the line has a gap: before the column at this place in `columns`.
    gap: bool,
    gaps: Vec<u64>,
}

impl Thinned {
    /// Nothing yet: at most `most` columns (at least 2), each of which is at least `width` wide.
    #[must_use]
    pub fn new(most: usize, width: f64) -> Self {
        Self {
            most: most.max(2),
            width,
            from: None,
            columns: Vec::new(),
            count: 0,
            gap: false,
            gaps: Vec::new(),
        }
    }

    /// How many points have come.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// Takes the next point. What is not a number is a gap of the line; what lies before the first point is left out.
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
        let mut at = self.column(x - from);
        while self.columns.len() >= self.most && self.columns.last().is_some_and(|(last, _)| *last != at)
            || self.columns.first().is_some_and(|(first, _)| at - first >= 2 * self.most as u64)
        {
            self.merge();
            at = self.column(x - from);
        }
        if std::mem::take(&mut self.gap) && self.gaps.last() != Some(&at) {
            self.gaps.push(at);
        }
        let new = Column::new((x, y));
        match self.columns.last_mut() {
            // Points that come a little late belong to the newest column all the same.
            Some((last, column)) if *last >= at => column.join(&new),
            _ => self.columns.push((at, new)),
        }
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "not negative; far ones saturate, and merge"
    )]
    fn column(&self, distance: f64) -> u64 {
        (distance / self.width) as u64
    }

    /// Each two columns become one.
    fn merge(&mut self) {
        self.width *= 2.0;
        let mut merged: Vec<(u64, Column)> = Vec::with_capacity(self.columns.len());
        for (at, column) in &self.columns {
            match merged.last_mut() {
                Some((last, joined)) if *last == at / 2 => joined.join(column),
                _ => merged.push((at / 2, *column)),
            }
        }
        self.columns = merged;
        self.gaps = self.gaps.iter().map(|at| at / 2).collect();
        self.gaps.dedup();
    }

    /// What is left: at most four points a column, by increasing x, and points that are not numbers where it has gaps.
    #[must_use]
    pub fn points(&self) -> Vec<(f64, f64)> {
        let mut gaps = self.gaps.iter().peekable();
        let mut points = Vec::with_capacity(self.columns.len() * 4);
        for (at, column) in &self.columns {
            if gaps.next_if(|gap| *gap <= at).is_some() {
                points.push((column.first.0, f64::NAN));
            }
            points.extend(column.points());
        }
        points
    }
}

/// The same for points that are there: at most four for each of `columns` equal parts of 0 to 1 in x.
#[must_use]
pub fn thinned(points: &[(f64, f64)], columns: u32) -> Vec<(f64, f64)> {
    if points.len() <= 4 * columns as usize {
        return points.to_vec();
    }
    let place = |x: f64| (x * f64::from(columns)).floor();
    points
        .chunk_by(|a, b| (place(a.0) - place(b.0)).abs() < 0.5)
        .flat_map(|points| {
            let mut all = points.iter().map(|point| Column::new(*point));
            let column = all.next().map(|first| {
                all.fold(first, |mut sum, next| {
                    sum.join(&next);
                    sum
                })
            });
            column.into_iter().flat_map(|column| column.points())
        })
        .collect()
}

/// Sums over equal times in bounded memory: how much came in each; when there are too many, each two become one.
#[derive(Clone, Debug)]
pub struct Binned {
    most: usize,
    width: f64,
    from: Option<f64>,
    bins: Vec<f64>,
}

impl Binned {
    /// Nothing yet: at most `most` bins (at least 2), `width` wide at first.
    #[must_use]
    pub fn new(most: usize, width: f64) -> Self {
        Self { most: most.max(2), width, from: None, bins: Vec::new() }
    }

    /// Adds `amount` at `x`; what lies before the first belongs to its bin.
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

    /// How wide bins are now.
    #[must_use]
    pub const fn width(&self) -> f64 {
        self.width
    }

    /// Each bin's beginning and its sum by its width; the last one, which may not be full, is left out, unless it is the only one.
    #[must_use]
    pub fn rates(&self) -> Vec<(f64, f64)> {
        let from = self.from.unwrap_or(0.0);
        let whole = self.bins.len().saturating_sub(1).max(1);
        let bins = self.bins.iter().take(whole).enumerate();
        bins.map(|(at, sum)| (from + at as f64 * self.width, sum / self.width)).collect()
    }
}
