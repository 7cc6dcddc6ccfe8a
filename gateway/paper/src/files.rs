//! The files beside the page of experiments: the data of each figure as CSV, and all findings as JSON.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde_json::{Value, json};

use analysis::report::figure::{Axis, Figure, Page, Series, SeriesShape};

/// Returns the data of a figure as CSV: a column for x and one for each series, with units in the header. A band has
/// two columns. A value is empty where a series has no point. If a series has several values at one x, they are in
/// several rows.
#[must_use]
pub fn csv(figure: &Figure) -> String {
    let columns: Vec<(String, &[(f64, f64)])> = figure.series.iter().flat_map(columns).collect();
    let mut rows: BTreeMap<(u64, usize), Vec<Option<f64>>> = BTreeMap::new();
    for (place, (_, points)) in columns.iter().enumerate() {
        let mut again: BTreeMap<u64, usize> = BTreeMap::new();
        for &(x, y) in *points {
            let key = float_to_ordered(x);
            let again = again.entry(key).or_default();
            let row = rows.entry((key, *again)).or_insert_with(|| vec![None; columns.len()]);
            *again += 1;
            if let Some(cell) = row.get_mut(place) {
                *cell = Some(y);
            }
        }
    }
    let mut text = csv_quoted(&figure.x.to_string());
    for (caption, _) in &columns {
        let axis =
            Axis::new(if caption.is_empty() { figure.y.caption.as_str() } else { caption }, &figure.y.unit);
        let _ = write!(text, ",{}", csv_quoted(&axis.to_string()));
    }
    text.push('\n');
    for ((x, _), row) in rows {
        let _ = write!(text, "{}", ordered_to_float(x));
        for y in row {
            let _ = match y.filter(|y| y.is_finite()) {
                Some(y) => write!(text, ",{y}"),
                None => write!(text, ","),
            };
        }
        text.push('\n');
    }
    text
}

/// Returns the columns of a series: a single one, or the lower and the upper edge of a band.
fn columns(series: &Series) -> Vec<(String, &[(f64, f64)])> {
    if series.shape != SeriesShape::Band {
        return vec![(series.caption.clone(), &series.points)];
    }
    let (lower, upper) = series.points.split_at(series.points.len().div_ceil(2));
    vec![(format!("{}, lower", series.caption), lower), (format!("{}, upper", series.caption), upper)]
}

/// Maps a number to an integer, so that integers compare as the numbers do.
fn float_to_ordered(x: f64) -> u64 {
    let bits = x.to_bits();
    if bits >> 63 == 0 { bits | 1 << 63 } else { !bits }
}

fn ordered_to_float(ordered: u64) -> f64 {
    f64::from_bits(if ordered >> 63 == 1 { ordered & !(1 << 63) } else { !ordered })
}

fn csv_quoted(text: &str) -> String {
    if text.contains(['"', ',', '\n']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// Returns the findings on a page as JSON, by experiment, with facts about the run such as the machine.
#[must_use]
pub fn findings_json(page: &Page) -> Value {
    let facts: BTreeMap<_, _> = page.facts.iter().map(|(name, value)| (name, value)).collect();
    let experiments: Vec<Value> = page
        .sections
        .iter()
        .map(|section| json!({ "name": section.name, "title": section.title, "findings": section.findings }))
        .collect();
    json!({ "title": page.title, "facts": facts, "experiments": experiments })
}

#[cfg(test)]
mod tests {
    use super::*;
    use analysis::report::figure::{Finding, Quantity, Section};

    #[test]
    fn a_figures_data_has_units_and_gaps_and_all_its_values() {
        let figure = Figure {
            x: Axis::new("time", "s"),
            y: Axis::new("torque", "Nm"),
            series: vec![
                Series::new(
                    "central, f64",
                    SeriesShape::Line,
                    vec![(-1.0, 1.0), (0.5, f64::NAN), (2.0, 3.0)],
                ),
                Series::new("", SeriesShape::Points, vec![(0.5, 7.0), (0.5, 8.0)]),
                Series::new("half", SeriesShape::Band, vec![(0.5, 1.0), (2.0, 2.0), (2.0, 4.0), (0.5, 3.0)]),
            ],
            ..Figure::default()
        };
        let target = "time (s),\"central, f64 (Nm)\",torque (Nm),\"half, lower (Nm)\",\"half, upper (Nm)\"\n\
                      -1,1,,,\n0.5,,7,1,3\n0.5,,8,,\n2,3,,2,4\n";
        assert_eq!(csv(&figure), target);
    }

    #[test]
    fn a_number_keeps_its_place() {
        let numbers = [-1e9, -2.0, -0.0, 0.0, 1e-300, 3.0, f64::INFINITY];
        assert!(numbers.windows(2).all(|pair| float_to_ordered(pair[0]) < float_to_ordered(pair[1])));
        assert!(
            numbers
                .iter()
                .all(|&number| ordered_to_float(float_to_ordered(number)).to_bits() == number.to_bits())
        );
    }

    #[test]
    fn results_have_every_finding_with_its_verdict() {
        let finding = Finding::less_is_better("error", 2.0, Quantity::new(1.0, "Nm"));
        let section = Section { name: "fig6".to_owned(), findings: vec![finding], ..Section::default() };
        let page = Page {
            facts: vec![("machine".to_owned(), "one".to_owned())],
            sections: vec![section],
            ..Page::default()
        };
        let value = findings_json(&page);
        let finding = &value["experiments"][0]["findings"][0];
        assert_eq!(
            (finding["ours"]["value"].as_f64(), finding["paper"]["unit"].as_str()),
            (Some(1.0), Some("Nm"))
        );
        assert_eq!(finding["verdict"], "Better");
        assert_eq!(value["facts"]["machine"], "one");
    }
}
