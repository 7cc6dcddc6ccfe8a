//! The contents of a page before it is drawn: sections with figures, findings and tables.

use std::fmt;

use serde::Serialize;

pub use super::finding::{Finding, FindingVerdict, Quantity};
pub(crate) use super::number::with_minus_signs;
pub use super::number::{format_number, format_quantity};
pub use super::skin::{CellMap, CellStrip, ColourLegend, Drawing, LinkPanel, MapCell, StripGroup, StripRow};

/// The contents of an HTML page: a title, facts, and sections with figures and tables.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Page {
    /// Heading of the page, in one line.
    pub title: String,
    /// Subject of the page, in one or two sentences.
    pub intro: String,
    /// Facts with their names, such as machine, command and revision.
    pub facts: Vec<(String, String)>,
    /// Sections of the page, in order.
    pub sections: Vec<Section>,
}

/// One section of a page, with text, figures, findings and tables.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Section {
    /// Name of the section, of letters, digits and `-`, such as `fig6`: the anchor of links to it, and the prefix of
    /// its figures' file names.
    pub name: String,
    /// Heading of the section.
    pub title: String,
    /// Paragraphs before the figures.
    pub text: Vec<String>,
    /// Drawings of cells, shown before the figures.
    pub drawings: Vec<Drawing>,
    /// Figures of the section.
    pub figures: Vec<Figure>,
    /// Measured numbers, compared with the paper's.
    pub findings: Vec<Finding>,
    /// Tables of the section, shown last.
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
    pub fn with_paragraph(mut self, paragraph: impl Into<String>) -> Self {
        self.text.push(paragraph.into());
        self
    }

    /// Adds drawings of cells.
    #[must_use]
    pub fn with_drawings(mut self, drawings: impl IntoIterator<Item = Drawing>) -> Self {
        self.drawings.extend(drawings);
        self
    }

    /// Adds figures.
    #[must_use]
    pub fn with_figures(mut self, figures: impl IntoIterator<Item = Figure>) -> Self {
        self.figures.extend(figures);
        self
    }

    /// Adds findings.
    #[must_use]
    pub fn with_findings(mut self, findings: impl IntoIterator<Item = Finding>) -> Self {
        self.findings.extend(findings);
        self
    }

    /// Adds tables.
    #[must_use]
    pub fn with_tables(mut self, tables: impl IntoIterator<Item = Table>) -> Self {
        self.tables.extend(tables);
        self
    }
}

/// A diagram with axes and series, and optionally a second one below.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Figure {
    /// Name of the figure, unique on the page, of letters, digits and `-`, such as `fig6-joint2`; also the name of its
    /// file.
    pub name: String,
    /// Caption of the figure.
    pub title: String,
    /// Width of the figure on the page.
    pub size: FigureWidth,
    /// The horizontal axis.
    pub x: Axis,
    /// The vertical axis.
    pub y: Axis,
    /// The series in drawing order. Their colours follow this order, and repeat after [`Figure::COLOUR_COUNT`].
    pub series: Vec<Series>,
    /// Lines across the diagram at given positions, such as limits.
    pub marks: Vec<MarkLine>,
    /// A second diagram below this one, with the same horizontal axis.
    pub below: Option<LowerDiagram>,
}

/// The lower diagram of a figure, for series with a vertical scale of their own.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LowerDiagram {
    /// The vertical axis of the lower diagram.
    pub y: Axis,
    /// The series, as in a [`Figure`].
    pub series: Vec<Series>,
    /// Lines across the lower diagram at given positions.
    pub marks: Vec<MarkLine>,
}

impl Figure {
    /// Number of distinguishable colours; further series repeat them from the first.
    pub const COLOUR_COUNT: usize = 7;

    /// Creates an empty figure of full width.
    #[must_use]
    pub fn new(name: impl Into<String>, title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self { name: name.into(), title: title.into(), x, y, ..Self::default() }
    }

    /// Makes the figure half as wide as the page.
    #[must_use]
    pub const fn with_half_width(mut self) -> Self {
        self.size = FigureWidth::Half;
        self
    }

    /// Adds one series; see [`Series`].
    #[must_use]
    pub fn draw_series(
        mut self,
        caption: impl Into<String>,
        shape: SeriesShape,
        points: Vec<(f64, f64)>,
    ) -> Self {
        self.series.push(Series::new(caption, shape, points));
        self
    }

    /// Adds series.
    #[must_use]
    pub fn with_series(mut self, series: impl IntoIterator<Item = Series>) -> Self {
        self.series.extend(series);
        self
    }

    /// Adds lines across the diagram.
    #[must_use]
    pub fn with_marks(mut self, marks: impl IntoIterator<Item = MarkLine>) -> Self {
        self.marks.extend(marks);
        self
    }

    /// Returns the title and all axes with their units, for readers who do not see the figure.
    #[must_use]
    pub fn description(&self) -> String {
        let below = self.below.as_ref().map_or_else(String::new, |below| format!("; below: {}", below.y));
        format!("{}. Vertical: {}{below}. Horizontal: {}.", self.title, self.y, self.x)
    }

    /// Adds a second diagram below this one.
    #[must_use]
    pub fn with_lower_diagram(mut self, below: LowerDiagram) -> Self {
        self.below = Some(below);
        self
    }
}

/// The width of a figure on a page.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum FigureWidth {
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
    /// Linear or logarithmic mapping of values to positions.
    pub scale: Scale,
    /// The first and the last value of the axis; by default those of the data plus a margin. On a logarithmic axis both
    /// must be above 0.
    pub range: Option<(f64, f64)>,
}

impl Axis {
    /// Creates a linear axis that fits the data.
    #[must_use]
    pub fn new(caption: impl Into<String>, unit: impl Into<String>) -> Self {
        Self { caption: caption.into(), unit: unit.into(), scale: Scale::Linear, range: None }
    }

    /// Sets the first and the last value of the axis.
    #[must_use]
    pub const fn with_ends(mut self, from: f64, to: f64) -> Self {
        self.range = Some((from, to));
        self
    }

    /// Makes the axis logarithmic.
    #[must_use]
    pub const fn with_log_scale(mut self) -> Self {
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

/// The mapping from values to positions along an axis.
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
    /// Name of the series in the legend; empty to omit it there.
    pub caption: String,
    /// Form in which the series is drawn.
    pub shape: SeriesShape,
    /// The points x and y. For all shapes except points and bands, x increases. Values that are not finite make a gap.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// Creates a series.
    #[must_use]
    pub fn new(caption: impl Into<String>, shape: SeriesShape, points: Vec<(f64, f64)>) -> Self {
        Self { caption: caption.into(), shape, points }
    }
}

/// The form in which a series is drawn.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub enum SeriesShape {
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
pub struct MarkLine {
    /// The axis on which the line has its position.
    pub on: MarkAxis,
    /// The position of the line on that axis.
    pub at: f64,
    /// The text beside the line.
    pub caption: String,
}

impl MarkLine {
    /// Creates a vertical line at a position on the horizontal axis.
    #[must_use]
    pub fn at_x(at: f64, caption: impl Into<String>) -> Self {
        Self { on: MarkAxis::X, at, caption: caption.into() }
    }

    /// Creates a horizontal line at a position on the vertical axis.
    #[must_use]
    pub fn at_y(at: f64, caption: impl Into<String>) -> Self {
        Self { on: MarkAxis::Y, at, caption: caption.into() }
    }
}

/// The axis on which a line across the diagram has its position.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
pub enum MarkAxis {
    /// The horizontal axis: the line is vertical.
    X,
    /// The vertical axis: the line is horizontal.
    Y,
}

/// A table of texts: rows below headings.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Table {
    /// The title.
    pub title: String,
    /// The columns' headings.
    pub head: Vec<String>,
    /// The rows, each with as many cells as there are headings. Columns of numbers are right-aligned.
    pub rows: Vec<Vec<String>>,
    /// True if the last column holds commands for a shell.
    pub commands: bool,
}

impl Table {
    /// Marks the last column as commands.
    #[must_use]
    pub const fn with_commands(mut self) -> Self {
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
