//! Drawings of a skin's cells: their values over time, and their positions on the links.

use serde::Serialize;

use super::number::format_quantity;

/// A drawing of the cells of a skin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub enum Drawing {
    /// The cells' values over time.
    Strip(CellStrip),
    /// The cells' values at their positions on the links.
    Map(CellMap),
}

impl Drawing {
    /// Returns the name of the drawing, unique on the page, of letters, digits and `-`.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Strip(strip) => &strip.name,
            Self::Map(map) => &map.name,
        }
    }

    /// Returns the title and the meaning of colours and axes, for readers who do not see the drawing.
    #[must_use]
    pub fn description(&self) -> String {
        let (legend, more) = match self {
            Self::Strip(strip) => (&strip.legend, " Vertical: cells. Horizontal: time (s)."),
            Self::Map(map) => (&map.legend, ""),
        };
        let max = format_quantity(legend.max, &legend.unit);
        format!("{}. Colours: {}, 0 to {max}.{more}", self.title(), legend.caption)
    }

    /// Returns the caption of the drawing.
    #[must_use]
    pub fn title(&self) -> &str {
        match self {
            Self::Strip(strip) => &strip.title,
            Self::Map(map) => &map.title,
        }
    }
}

/// A chart of cells over time: time to the right, one row for each cell, and values as colours.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CellStrip {
    /// Name of the drawing, unique on the page, of letters, digits and `-`.
    pub name: String,
    /// Caption of the drawing.
    pub title: String,
    /// The ends of the time axis in s.
    pub seconds: (f64, f64),
    /// The legend of the colours.
    pub legend: ColourLegend,
    /// Groups of rows, such as the cells of a link.
    pub groups: Vec<StripGroup>,
}

/// A group of rows of a strip, under a heading.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StripGroup {
    /// The heading.
    pub title: String,
    /// The rows, from top to bottom.
    pub rows: Vec<StripRow>,
}

/// One row of a strip: the values of a cell over time.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StripRow {
    /// The text to the left of the row.
    pub caption: String,
    /// Start and end in s, and the value in between (above 0), in order of time. The row is empty at other times.
    pub values: Vec<(f64, f64, f64)>,
}

/// A map of the cells at their positions on the links, with values as colours.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CellMap {
    /// Name of the drawing, unique on the page, of letters, digits and `-`.
    pub name: String,
    /// Caption of the drawing.
    pub title: String,
    /// The legend of the colours.
    pub legend: ColourLegend,
    /// The links, each with its cells.
    pub panels: Vec<LinkPanel>,
}

/// One link on a map: its cells, mapped to a plane.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LinkPanel {
    /// Name of the link.
    pub title: String,
    /// The radius in m of the unrolled cylinder; `None` for a plate.
    pub radius: Option<f64>,
    /// The cells on the link.
    pub cells: Vec<MapCell>,
}

/// A cell on a map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MapCell {
    /// Position to the right and down, in m.
    pub at: [f64; 2],
    /// Value of the cell; 0 is drawn without colour, and `None` stands for unknown.
    pub value: Option<f64>,
    /// Name of the cell.
    pub caption: String,
}

/// The legend of colours, from 0 to a maximum.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ColourLegend {
    /// The quantity that the colours show.
    pub caption: String,
    /// Unit of the quantity; empty for counts.
    pub unit: String,
    /// The value at the last colour.
    pub max: f64,
}

impl ColourLegend {
    /// Creates a legend from 0 to the largest of these values.
    #[must_use]
    pub fn for_values(caption: &str, unit: &str, values: impl Iterator<Item = f64>) -> Self {
        Self { caption: caption.to_owned(), unit: unit.to_owned(), max: values.fold(0.0, f64::max) }
    }
}
