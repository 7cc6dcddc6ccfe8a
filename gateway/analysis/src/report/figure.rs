//! The contents of a page before it is drawn: sections with figures, findings and tables.

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
    /// Its subject, in one or two sentences.
    pub intro: String,
    /// Facts by name: machine, command, revision.
    pub facts: Vec<(String, String)>,
    /// Its sections, in order.
    pub sections: Vec<Section>,
}

/// One section of a page.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Section {
    /// The link to it, of letters, digits and `-`; the prefix of its files' names: `fig6`.
    pub name: String,
    /// Its heading.
    pub title: String,
    /// Paragraphs before the figures.
    pub text: Vec<String>,
    /// Drawings of cells, shown before the figures.
    pub drawings: Vec<Drawing>,
    /// Its figures.
    pub figures: Vec<Figure>,
    /// Numbers compared with the paper's.
    pub findings: Vec<Finding>,
    /// Tables with everything else.
    pub tables: Vec<Table>,
}

impl Section {
    /// Creates an empty section.
    #[must_use]
    pub fn new(name: &str, title: impl Into<String>) -> Self {
        Self { name: name.to_owned(), title: title.into(), ..Self::default() }
    }

    /// Adds a paragraph.
    #[must_use]
    pub fn text(mut self, paragraph: impl Into<String>) -> Self {
        self.text.push(paragraph.into());
        self
    }

    /// Adds drawings of cells.
    #[must_use]
    pub fn drawings(mut self, drawings: impl IntoIterator<Item = Drawing>) -> Self {
        self.drawings.extend(drawings);
        self
    }

    /// Adds figures.
    #[must_use]
    pub fn figures(mut self, figures: impl IntoIterator<Item = Figure>) -> Self {
        self.figures.extend(figures);
        self
    }

    /// Adds findings.
    #[must_use]
    pub fn findings(mut self, findings: impl IntoIterator<Item = Finding>) -> Self {
        self.findings.extend(findings);
        self
    }

    /// Adds tables.
    #[must_use]
    pub fn tables(mut self, tables: impl IntoIterator<Item = Table>) -> Self {
        self.tables.extend(tables);
        self
    }
}

/// One diagram.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Figure {
    /// A unique name in the page, of letters, digits and `-`; also that of its file: `fig6-joint2`.
    pub name: String,
    /// Its caption.
    pub title: String,
    /// Its width on the page.
    pub size: Size,
    /// The horizontal axis.
    pub x: Axis,
    /// The vertical axis.
    pub y: Axis,
    /// The series, in drawing order. Their colours follow the order and repeat after [`Figure::COLOURS`].
    pub series: Vec<Series>,
    /// Marked positions.
    pub marks: Vec<Mark>,
    /// A second diagram below it, with the same horizontal axis.
    pub below: Option<LowerDiagram>,
}

/// A lower diagram, for series with a scale of their own.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LowerDiagram {
    /// The vertical axis.
    pub y: Axis,
    /// The series, as in a [`Figure`].
    pub series: Vec<Series>,
    /// Marked positions.
    pub marks: Vec<Mark>,
}

impl Figure {
    /// Number of distinguishable colours; further series start again with the first.
    pub const COLOURS: usize = 7;

    /// Creates an empty figure of full width.
    #[must_use]
    pub fn new(name: impl Into<String>, title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self { name: name.into(), title: title.into(), x, y, ..Self::default() }
    }

    /// Sets half the width.
    #[must_use]
    pub const fn half(mut self) -> Self {
        self.size = Size::Half;
        self
    }

    /// Adds one series; see [`Series`].
    #[must_use]
    pub fn draw(mut self, caption: impl Into<String>, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        self.series.push(Series::new(caption, shape, points));
        self
    }

    /// Adds series.
    #[must_use]
    pub fn series(mut self, series: impl IntoIterator<Item = Series>) -> Self {
        self.series.extend(series);
        self
    }

    /// Adds marks.
    #[must_use]
    pub fn marks(mut self, marks: impl IntoIterator<Item = Mark>) -> Self {
        self.marks.extend(marks);
        self
    }

    /// Adds a diagram below.
    #[must_use]
    pub fn below(mut self, below: LowerDiagram) -> Self {
        self.below = Some(below);
        self
    }
}

/// The width of a figure on a page.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Size {
    /// The full width.
    #[default]
    Wide,
    /// Half the width: two figures stand side by side if there is room.
    Half,
}

/// One axis of a diagram.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Axis {
    /// Name of the quantity.
    pub caption: String,
    /// Unit of the quantity; empty for counts.
    pub unit: String,
    /// The mapping from values to positions.
    pub scale: Scale,
    /// The ends; by default those of the data plus a margin. On a logarithmic axis both must be above 0.
    pub range: Option<(f64, f64)>,
}

impl Axis {
    /// Creates a linear axis that fits the data.
    #[must_use]
    pub fn new(caption: impl Into<String>, unit: impl Into<String>) -> Self {
        Self { caption: caption.into(), unit: unit.into(), scale: Scale::Linear, range: None }
    }

    /// Sets the ends.
    #[must_use]
    pub const fn between(mut self, from: f64, to: f64) -> Self {
        self.range = Some((from, to));
        self
    }

    /// Makes the axis logarithmic.
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

/// The mapping from values to positions.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Scale {
    /// Linear.
    #[default]
    Linear,
    /// Logarithmic; values that are not above 0 are not drawn.
    Log,
}

/// One series of a diagram.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Series {
    /// The name in the legend; empty to omit it there.
    pub caption: String,
    /// The way of drawing.
    pub shape: Shape,
    /// x and y, by increasing x for all shapes except points. Values that are not finite make a gap.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// Creates a series.
    #[must_use]
    pub fn new(caption: impl Into<String>, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        Self { caption: caption.into(), shape, points }
    }
}

/// The way of drawing a series.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum Shape {
    /// Straight lines between the points.
    #[default]
    Line,
    /// Dashed lines, for a law, a limit, or the paper's data.
    Dashed,
    /// Dots.
    Points,
    /// Steps: each value holds until the next one.
    Steps,
    /// An area. The points go along the lower edge to the right and back along the upper edge.
    Band,
}

/// A line across a whole diagram.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Mark {
    /// The axis of `at`.
    pub on: MarkAxis,
    /// The position.
    pub at: f64,
    /// The text.
    pub caption: String,
}

impl Mark {
    /// Creates a vertical line.
    #[must_use]
    pub fn x(at: f64, caption: impl Into<String>) -> Self {
        Self { on: MarkAxis::X, at, caption: caption.into() }
    }

    /// Creates a horizontal line.
    #[must_use]
    pub fn y(at: f64, caption: impl Into<String>) -> Self {
        Self { on: MarkAxis::Y, at, caption: caption.into() }
    }
}

/// An axis.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub enum MarkAxis {
    /// The horizontal axis: the line is vertical.
    X,
    /// The vertical axis: the line is horizontal.
    Y,
}

/// Rows below headings.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Table {
    /// The title.
    pub title: String,
    /// The columns' headings.
    pub head: Vec<String>,
    /// The rows, each with as many cells as there are headings. Columns of numbers are right-aligned.
    pub rows: Vec<Vec<String>>,
    /// True if the last column holds commands.
    pub commands: bool,
}

impl Table {
    /// Marks the last column as commands.
    #[must_use]
    pub const fn of_commands(mut self) -> Self {
        self.commands = true;
        self
    }

    /// Creates a table with these columns.
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
