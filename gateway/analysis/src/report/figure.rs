//! What a page says, before anybody draws it: sections with figures, findings beside the paper's, and tables.

use std::fmt;

use serde::Serialize;

/// A whole page.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Page {
    /// Its heading, in one line.
    pub title: String,
    /// What it is about, in a sentence or two.
    pub intro: String,
    /// Name and value of what it came about with: machine, command, revision.
    pub facts: Vec<(String, String)>,
    /// What it says, one after the other.
    pub sections: Vec<Section>,
}

/// One thing that a page says.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Section {
    /// Letters, digits and `-`; the link to it, and what names of its files begin with: `fig6`.
    pub name: String,
    /// Its heading.
    pub title: String,
    /// Paragraphs before the figures.
    pub text: Vec<String>,
    /// What is drawn.
    pub figures: Vec<Figure>,
    /// Numbers beside the paper's.
    pub findings: Vec<Finding>,
    /// Everything else in rows.
    pub tables: Vec<Table>,
}

impl Section {
    /// A section that says nothing yet.
    #[must_use]
    pub fn new(name: &str, title: impl Into<String>) -> Self {
        Self { name: name.to_owned(), title: title.into(), ..Self::default() }
    }

    /// The same with one more paragraph.
    #[must_use]
    pub fn text(mut self, paragraph: impl Into<String>) -> Self {
        self.text.push(paragraph.into());
        self
    }

    /// The same with more figures.
    #[must_use]
    pub fn figures(mut self, figures: impl IntoIterator<Item = Figure>) -> Self {
        self.figures.extend(figures);
        self
    }

    /// The same with more findings.
    #[must_use]
    pub fn findings(mut self, findings: impl IntoIterator<Item = Finding>) -> Self {
        self.findings.extend(findings);
        self
    }

    /// The same with more tables.
    #[must_use]
    pub fn tables(mut self, tables: impl IntoIterator<Item = Table>) -> Self {
        self.tables.extend(tables);
        self
    }
}

/// One diagram.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Figure {
    /// Letters, digits and `-`, unlike any other in the page; its file is called so: `fig6-joint2`.
    pub name: String,
    /// Its caption.
    pub title: String,
    /// How much of the page it takes.
    pub size: Size,
    /// To the right.
    pub x: Axis,
    /// Upwards.
    pub y: Axis,
    /// What is drawn, the first one lowest. Colours go by place, and there are [`Figure::COLOURS`].
    pub series: Vec<Series>,
    /// Places to look at.
    pub marks: Vec<Mark>,
}

impl Figure {
    /// Colours that can be told apart; series beyond these begin with the first again.
    pub const COLOURS: usize = 7;

    /// A figure of the page's width in which nothing is drawn yet.
    #[must_use]
    pub fn new(name: impl Into<String>, title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self { name: name.into(), title: title.into(), x, y, ..Self::default() }
    }

    /// The same of half the width.
    #[must_use]
    pub const fn half(mut self) -> Self {
        self.size = Size::Half;
        self
    }

    /// The same with one more series; see [`Series`].
    #[must_use]
    pub fn draw(mut self, label: impl Into<String>, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        self.series.push(Series::new(label, shape, points));
        self
    }

    /// The same with more series.
    #[must_use]
    pub fn series(mut self, series: impl IntoIterator<Item = Series>) -> Self {
        self.series.extend(series);
        self
    }

    /// The same with more marks.
    #[must_use]
    pub fn marks(mut self, marks: impl IntoIterator<Item = Mark>) -> Self {
        self.marks.extend(marks);
        self
    }
}

/// How much of a page a figure takes.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Size {
    /// The page's width.
    #[default]
    Wide,
    /// Half of it: two stand beside each other where there is room.
    Half,
}

/// One direction of a diagram.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Axis {
    /// What it counts.
    pub label: String,
    /// In what; empty for numbers of things.
    pub unit: String,
    /// How values become places.
    pub scale: Scale,
    /// From and to; without it, all that is drawn and a little more. On a logarithmic axis above 0.
    pub range: Option<(f64, f64)>,
}

impl Axis {
    /// A linear axis that fits what is drawn.
    #[must_use]
    pub fn new(label: impl Into<String>, unit: impl Into<String>) -> Self {
        Self { label: label.into(), unit: unit.into(), scale: Scale::Linear, range: None }
    }

    /// The same, from `from` to `to`.
    #[must_use]
    pub const fn between(mut self, from: f64, to: f64) -> Self {
        self.range = Some((from, to));
        self
    }

    /// The same, by powers of ten.
    #[must_use]
    pub const fn log(mut self) -> Self {
        self.scale = Scale::Log;
        self
    }
}

impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.label.as_str(), self.unit.as_str()) {
            (label, "") => f.write_str(label),
            ("", unit) => f.write_str(unit),
            (label, unit) => write!(f, "{label} ({unit})"),
        }
    }
}

/// How values become places.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Scale {
    /// Equal steps.
    #[default]
    Linear,
    /// Equal ratios; what is not above 0 is not drawn.
    Log,
}

/// What belongs together in a diagram.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Series {
    /// What it is, for the legend; empty: it is not in the legend.
    pub label: String,
    /// How it is drawn.
    pub shape: Shape,
    /// x and y, by increasing x for all shapes but points. What is not finite is a gap.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// A series of a shape.
    #[must_use]
    pub fn new(label: impl Into<String>, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        Self { label: label.into(), shape, points }
    }
}

/// How a series is drawn.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Shape {
    /// Straight from point to point.
    #[default]
    Line,
    /// The same, dashed: a law, a limit, the paper's line.
    Dashed,
    /// Dots.
    Points,
    /// Each value holds until the next one.
    Steps,
    /// An area: along the points there and back, as `lower` to the right and `upper` to the left.
    Band,
}

/// A line through a whole diagram.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Mark {
    /// Which axis `at` is on.
    pub on: On,
    /// Where.
    pub at: f64,
    /// What is there.
    pub label: String,
}

impl Mark {
    /// An upright line.
    #[must_use]
    pub fn x(at: f64, label: impl Into<String>) -> Self {
        Self { on: On::X, at, label: label.into() }
    }

    /// A level line.
    #[must_use]
    pub fn y(at: f64, label: impl Into<String>) -> Self {
        Self { on: On::Y, at, label: label.into() }
    }
}

/// An axis.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub enum On {
    /// The one to the right: the mark stands upright.
    X,
    /// The one upwards: the mark lies.
    Y,
}

/// A number that was found, beside what the paper says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// What was measured, with how.
    pub what: String,
    /// What the paper says, where it does.
    pub paper: Option<Quantity>,
    /// What was found.
    pub ours: Quantity,
    /// What it must reach, in words: `at most 0.005 Nm`.
    pub bar: Option<String>,
    /// How the two compare.
    pub verdict: Verdict,
}

impl Finding {
    /// A number of which less is better: within 5 % of the paper's it is the same.
    #[must_use]
    pub fn less_is_better(
        what: impl Into<String>,
        paper: impl Into<Quantity>,
        ours: impl Into<Quantity>,
    ) -> Self {
        let (paper, ours) = (paper.into(), ours.into());
        let verdict = Verdict::less_is_better(paper.value, ours.value);
        Self { verdict, ..Self::told(what, ours).beside(paper) }
    }

    /// A number of which more is better: within 5 % of the paper's it is the same.
    #[must_use]
    pub fn more_is_better(
        what: impl Into<String>,
        paper: impl Into<Quantity>,
        ours: impl Into<Quantity>,
    ) -> Self {
        let (paper, ours) = (paper.into(), ours.into());
        let verdict = Verdict::less_is_better(ours.value, paper.value);
        Self { verdict, ..Self::told(what, ours).beside(paper) }
    }

    /// A number that is told and not judged.
    #[must_use]
    pub fn told(what: impl Into<String>, ours: impl Into<Quantity>) -> Self {
        Self { what: what.into(), paper: None, ours: ours.into(), bar: None, verdict: Verdict::Told }
    }

    /// The same, told beside the paper's: of what is no better for being more or less.
    #[must_use]
    pub fn beside(mut self, paper: impl Into<Quantity>) -> Self {
        self.paper = Some(paper.into());
        self
    }

    /// The same, judged by a limit in its own unit.
    #[must_use]
    pub fn at_most(self, limit: f64) -> Self {
        let unit = if self.ours.unit.is_empty() { String::new() } else { format!(" {}", self.ours.unit) };
        let kept = self.ours.value <= limit;
        self.must(format!("at most {limit}{unit}"), kept)
    }

    /// The same, judged by whether it holds what it must: kept or better is [`Verdict::Better`].
    #[must_use]
    pub fn must(mut self, bar: impl Into<String>, kept: bool) -> Self {
        self.bar = Some(bar.into());
        self.verdict = if kept { Verdict::Better } else { Verdict::Worse };
        self
    }
}

/// How a number compares with the paper's, or with what it must reach.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Verdict {
    /// Better than the paper's, or within the bar.
    Better,
    /// The paper's, by 5 %.
    Same,
    /// Worse than the paper's, or outside of the bar.
    Worse,
    /// Not judged.
    #[default]
    Told,
}

impl Verdict {
    /// Compares numbers of which less is better: within 5 % of `paper` they are the same.
    #[must_use]
    pub fn less_is_better(paper: f64, ours: f64) -> Self {
        if !(paper.is_finite() && ours.is_finite()) {
            Self::Told
        } else if (ours - paper).abs() <= 0.05 * paper.abs() {
            Self::Same
        } else if ours < paper {
            Self::Better
        } else {
            Self::Worse
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Better => "better",
            Self::Same => "the same",
            Self::Worse => "worse",
            Self::Told => "",
        })
    }
}

/// A number with its unit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Quantity {
    /// How much.
    pub value: f64,
    /// Of what; empty for numbers of things.
    pub unit: String,
    /// Half the width of its 95 % interval, where it has one.
    pub plus_minus: Option<f64>,
}

impl Quantity {
    /// A number with its unit.
    #[must_use]
    pub fn new(value: f64, unit: impl Into<String>) -> Self {
        Self { value, unit: unit.into(), plus_minus: None }
    }

    /// The same, with half the width of its 95 % interval.
    #[must_use]
    pub const fn plus_minus(mut self, half: f64) -> Self {
        self.plus_minus = Some(half);
        self
    }
}

impl<T: Into<String>> From<(f64, T)> for Quantity {
    fn from((value, unit): (f64, T)) -> Self {
        Self::new(value, unit)
    }
}

impl From<f64> for Quantity {
    /// A number of things.
    fn from(value: f64) -> Self {
        Self::new(value, "")
    }
}

impl fmt::Display for Quantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&number(self.value))?;
        if let Some(half) = self.plus_minus {
            write!(f, " ± {}", number(half))?;
        }
        if self.unit.is_empty() { Ok(()) } else { write!(f, "\u{a0}{}", self.unit) }
    }
}

/// Rows below headings.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Table {
    /// What is in it.
    pub title: String,
    /// The columns' headings.
    pub head: Vec<String>,
    /// As many cells in each row as there are headings. What reads as a number stands to the right.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// A table of some columns.
    #[must_use]
    pub fn new<const N: usize>(
        title: impl Into<String>,
        head: [&str; N],
        rows: impl IntoIterator<Item: Into<Vec<String>>>,
    ) -> Self {
        let rows = rows.into_iter().map(Into::into).collect();
        Self { title: title.into(), head: head.map(str::to_owned).into(), rows }
    }
}

/// A number for people: whole ones below a million as they are, else at most three significant digits; very
/// small and very large ones by a power of ten; what is not finite is a dash.
///
/// ```
/// # use analysis::report::figure::number;
/// assert_eq!(number(24_364.0), "24364");
/// assert_eq!(number(0.005_4), "0.0054");
/// assert_eq!(number(6.25e-5), "6.25e-5");
/// assert_eq!(number(1_919.4), "1919");
/// ```
#[must_use]
pub fn number(value: f64) -> String {
    let size = value.abs();
    if !value.is_finite() {
        return "–".to_owned();
    }
    if size < 1e6 && (value - value.round()).abs() < 1e-12 * size.max(1e-300) || size == 0.0 {
        return format!("{:.0}", value + 0.0);
    }
    if !(1e-4..1e6).contains(&size) {
        let text = format!("{value:.2e}");
        let Some((digits, exponent)) = text.split_once('e') else { return text };
        return format!("{}e{exponent}", digits.trim_end_matches('0').trim_end_matches('.'));
    }
    let digits = [(100.0, 0), (10.0, 1), (1.0, 2), (0.1, 3), (0.01, 4), (0.001, 5)];
    let digits = digits.iter().find(|(from, _)| size >= *from).map_or(6, |(_, digits)| *digits);
    let text = format!("{value:.digits$}");
    if digits == 0 { text } else { text.trim_end_matches('0').trim_end_matches('.').to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn verdicts_know_which_way_is_better_and_what_is_the_same() {
        let quantity = |value| Quantity::new(value, "Nm");
        let less = |ours| Finding::less_is_better("", quantity(2.0), quantity(ours)).verdict;
        let more = |ours| Finding::more_is_better("", quantity(2.0), quantity(ours)).verdict;
        assert_eq!(
            [1.0, 1.91, 2.09, 2.2].map(less),
            [Verdict::Better, Verdict::Same, Verdict::Same, Verdict::Worse]
        );
        assert_eq!(
            [1.0, 1.95, 2.05, 3.0].map(more),
            [Verdict::Worse, Verdict::Same, Verdict::Same, Verdict::Better]
        );
        assert_eq!(less(f64::NAN), Verdict::Told);
        assert_eq!(Finding::told("", quantity(0.0)).must("none", true).verdict, Verdict::Better);
    }

    #[test]
    fn numbers_have_three_digits_and_no_more_zeros_than_they_need() {
        for (value, text) in [
            (0.0, "0"),
            (-0.0, "0"),
            (1.0, "1"),
            (999_999.0, "999999"),
            (2.5e7, "2.5e7"),
            (0.012_345, "0.0123"),
            (0.1, "0.1"),
            (-12.349, "-12.3"),
            (1.5e-7, "1.5e-7"),
            (5e-5, "5e-5"),
            (f64::NAN, "–"),
        ] {
            assert_eq!(number(value), text);
        }
    }
}
