//! The data in a drawing with which the script of a page reads its values: the places of axes, and the names of series.

use protocol::xml::escaped;
use serde::Serialize;

use super::super::figure::{Axis, Scale};
use super::super::number::base_unit;
use super::super::scale::AxisSpan;

/// An axis as a script reads it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct ReadableAxis {
    /// The places of the ends of the axis, in the drawing's units.
    pub(super) at: [f64; 2],
    /// The values at the ends.
    ends: [f64; 2],
    log: bool,
    #[serde(flatten)]
    unit: ReadableUnit,
}

/// A unit, with its size in the base unit and the highest power of a thousand if it takes prefixes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct ReadableUnit {
    unit: String,
    base: Option<&'static str>,
    size: f64,
    most: i32,
}

impl ReadableUnit {
    pub(super) fn new(unit: &str) -> Self {
        let (size, base, most) =
            base_unit(unit).map_or((1.0, None, 0), |(size, base, most)| (size, Some(base), most));
        Self { unit: unit.to_owned(), base, size, most }
    }
}

impl ReadableAxis {
    pub(super) fn new(axis: &Axis, span: &AxisSpan, at: [f64; 2]) -> Self {
        let ends = [0.0, 1.0].map(|place| span.value_at(place));
        Self { at, ends, log: axis.scale == Scale::Log, unit: ReadableUnit::new(&axis.unit) }
    }
}

/// A diagram as a script reads it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct ReadablePlot {
    pub(super) x: ReadableAxis,
    pub(super) y: ReadableAxis,
    /// The name of each series, and the number of its elements. The elements of all series follow each other in the
    /// drawing, and then those of the legend.
    pub(super) series: Vec<(String, usize)>,
    /// Number of the elements of the legend.
    pub(super) keys: usize,
}

/// Formats an attribute of an SVG element whose value is data for a script.
pub(super) fn data_attribute(name: &str, data: &impl Serialize) -> String {
    // Serialising strings and numbers cannot fail.
    let data = serde_json::to_string(data).unwrap_or_default();
    format!(" data-{name}=\"{}\"", escaped(&data))
}
