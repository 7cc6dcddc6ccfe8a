//! Fig. 6, 7 and 8: the moving arm, from recordings of a whole bench.

use serde_json::Value;

use super::line::{LinearFit, WeightedPoint, count_to_f64, quantile};
use super::recorded::TickRow;
use analysis::paper;
use analysis::report::figure::{
    Axis, Figure, Finding, MarkLine, Quantity, Section, Series, SeriesShape, Table, format_number,
};

/// The recording of a bench: its ticks, and its summary (`bench::summary::Summary` as JSON).
#[derive(Clone, Debug)]
pub struct BenchRun {
    /// The ticks of the run, in the order of time.
    pub rows: Vec<TickRow>,
    /// The summary of the run as JSON.
    pub summary: Value,
    /// The number of joints of the robot.
    pub joints: usize,
}

impl BenchRun {
    /// Returns the number in the summary at this path of keys; NaN if there is none.
    #[must_use]
    pub fn summary_number(&self, keys: &[&str]) -> f64 {
        let value = keys.iter().try_fold(&self.summary, |value, key| match key.parse::<usize>() {
            Ok(place) => value.get(place),
            Err(_) => value.get(key),
        });
        value.and_then(Value::as_f64).unwrap_or(f64::NAN)
    }

    /// Returns the number of cells of the bench.
    fn cells(&self) -> f64 {
        let cells = self.summary.get("cells").and_then(Value::as_array);
        cells.and_then(|cells| u32::try_from(cells.len()).ok()).map_or(f64::NAN, f64::from)
    }

    /// Returns the time at which the central computation was switched off, in s; `None` if it ran until the end.
    fn switch_off_time_s(&self) -> Option<f64> {
        let last = self.rows.iter().rposition(|row| row.central.is_some())?;
        self.rows.get(last + 1).map(|row| row.time_s)
    }

    fn points_over_time(&self, value: impl Fn(&TickRow) -> f64) -> Vec<(f64, f64)> {
        self.rows.iter().map(|row| (row.time_s, value(row))).collect()
    }

    /// Returns an empty figure whose x axis is the time of this run.
    fn time_figure(&self, name: impl Into<String>, title: impl Into<String>, y: Axis) -> Figure {
        Figure::new(name, title, Axis::new("time", "s"), y).with_marks(self.switch_off_marks())
    }

    fn switch_off_marks(&self) -> Vec<MarkLine> {
        self.switch_off_time_s()
            .map(|at| MarkLine::at_x(at, "without central computation"))
            .into_iter()
            .collect()
    }

    fn replies_finding(&self) -> Finding {
        let due = self.summary_number(&["buses", "0", "replies", "due"]);
        let in_time = self.summary_number(&["buses", "0", "replies", "in_time"]);
        Finding::new_unrated(format!("replies in time, of {due} due"), in_time)
    }
}

/// Writes the section on Fig. 6: the central and the distributed torques of a run in which each cell sends its own
/// torque, the errors of that run, and the errors of a run in which cells send sums.
#[must_use]
pub fn fig6_section(single: &BenchRun, summed: &BenchRun) -> Section {
    let joint = |joint: usize| {
        let central = |row: &TickRow| row.central.map_or(f64::NAN, |torque| joint_value(&torque, joint));
        let (name, title) = (format!("fig6-joint{}", joint + 1), format!("Joint {}", joint + 1));
        single
            .time_figure(name, title, Axis::new("torque", "Nm"))
            .with_half_width()
            .draw_series("central", SeriesShape::Line, single.points_over_time(central))
            .draw_series(
                "distributed",
                SeriesShape::Dashed,
                single.points_over_time(|row| joint_value(&row.distributed, joint)),
            )
    };
    let error = |run: &BenchRun, kind: &str, key: &str| run.summary_number(&["accuracy", kind, key]);
    let (mean_single, mean_summed) = (error(single, "single", "mean_nm"), error(summed, "sums", "mean_nm"));
    let [summed_due, summed_in] =
        ["due", "in_time"].map(|key| summed.summary_number(&["buses", "0", "sums", "contributions", key]));
    let row = |name: &str, run: &BenchRun, kind: &str| {
        let [mean, max, torques] =
            ["mean_nm", "max_nm", "count"].map(|key| format_number(error(run, kind, key)));
        [name.to_owned(), mean, max, torques]
    };
    let title = "Fig. 6: torques of the moving arm, computed in the loop and on the cells";
    let cell = Finding::less_is_better(
        "mean error of a cell's torque, Q3.12",
        paper::SINGLE_CELL_ERROR_NM,
        (mean_single, "Nm"),
    );
    let sum = Finding::less_is_better(
        "mean error of the summed torque, Q7.8",
        paper::SUMMED_ERROR_NM,
        (mean_summed, "Nm"),
    );
    let rows = [
        row("single cells, Q3.12, at the joints that they load", single, "single"),
        row("single cells, compared with unrounded parameters", single, "unquantised"),
        row("whole skin, sum of Q3.12 words", single, "whole"),
        row("whole skin, sums along the tree in Q7.8", summed, "sums"),
    ];
    Section::new("fig6", title)
        .with_paragraph(format!(
            "{} cells, each a process on a bus, answer joints messages at 62.5 Hz while the arm yields to touches; \
             until {:.1} s the loop also computes the torques itself.",
            single.cells(),
            single.switch_off_time_s().unwrap_or(f64::NAN)
        ))
        .with_paragraph(
            "An error is the difference between a reply and the central computation for the same joint positions and \
             touches, at the joints that the cell loads. Delays therefore have no effect on the errors. The curves \
             show the torques that the loop had at each tick. The run with sums is a second run with the same \
             touches. It is compared only in epochs whose sums were complete in time.",
        )
        .with_paragraph(joints_without_torque(single))
        .with_figures((0..single.joints).map(joint))
        .with_findings([
            cell.with_requirement("at most 1.2e-4 Nm", mean_single <= 1.2e-4),
            sum,
            single.replies_finding(),
            Finding::new_unrated(format!("contributions to sums in time, of {summed_due} due"), summed_in),
        ])
        .with_tables([Table::new(
            "Errors relative to the central computation, Nm",
            ["comparison", "mean", "maximum", "torques"],
            rows,
        )])
}

/// Returns the names of the joints on which no torque acted.
fn joints_without_torque(run: &BenchRun) -> String {
    let bears = |joint: usize| run.rows.iter().any(|row| joint_value(&row.distributed, joint).abs() > 0.0);
    let bare: Vec<_> =
        (0..run.joints).filter(|&joint| !bears(joint)).map(|joint| (joint + 1).to_string()).collect();
    if bare.is_empty() {
        "Cells load every joint.".to_owned()
    } else {
        format!("There is no torque on joints {}, because no cell is mounted beyond them.", bare.join(", "))
    }
}

fn joint_value(values: &[f64], joint: usize) -> f64 {
    values.get(joint).copied().unwrap_or(f64::NAN)
}

/// Writes the section on Fig. 7: joint velocities and active cells of a run.
#[must_use]
pub fn fig7_section(run: &BenchRun) -> Section {
    let velocity = |joint: usize| {
        let caption = format!("joint {}", joint + 1);
        Series::new(caption, SeriesShape::Line, run.points_over_time(|row| joint_value(&row.velocity, joint)))
    };
    let active = run.rows.iter().map(|row| row.contributing).max().unwrap_or(0);
    let fastest = run.rows.iter().flat_map(|row| row.velocity).map(f64::abs).fold(0.0, f64::max);
    let velocities = run.time_figure("fig7-velocities", "Joint velocities", Axis::new("velocity", "rad/s"));
    let cells = run.time_figure("fig7-active", "Active cells", Axis::new("cells that contribute", ""));
    let contributing = run.points_over_time(|row| f64::from(row.contributing));
    Section::new("fig7", "Fig. 7: joint velocities and active cells")
        .with_paragraph("This is the same run. The cells' torques move the arm; the loop uses no others.")
        .with_figures([
            velocities.with_series((0..run.joints).map(velocity)),
            cells.draw_series("active cells", SeriesShape::Steps, contributing),
        ])
        .with_findings([
            Finding::new_unrated("maximum number of cells active at once", (f64::from(active), "cells")),
            Finding::new_unrated("maximum joint velocity", (fastest, "rad/s")),
        ])
}

/// The number of cycles whose median is drawn as one point.
const CYCLES_PER_MEDIAN: usize = 25;

/// Returns the median of a time of some ticks, in µs.
fn median_time<'a>(rows: impl Iterator<Item = &'a TickRow>, time: impl Fn(&TickRow) -> f64) -> f64 {
    quantile(&mut rows.map(time).collect::<Vec<_>>(), 0.5)
}

/// Writes the section on Fig. 8: the times of cycles, and of the central computation until it is switched off.
#[must_use]
pub fn fig8_section(run: &BenchRun) -> Section {
    let cells = run.cells();
    let before = || run.rows.iter().filter(|row| row.central.is_some());
    let after = || run.rows.iter().filter(|row| row.central.is_none());
    let none_active = {
        let times: Vec<f64> =
            before().filter(|row| row.contributing == 0).map(|row| row.central_us).collect();
        times.iter().sum::<f64>() / count_to_f64(times.len())
    };
    let total = [median_time(before(), |row| row.took_us), median_time(after(), |row| row.took_us)];
    let off = after().map(|row| row.central_us).fold(0.0, f64::max);
    let slope = fit_over_active(after());
    let top = {
        let mut times: Vec<f64> = run.rows.iter().map(|row| row.took_us).collect();
        2.0 * quantile(&mut times, 0.99)
    };
    let beyond = run.rows.iter().filter(|row| row.took_us > top).count();
    let over = run.rows.iter().filter(|row| row.took_us > paper::CYCLE_TIME_S * 1e6).count();
    let us = |value| (value, "µs");
    let figure = |name: &str, title: &str, top| {
        run.time_figure(name, title, Axis::new("time in a cycle", "µs").with_ends(0.0, top))
    };
    let medians = |time: &dyn Fn(&TickRow) -> f64| {
        let pieces = run.rows.chunks(CYCLES_PER_MEDIAN).filter_map(|rows| Some((rows.first()?.time_s, rows)));
        pieces.map(|(at, rows)| (at, median_time(rows.iter(), time))).collect::<Vec<_>>()
    };
    let per_frame = {
        let frames = run.summary_number(&["buses", "0", "uplink", "delivered"]);
        run.summary_number(&["processor", "gateway"]) * run.summary_number(&["duration_s"]) * 1e6 / frames
    };
    let none = Finding::less_is_better(
        format!("mean T_skin while none of {cells} cells is active"),
        (paper::CENTRAL_TIME_PER_CELL_S * cells + paper::CENTRAL_FIXED_TIME_S) * 1e6,
        us(none_active),
    );
    let after_switch = Finding::less_is_better(
        "median of T_total after the switchover",
        paper::NON_CENTRAL_WORK_S * 1e6,
        us(total[1]),
    );
    let of_active = slope.map(|line| {
        let slope = Quantity::new(line.slope * 1e3, "ns").with_half_interval(line.slope_half * 1e3);
        Finding::new_unrated("T_total after the switchover for each active cell", slope)
    });
    let took = |row: &TickRow| row.took_us;
    let central = |row: &TickRow| row.central_us;
    Section::new("fig8", format!("Fig. 8: cycle times, {cells} cells"))
        .with_paragraph(
            "T_total is the time of a tick from reading the sums to passing on its record, and T_skin is the time of \
             the central computation in it. At the switchover, the central computation is switched off. Unlike in the \
             paper, T_total does not include the driver of the robot, because the robot is simulated.",
        )
        .with_paragraph(format!(
            "The axis ends at twice the 99th percentile. {beyond} of {} ticks, during which the machine was busy \
             with other work, are beyond its end, but are in the data.",
            run.rows.len()
        ))
        .with_figures([
            figure("fig8", "Cycle times", top)
                .draw_series("T_total", SeriesShape::Line, run.points_over_time(took))
                .draw_series("T_skin", SeriesShape::Line, run.points_over_time(central)),
            figure("fig8-medians", "Cycle times, medians of 25 cycles", top / 2.0)
                .draw_series("T_total", SeriesShape::Steps, medians(&took))
                .draw_series("T_skin", SeriesShape::Steps, medians(&central)),
        ])
        .with_findings([
            none,
            Finding::new_unrated("maximum of T_skin after the switchover", us(off))
                .with_paper_value(0.0)
                .with_requirement("0", off <= 0.0),
            Finding::new_unrated("median of T_total before the switchover", us(total[0])),
            after_switch.with_requirement("less than before", total[1] < total[0]),
        ])
        .with_findings(of_active)
        .with_findings([
            Finding::new_unrated("ticks above 2 ms", count_to_f64(over)),
            Finding::new_unrated(
                "processor time of the gateway for each received frame: socket, loop, recorder",
                us(per_frame),
            ),
        ])
}

/// Fits a line to the median time of ticks over the number of active cells. Points are weighted by the number of ticks.
fn fit_over_active<'a>(rows: impl Iterator<Item = &'a TickRow>) -> Option<LinearFit> {
    let mut by_active = std::collections::BTreeMap::<u32, Vec<f64>>::new();
    for row in rows {
        by_active.entry(row.contributing).or_default().push(row.took_us);
    }
    let points = by_active.iter_mut().map(|(&active, times)| WeightedPoint::median(f64::from(active), times));
    LinearFit::fit(&points.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use analysis::report::figure::FindingVerdict;
    use protocol::packet::pad_with_defaults;
    use serde_json::json;

    /// Returns a run of one second in which the central computation takes 3 µs and is switched off at 0.5 s.
    fn run() -> BenchRun {
        let row = |tick: u16| {
            let central = (tick < 250).then_some([1.0; 6]);
            let central_us = if central.is_some() { 3.0 } else { 0.0 };
            TickRow {
                time_s: f64::from(tick) * 0.002,
                velocity: pad_with_defaults(&[0.1, -0.4, 0.0, 0.0, 0.0, 0.0]),
                distributed: pad_with_defaults(&[1.001; 6]),
                central: central.map(|central: [f64; 6]| pad_with_defaults(&central)),
                contributing: u32::from(tick % 20),
                took_us: 1.0 + central_us,
                central_us,
            }
        };
        let summary = json!({
            "cells": vec![json!({}); 253], "duration_s": 1.0, "processor": { "gateway": 0.04 },
            "accuracy": {
                "single": { "mean_nm": 6e-5, "max_nm": 4e-4, "count": 1000 },
                "sums": { "mean_nm": 0.004, "max_nm": 0.02, "count": 500 },
            },
            "buses": [{ "replies": { "due": 100, "in_time": 99 }, "uplink": { "delivered": 4000 } }],
        });
        BenchRun { rows: (0..500).map(row).collect(), summary, joints: 6 }
    }

    #[test]
    fn the_switch_is_found_and_what_came_before_it_and_after() {
        let run = run();
        assert_eq!(run.switch_off_time_s(), Some(0.5));
        let section = fig8_section(&run);
        let of = |what: &str| section.findings.iter().find(|finding| finding.what.starts_with(what)).unwrap();
        assert!((of("mean T_skin").ours.value - 3.0).abs() < 1e-9);
        assert!((of("median of T_total before").ours.value - 4.0).abs() < 1e-9);
        assert!((of("median of T_total after the switchover").ours.value - 1.0).abs() < 1e-9);
        assert!(section.findings.iter().all(|finding| finding.verdict != FindingVerdict::Worse));
        assert!((of("processor time of the gateway").ours.value - 10.0).abs() < 1e-9);
        let mut never_off = run;
        never_off.rows.iter_mut().for_each(|row| row.central_us = 3.0);
        assert!(
            fig8_section(&never_off).findings.iter().any(|finding| finding.verdict == FindingVerdict::Worse)
        );
    }

    #[test]
    fn every_joint_has_its_figure_and_errors_stand_beside_the_papers() {
        let run = run();
        let section = fig6_section(&run, &run);
        assert_eq!(section.figures.len(), 6);
        let central = &section.figures[0].series[0].points;
        assert!(central[249].1.is_finite() && central[250].1.is_nan(), "a gap from the switch on");
        assert!((section.findings[0].ours.value - 6e-5).abs() < 1e-12);
        assert!((section.findings[1].ours.value - 0.004).abs() < 1e-12);
        let section = fig7_section(&run);
        assert_eq!((section.figures[0].series.len(), section.findings[0].ours.value), (6, 19.0));
    }
}
