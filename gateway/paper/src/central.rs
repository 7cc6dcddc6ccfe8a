//! Fig. 9 and 10: the time of the central computation, as a function of the number of cells and of active cells.
//!
//! The functions [`CentralComputation::link_frames`] and [`CentralComputation::total_torque`] are timed. In a bench, a
//! tick that compares runs them for each bus; here they run for one list of cells. Each measurement covers several
//! computations in a row, so that the time for reading the clock is negligible and code and data are mostly in the
//! caches.

use std::hint::black_box;

use protocol::fixed::Q1_14;
use protocol::message::SkinSensors;
use protocol::skin::Skin;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::line::{LinearFit, WeightedPoint, count_to_f64, quantile};
use super::samples;
use super::ticks::{ARM_POSE_RAD, nanos_to_float, touched_sensors};
use analysis::paper;
use analysis::report::figure::{Axis, Figure, Finding, Quantity, Section, SeriesShape, Table, format_number};
use model::central::CentralComputation;

/// The number of computations between two readings of the clock.
const COMPUTATIONS_PER_SAMPLE: u32 = 16;
/// The number of measurements of each touch. The shortest time is used.
const MEASUREMENTS_PER_TOUCH: usize = 5;

/// The number of measurements for Fig. 9 and 10.
#[derive(Clone, Copy, Debug)]
pub struct CentralMeasurementPlan {
    /// The difference between successive numbers of cells.
    pub step: usize,
    /// The number of measurements for each number of cells.
    pub rounds: usize,
    /// The number of different touches. Each is of a random number of cells.
    pub touches: usize,
}

/// The time T_skin of the central computation for different numbers of cells, none of which is active.
#[derive(Clone, Debug)]
pub struct CentralTimesByCells {
    /// For each number of cells: that number, and the median, the 25th and the 75th percentile of T_skin in ns.
    pub points: Vec<[f64; 4]>,
    /// The line fitted to T_skin in ns as a function of the number of cells.
    pub line: LinearFit,
}

/// The time T_skin of the central computation for different numbers of active cells on one skin.
#[derive(Clone, Debug)]
pub struct CentralTimesByActiveCells {
    /// The number of cells of the skin.
    pub cells: usize,
    /// For each number of active cells: that number, the median of T_skin in ns, and as weight the number of touches.
    pub points: Vec<WeightedPoint>,
    /// The line fitted to T_skin in ns as a function of the number of active cells. Points are weighted by the number
    /// of touches.
    pub line: LinearFit,
}

/// Returns the time of one computation in ns, as the mean over several in a row.
fn computation_time_ns(central: &CentralComputation, sensors: &[SkinSensors], now: &impl Fn() -> u64) -> f64 {
    let joints = ARM_POSE_RAD.map(|angle| Q1_14::from_radians(angle).unwrap_or_default());
    let began = now();
    for _ in 0..COMPUTATIONS_PER_SAMPLE {
        let frames = central.link_frames(black_box(&joints));
        black_box(central.total_torque(&frames, black_box(sensors)));
    }
    nanos_to_float(now().saturating_sub(began)) / f64::from(COMPUTATIONS_PER_SAMPLE)
}

/// Measures T_skin for parts of a skin with 0 to all cells, none of which is active. Returns `None` for fewer than
/// three different numbers of cells.
#[must_use]
pub fn measure_over_cells(
    skin: &Skin,
    extent: CentralMeasurementPlan,
    now: impl Fn() -> u64,
) -> Option<CentralTimesByCells> {
    let central = CentralComputation::new(skin);
    let sensors = vec![SkinSensors::default(); skin.cells.len()];
    let cells: Vec<usize> = (0..=skin.cells.len()).step_by(extent.step.max(1)).collect();
    let measured = samples::measure_interleaved(cells.len(), extent.rounds, 9, |place| {
        let sensors = cells.get(place).and_then(|&cells| sensors.get(..cells)).unwrap_or_default();
        computation_time_ns(&central, sensors, &now)
    });
    let points = cells.iter().zip(&measured).map(|(&cells, values)| {
        let at = |part| quantile(&mut values.clone(), part);
        [count_to_f64(cells), at(0.5), at(0.25), at(0.75)]
    });
    let points: Vec<_> = points.collect();
    let line = LinearFit::fit_unweighted(&points.iter().map(|[x, y, ..]| (*x, *y)).collect::<Vec<_>>())?;
    Some(CentralTimesByCells { points, line })
}

/// Measures T_skin for different numbers of active cells on a skin. A touch is of consecutive cells in the order of the
/// skin, which are neighbours. Its first cell and its size are random.
#[must_use]
pub fn measure_over_active(
    skin: &Skin,
    extent: CentralMeasurementPlan,
    now: impl Fn() -> u64,
) -> Option<CentralTimesByActiveCells> {
    let central = CentralComputation::new(skin);
    let cells = skin.cells.len();
    let mut dice = Pcg64Mcg::seed_from_u64(10);
    let mut by_active = vec![Vec::new(); cells + 1];
    for _ in 0..extent.touches {
        let (active, first) = (dice.random_range(0..=cells), dice.random_range(0..cells.max(1)));
        let mut sensors = vec![SkinSensors::default(); cells];
        sensors.iter_mut().take(active).for_each(|reference_torque| *reference_torque = touched_sensors());
        sensors.rotate_right(first);
        let min = (0..MEASUREMENTS_PER_TOUCH)
            .map(|_| computation_time_ns(&central, &sensors, &now))
            .fold(f64::INFINITY, f64::min);
        if let Some(values) = by_active.get_mut(active) {
            values.push(min);
        }
    }
    let points = by_active.iter_mut().enumerate().filter(|(_, values)| !values.is_empty());
    let points: Vec<_> =
        points.map(|(active, values)| WeightedPoint::median(count_to_f64(active), values)).collect();
    Some(CentralTimesByActiveCells { cells, line: LinearFit::fit(&points)?, points })
}

/// The minimum R² at which a fitted line counts as a good description.
const MIN_R_SQUARED: f64 = 0.99;

fn fit_quality_finding(line: &LinearFit, paper: f64) -> Finding {
    let finding = Finding::more_is_better("quality of the fit, R²", paper, line.quality);
    finding.with_requirement(format!("at least {MIN_R_SQUARED}"), line.quality >= MIN_R_SQUARED)
}

/// Compares a slope or an intercept in ns with that of the paper in s: both values, and their ratio.
fn coefficient_findings(what: &str, ours: impl Into<Quantity>, paper_s: f64) -> [Finding; 2] {
    let ours = ours.into();
    let ratio = ours.value / (paper_s * 1e9);
    [
        Finding::less_is_better(what, paper_s * 1e9, ours),
        Finding::new_unrated(format!("{what}: ratio of our value to the paper's"), ratio),
    ]
}

/// Compares the maximum number of cells for which one cycle is long enough with that in the paper.
fn cell_limit_finding(active: &str, paper: f64, ours: f64) -> Finding {
    let what =
        format!("maximum number of cells at 500 Hz, {active} active, if the rest of a cycle takes 0.2 ms");
    Finding::more_is_better(what, paper, (ours, "cells"))
}

/// Returns an empty figure for T_skin over the quantity `x`.
fn empty_time_figure(name: &str, title: impl Into<String>, x: &str) -> Figure {
    Figure::new(name, title, Axis::new(x, ""), Axis::new("T_skin", "µs"))
}

/// Returns a figure with a logarithmic axis that ends at the largest x, and with the paper's line, whose coefficients
/// are in s. The line is drawn with many points, because it is curved on a logarithmic axis.
fn logarithmic_figure(
    figure: &Figure,
    equation: &str,
    measured: Vec<(f64, f64)>,
    most: f64,
    law: impl Fn(f64) -> f64,
) -> Figure {
    let law = (0..=100).map(|step| most * f64::from(step) / 100.0).map(|x| (x, law(x) * 1e6));
    let title = format!("The same measurements, compared with the paper's law ({equation})");
    let y = Axis::new("T_skin", "µs").with_log_scale().with_ends(0.1, 10_000.0);
    Figure::new(format!("{}-paper", figure.name), title, figure.x.clone(), y)
        .draw_series("measured", SeriesShape::Points, measured)
        .draw_series("the paper's law", SeriesShape::Dashed, law.collect())
}

/// Returns two points that draw a line, from 0 to `most`. The line is in ns and the points are in µs.
fn line_end_points(line: &LinearFit, most: f64) -> Vec<(f64, f64)> {
    [0.0, most].map(|x| (x, line.value_at(x) * 1e-3)).into()
}

/// Writes the section on Fig. 9, with the line of Eq. 29.
#[must_use]
pub fn fig9_section(over: &CentralTimesByCells) -> Section {
    let CentralTimesByCells { points, line } = over;
    let most = points.last().map_or(0.0, |point| point[0]);
    let micros = |place: fn(&[f64; 4]) -> f64| {
        points.iter().map(|point| (point[0], place(point) * 1e-3)).collect::<Vec<_>>()
    };
    let band = micros(|point| point[2]).into_iter().chain(micros(|point| point[3]).into_iter().rev());
    let median = micros(|point| point[1]);
    let fig9 = empty_time_figure("fig9", "T_skin by number of cells, none active", "cells, none active")
        .draw_series("middle half", SeriesShape::Band, band.collect())
        .draw_series("median", SeriesShape::Points, median.clone())
        .draw_series("linear fit", SeriesShape::Line, line_end_points(line, most));
    let papers = logarithmic_figure(&fig9, "Eq. 29", median, most, |cells| {
        paper::CENTRAL_TIME_PER_CELL_S * cells + paper::CENTRAL_FIXED_TIME_S
    });
    let cells = paper::max_cells(line.slope * 1e-9, line.intercept * 1e-9, 0.0, 0.0);
    Section::new("fig9", "Fig. 9: time of the central computation by number of cells")
        .with_paragraph(
            "A loop that computes the skin's torques has to process every cell in every cycle, even if no cell is \
             touched. The timed code is the gateway's central computation, which also runs in ticks that compare \
             torques. The figure shows the medians of many rounds in random order; the band is the middle half of \
             the measurements.",
        )
        .with_paragraph(format!(
            "T_skin(N) = {} ns · N + {} ns, R² = {:.4}. The paper's law is 827 ns · N + 10730 ns, on another \
             computer with another program: the claim is that the line is straight; its slope depends on the speed of \
             the computer and of the loop.",
            format_number(line.slope),
            format_number(line.intercept),
            line.quality
        ))
        .with_paragraph(format!(
            "By the paper's reasoning, (2 ms - 0.2 ms - intercept) / slope, this computer could handle {cells} \
             cells; the paper's law gives 2163, which the paper rounds to 2160.",
        ))
        .with_figures([fig9, papers])
        .with_findings(coefficient_findings("T_skin for each cell (slope of Eq. 29)", line.slope_in("ns"), paper::CENTRAL_TIME_PER_CELL_S))
        .with_findings(coefficient_findings("T_skin without cells", (line.intercept, "ns"), paper::CENTRAL_FIXED_TIME_S))
        .with_findings([fit_quality_finding(line, paper::CELLS_FIT_R_SQUARED), cell_limit_finding("none", paper::MAX_CELLS_NONE_ACTIVE, cells)])
}

/// Writes the section on Fig. 10, with the lines of Eq. 30 and 31, and the number of cells at which each line reaches
/// one cycle.
#[must_use]
pub fn fig10_section(over: &CentralTimesByActiveCells, cells: &CentralTimesByCells) -> Section {
    let CentralTimesByActiveCells { points, line, cells: of } = over;
    let most = count_to_f64(*of);
    let of_cells = cells.line;
    let limits =
        [(0.0, paper::MAX_CELLS_NONE_ACTIVE), (paper::ACTIVE_CELLS_AT_LIMIT, paper::MAX_CELLS_WITH_ACTIVE)]
            .map(|(active, paper)| {
                let [cell, fixed, each] =
                    [of_cells.slope, of_cells.intercept, line.slope].map(|ns| ns * 1e-9);
                cell_limit_finding(&active.to_string(), paper, paper::max_cells(cell, fixed, each, active))
            });
    let micros: Vec<_> = points.iter().map(|point| (point.x, point.y * 1e-3)).collect();
    let fig10 = empty_time_figure(
        "fig10",
        format!("T_skin by number of active cells, of {of} cells"),
        "active cells",
    )
    .draw_series("median of touches", SeriesShape::Points, micros.clone())
    .draw_series("linear fit", SeriesShape::Line, line_end_points(line, most));
    let papers = logarithmic_figure(&fig10, "Eq. 30", micros, most, |active| {
        paper::CENTRAL_TIME_PER_ACTIVE_CELL_S * active + paper::CENTRAL_TIME_NONE_ACTIVE_S
    });
    let all = Finding::new_unrated(
        format!("T_skin of {of} cells, all active (Eq. 31)"),
        ((of_cells.value_at(most) + line.slope * most) * 1e-3, "µs"),
    );
    let all_papers = (paper::CENTRAL_TIME_PER_CELL_S * most
        + paper::CENTRAL_FIXED_TIME_S
        + paper::CENTRAL_TIME_PER_ACTIVE_CELL_S * most)
        * 1e6;
    let touches: f64 = points.iter().map(|point| point.weight).sum();
    let laws = [
        ("cells (Eq. 29)", of_cells, paper::CENTRAL_TIME_PER_CELL_S),
        ("active cells (Eq. 30)", *line, paper::CENTRAL_TIME_PER_ACTIVE_CELL_S),
    ];
    let laws = laws.map(|(name, line, paper)| {
        let quality = format!("{:.4}", line.quality);
        let [slope, start, papers] = [line.slope, line.intercept, paper * 1e9].map(format_number);
        [name.to_owned(), slope, start, quality, papers]
    });
    Section::new("fig10", "Fig. 10: time of the central computation by number of active cells")
        .with_paragraph(format!(
            "The skin has {of} cells. Each of the {touches} touches is on a patch of random size at a random place. \
             The line is weighted by the number of touches; the paper's line is weighted by the number of samples."
        ))
        .with_paragraph(format!(
            "T_skin(N_act, N) = {} ns · N_act + {} ns · N + {} ns (Eq. 31; the paper: 798, 827 and 10730 ns).",
            format_number(line.slope),
            format_number(of_cells.slope),
            format_number(of_cells.intercept)
        ))
        .with_figures([fig10, papers])
        .with_findings(coefficient_findings("T_skin for each active cell (slope of Eq. 30)", line.slope_in("ns"), paper::CENTRAL_TIME_PER_ACTIVE_CELL_S))
        .with_findings(coefficient_findings(
            &format!("T_skin of {of} cells, none active"),
            (line.intercept, "ns"),
            paper::CENTRAL_TIME_NONE_ACTIVE_S,
        ))
        .with_findings([fit_quality_finding(line, paper::ACTIVE_CELLS_FIT_R_SQUARED), all.with_paper_value(all_papers)])
        .with_findings(limits)
        .with_tables([Table::new("Laws", ["law", "slope, ns", "intercept, ns", "R²", "slope in the paper, ns"], laws)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ticks;
    use analysis::report::figure::FindingVerdict;

    fn line(slope: f64, intercept: f64) -> LinearFit {
        LinearFit { slope, intercept, quality: 0.999, slope_half: 0.1 }
    }

    /// The findings that result from the lines of the paper, converted to ns.
    #[test]
    fn the_papers_own_laws_lead_to_its_limits_and_to_no_verdict_but_the_same() {
        let law = line(paper::CENTRAL_TIME_PER_CELL_S * 1e9, paper::CENTRAL_FIXED_TIME_S * 1e9);
        let points = [0.0, 1500.0, 3000.0]
            .map(|cells| [cells, law.value_at(cells), law.value_at(cells), law.value_at(cells)]);
        let cells = CentralTimesByCells { points: points.to_vec(), line: law };
        let over = line(paper::CENTRAL_TIME_PER_ACTIVE_CELL_S * 1e9, paper::CENTRAL_TIME_NONE_ACTIVE_S * 1e9);
        let points = [0.0, 100.0, 253.0].map(|x| WeightedPoint { x, y: over.value_at(x), weight: 3.0 });
        let active = CentralTimesByActiveCells { cells: 253, points: points.to_vec(), line: over };
        let (nine, ten) = (fig9_section(&cells), fig10_section(&active, &cells));
        let all = || nine.findings.iter().chain(&ten.findings);
        for finding in all().filter(|finding| finding.what.ends_with("ratio of our value to the paper's")) {
            assert!((finding.ours.value - 1.0).abs() < 1e-9, "{finding:?}");
        }
        let limits: Vec<_> =
            all().filter(|finding| finding.what.starts_with("maximum number of cells")).collect();
        assert_eq!(
            limits.iter().map(|limit| limit.ours.value.to_string()).collect::<Vec<_>>(),
            ["2163", "2163", "2067"]
        );
        assert!(limits.iter().all(|limit| limit.verdict == FindingVerdict::Same));
        let of = |what: &str| all().find(|finding| finding.what.starts_with(what)).unwrap();
        assert_eq!(of("T_skin for each cell").verdict, FindingVerdict::Same);
        assert_eq!(of("quality").verdict, FindingVerdict::Better, "above the bar");
        let steep = CentralTimesByCells { line: LinearFit { quality: 0.98, ..line(900.0, 0.0) }, ..cells };
        let worse = fig9_section(&steep)
            .findings
            .iter()
            .filter(|finding| finding.verdict == FindingVerdict::Worse)
            .count();
        assert_eq!(worse, 3, "slope, quality and limit");
    }

    /// The clock advances by 16 ns per reading, so each of the 16 computations between two readings takes 1 ns.
    #[test]
    fn every_number_of_cells_and_of_active_cells_is_measured() {
        let skin = ticks::generated_skin(40, 1).unwrap();
        let clock = std::cell::Cell::new(0);
        let now = || {
            clock.set(clock.get() + 16);
            clock.get()
        };
        let extent = CentralMeasurementPlan { step: 10, rounds: 3, touches: 200 };
        let cells = measure_over_cells(&skin, extent, now).unwrap();
        assert_eq!(
            cells.points.iter().map(|point| point[0].to_string()).collect::<Vec<_>>(),
            ["0", "10", "20", "30", "40"]
        );
        assert!(cells.points.iter().all(|point| (point[1] - 1.0).abs() < 1e-9));
        let active = measure_over_active(&skin, extent, now).unwrap();
        assert!((active.points.iter().map(|point| point.weight).sum::<f64>() - 200.0).abs() < 1e-9);
        assert!(active.points.iter().all(|point| (point.y - 1.0).abs() < 1e-9 && point.x <= 40.0));
        assert!(
            measure_over_cells(&skin, CentralMeasurementPlan { step: 40, ..extent }, now).is_none(),
            "two numbers make no law"
        );
    }
}
