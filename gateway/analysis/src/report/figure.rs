//! The contents of a page before it is drawn: sections with figures, findings beside the paper's, and tables.

use std::fmt;

use serde::Serialize;

pub use super::finding::{Finding, Quantity, Verdict};
pub use super::number::{number, quantity};
pub use super::skin::{Drawing, Legend, Map, Panel, Spot, Strip, StripGroup, StripRow};

/// A whole page.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Page {
    /// Its heading, in one line.
    pub title: String,
    /// What it is about, in a sentence or two.
    pub intro: String,
    /// Facts by name: machine, command, revision.
    pub facts: Vec<(String, String)>,
    /// Its sections, in order.
    pub sections: Vec<Section>,
}

/// One section of a page.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Section {
    /// Letters, digits and `-`; the link to it, and what names of its files begin with: `fig6`.
    pub name: String,
    /// Its heading.
    pub title: String,
    /// Paragraphs before the figures.
    pub text: Vec<String>,
    /// What is drawn of cells, before the figures.
    pub drawings: Vec<Drawing>,
    /// What is drawn.
    pub figures: Vec<Figure>,
    /// Numbers beside the paper's.
    pub findings: Vec<Finding>,
    /// Everything else in rows.
    pub tables: Vec<Table>,
}

impl Section {
    /// An empty section.
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

    /// The same with more drawings of cells.
    #[must_use]
    pub fn drawings(mut self, drawings: impl IntoIterator<Item = Drawing>) -> Self {
        self.drawings.extend(drawings);
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
    /// A second diagram below it, with the same axis to the right.
    pub below: Option<Below>,
}

/// A lower diagram: what belongs to the upper one on a scale of its own.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Below {
    /// Upwards.
    pub y: Axis,
    /// What is drawn, as in a [`Figure`].
    pub series: Vec<Series>,
    /// Places to look at.
    pub marks: Vec<Mark>,
}

impl Figure {
    /// Distinguishable colours; series beyond these begin with the first again.
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
    pub fn draw(mut self, caption: impl Into<String>, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        self.series.push(Series::new(caption, shape, points));
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

    /// The same with a diagram below it.
    #[must_use]
    pub fn below(mut self, below: Below) -> Self {
        self.below = Some(below);
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
    pub caption: String,
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
    pub fn new(caption: impl Into<String>, unit: impl Into<String>) -> Self {
        Self { caption: caption.into(), unit: unit.into(), scale: Scale::Linear, range: None }
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
        match (self.caption.as_str(), self.unit.as_str()) {
            (caption, "") => f.write_str(caption),
            ("", unit) => f.write_str(unit),
            (caption, unit) => write!(f, "{caption} ({unit})"),
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
    pub caption: String,
    /// How it is drawn.
    pub shape: Shape,
    /// x and y, by increasing x for all shapes but points. What is not finite is a gap.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// A series of a shape.
    #[must_use]
    pub fn new(caption: impl Into<String>, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        Self { caption: caption.into(), shape, points }
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
    pub caption: String,
}

impl Mark {
    /// An upright line.
    #[must_use]
    pub fn x(at: f64, caption: impl Into<String>) -> Self {
        Self { on: On::X, at, caption: caption.into() }
    }

    /// A level line.
    #[must_use]
    pub fn y(at: f64, caption: impl Into<String>) -> Self {
        Self { on: On::Y, at, caption: caption.into() }
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

/// Rows below headings.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Table {
    /// What is in it.
    pub title: String,
    /// The columns' headings.
    pub head: Vec<String>,
    /// As many cells in each row as there are headings. What reads as a number stands to the right.
    pub rows: Vec<Vec<String>>,
    /// Whether the last column holds commands.
    pub commands: bool,
}

impl Table {
    /// The same, with commands in the last column.
    #[must_use]
    pub const fn of_commands(mut self) -> Self {
        self.commands = true;
        self
    }

    /// A table of some columns.
    #[must_use]
    pub fn new<const N: usize>(
        title: impl Into<String>,
        head: [&str; N],
        rows: impl IntoIterator<Item: Into<Vec<String>>>,
    ) -> Self {
        let rows = rows.into_iter().map(Into::into).collect();
        Self { title: title.into(), head: head.map(str::to_owned).into(), rows, commands: false }
    }
}
