//! Drawings of a skin's cells: their values over time, and their positions on the links.

use serde::Serialize;

/// A drawing of cells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub enum Drawing {
    /// Values over time.
    Strip(Strip),
    /// Values by position.
    Map(Map),
}

impl Drawing {
    /// Returns the unique name in the page, of letters, digits and `-`.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Strip(strip) => &strip.name,
            Self::Map(map) => &map.name,
        }
    }

    /// Returns its caption.
    #[must_use]
    pub fn title(&self) -> &str {
        match self {
            Self::Strip(strip) => &strip.title,
            Self::Map(map) => &map.title,
        }
    }
}

/// A chart with time to the right, one row per cell, and values as colours.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Strip {
    /// A unique name in the page, of letters, digits and `-`.
    pub name: String,
    /// Its caption.
    pub title: String,
    /// The ends of the time axis in s.
    pub seconds: (f64, f64),
    /// The legend of the colours.
    pub legend: Legend,
    /// Groups of rows.
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
    /// The text to the left of the row.
    pub caption: String,
    /// Start and end in s, and the value in between, above 0; by increasing time. The rest of the row stays empty.
    pub values: Vec<(f64, f64, f64)>,
}

/// A map of the cells at their positions on the links, with values as colours.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Map {
    /// A unique name in the page, of letters, digits and `-`.
    pub name: String,
    /// Its caption.
    pub title: String,
    /// The legend of the colours.
    pub legend: Legend,
    /// The links.
    pub panels: Vec<Panel>,
}

/// The cells of a link, mapped to a plane.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Panel {
    /// The link.
    pub title: String,
    /// The radius in m of the unrolled cylinder; `None` for a plate.
    pub radius: Option<f64>,
    /// Its cells.
    pub cells: Vec<Spot>,
}

/// A cell on a map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Spot {
    /// Position to the right and down, in m.
    pub at: [f64; 2],
    /// Its value; 0 has no colour, and `None` is unknown.
    pub value: Option<f64>,
    /// Its name.
    pub caption: String,
}

/// The legend of colours, from 0 to a maximum.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Legend {
    /// The quantity.
    pub caption: String,
    /// The unit; empty for counts.
    pub unit: String,
    /// The value of the last colour.
    pub max: f64,
}

impl Legend {
    /// Creates a legend from 0 to the largest of some values.
    #[must_use]
    pub fn for_values(caption: &str, unit: &str, values: impl Iterator<Item = f64>) -> Self {
        Self { caption: caption.to_owned(), unit: unit.to_owned(), max: values.fold(0.0, f64::max) }
    }
}
