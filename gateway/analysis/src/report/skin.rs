//! Drawings of a skin's cells: their values over time, and where they are on their links.

use serde::Serialize;

/// A drawing of cells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub enum Drawing {
    /// Values over time.
    Strip(Strip),
    /// Values by place.
    Map(Map),
}

impl Drawing {
    /// Letters, digits and `-`, unlike any other in the page.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Strip(strip) => &strip.name,
            Self::Map(map) => &map.name,
        }
    }

    /// Its caption.
    #[must_use]
    pub fn title(&self) -> &str {
        match self {
            Self::Strip(strip) => &strip.title,
            Self::Map(map) => &map.title,
        }
    }
}

/// Time to the right, a row for each cell, its value as a colour.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Strip {
    /// Letters, digits and `-`, unlike any other in the page.
    pub name: String,
    /// Its caption.
    pub title: String,
    /// The time axis in s, from and to.
    pub seconds: (f64, f64),
    /// What the colours are.
    pub legend: Legend,
    /// Rows that belong together.
    pub groups: Vec<StripGroup>,
}

/// Rows under a heading.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StripGroup {
    /// The heading.
    pub title: String,
    /// The rows, the first one highest.
    pub rows: Vec<StripRow>,
}

/// One cell over time.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StripRow {
    /// What stands to the left of it.
    pub caption: String,
    /// From and to in s, and the value between, above 0; by increasing time. Nothing is drawn elsewhere.
    pub values: Vec<(f64, f64, f64)>,
}

/// Cells where they are on their links, their values as colours.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Map {
    /// Letters, digits and `-`, unlike any other in the page.
    pub name: String,
    /// Its caption.
    pub title: String,
    /// What the colours are.
    pub legend: Legend,
    /// The links.
    pub panels: Vec<Panel>,
}

/// The cells of a link, laid flat.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Panel {
    /// The link.
    pub title: String,
    /// The radius in m of the cylinder that was unrolled; none of a plate.
    pub radius: Option<f64>,
    /// Its cells.
    pub cells: Vec<Spot>,
}

/// A cell on a map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Spot {
    /// To the right and down, in m.
    pub at: [f64; 2],
    /// Its value; 0 has no colour, and a value that is not known is `None`.
    pub value: Option<f64>,
    /// What it is called.
    pub caption: String,
}

/// What colours stand for: from 0 to a maximum.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Legend {
    /// What is shown.
    pub caption: String,
    /// In what; empty for numbers of things.
    pub unit: String,
    /// The value of the last colour.
    pub max: f64,
}

impl Legend {
    /// Colours from 0 to the largest of some values.
    #[must_use]
    pub fn of(caption: &str, unit: &str, values: impl Iterator<Item = f64>) -> Self {
        Self { caption: caption.to_owned(), unit: unit.to_owned(), max: values.fold(0.0, f64::max) }
    }
}
