//! What the ticks and the cells' torques come to.

use protocol::packet::WORDS;

use super::Draft;
use crate::paper;
use crate::report::figure::{Axis, Figure, Mark, On, Section, Series, Shape, Size, Table, number};
use crate::report::thin::Thinned;
use model::quantiles::Quantiles;
use model::table::{Accuracy, Errors};

impl Draft<'_> {
    /// The paper's Fig. 6.
    pub(super) fn torque(&self) -> Section {
        let motion = &self.run.motion;
        let pairs = motion.distributed.iter().zip(&motion.central).enumerate();
        let figures = pairs.map(|(joint, (distributed, central))| Figure {
            name: format!("torque-joint{}", joint + 1),
            title: format!("Joint {}: what the cells say together, and what the gateway computes", joint + 1),
            size: Size::Half,
            x: self.time(),
            y: Axis::new("torque", "Nm"),
            series: vec![
                self.line("distributed", distributed),
                Series::new("central", Shape::Dashed, self.points(central)),
            ],
            marks: Vec::new(),
        });
        let mut figures: Vec<_> = figures.collect();
        let errors: Vec<_> = self.run.lanes.iter().filter(|lane| lane.error.count() > 0).collect();
        if !errors.is_empty() {
            let papers = |format: &str, mean| Mark {
                on: On::Y,
                at: mean,
                label: format!("paper, {format}: {} Nm", number(mean)),
            };
            figures.push(Figure {
                name: "torque-error".to_owned(),
                title: "Mean absolute error of an epoch that all cells answered in time".to_owned(),
                size: Size::Wide,
                x: self.time(),
                y: Axis::new("error", "Nm").log(),
                series: errors.iter().map(|lane| self.line(self.named(lane), &lane.error)).collect(),
                marks: vec![papers("Q3.12", paper::SINGLE_NM), papers("Q7.8", paper::SUMMED_NM)],
            });
        }
        let text = vec![
            "The curves hold what has come at each tick: while a touch changes they differ by what is on its way. The \
             errors below compare like with like: each torque with the central computation for the joints that it answers."
                .to_owned(),
        ];
        Section {
            name: "torque".to_owned(),
            title: "Distributed and central torque".to_owned(),
            text,
            figures,
            tables: self.errors().into_iter().collect(),
            ..Section::default()
        }
    }

    /// Errors joint by joint.
    fn errors(&self) -> Option<Table> {
        let accuracy = self.run.lanes.iter().map(|lane| lane.table.accuracy()).reduce(Accuracy::with)?;
        let joints = self.run.skin.robot.joints.len().min(WORDS);
        let single = accuracy.single_by_joint.iter().zip(&accuracy.whole_by_joint).take(joints);
        let text = |errors: &Errors| {
            let mean = number(errors.mean().unwrap_or(f64::NAN));
            [mean, number(errors.max()), errors.count().to_string()]
        };
        let row = |name: String, single: &Errors, whole: &Errors| {
            let cells = [name].into_iter().chain(text(single)).chain(text(whole));
            cells.collect::<Vec<_>>()
        };
        let mut rows: Vec<_> = single
            .enumerate()
            .map(|(joint, (single, whole))| row(format!("joint {}", joint + 1), single, whole))
            .collect();
        if accuracy.single.count() == 0 {
            return None;
        }
        rows.push(row("all".to_owned(), &accuracy.single, &accuracy.whole));
        rows.push(vec![
            "paper".to_owned(),
            number(paper::SINGLE_NM),
            String::new(),
            String::new(),
            number(paper::SUMMED_NM),
            String::new(),
            String::new(),
        ]);
        let head =
            ["", "single cells: mean", "greatest", "torques", "whole skin: mean", "greatest", "epochs"];
        Some(Table {
            title: "Absolute errors in Nm, joint by joint: single cells where the joint carries them, and the whole skin's sum".to_owned(),
            head: head.map(str::to_owned).into(),
            rows,
        })
    }

    /// The paper's Fig. 7, and the positions.
    pub(super) fn motion(&self) -> Section {
        let joints = |series: &[Thinned]| {
            let named = series.iter().enumerate();
            named.map(|(joint, series)| self.line(format!("joint {}", joint + 1), series)).collect::<Vec<_>>()
        };
        let figure = |name: &str, title: &str, y: Axis, series: &[Thinned]| Figure {
            name: name.to_owned(),
            title: title.to_owned(),
            size: Size::Wide,
            x: self.time(),
            y,
            series: joints(series),
            marks: self.marks(),
        };
        let motion = &self.run.motion;
        let figures = vec![
            figure("positions", "Joint positions", Axis::new("position", "rad"), &motion.position),
            figure("velocities", "Joint velocities", Axis::new("velocity", "rad/s"), &motion.velocity),
        ];
        Section { name: "motion".to_owned(), title: "The arm".to_owned(), figures, ..Section::default() }
    }

    pub(super) fn cells(&self) -> Section {
        let motion = &self.run.motion;
        let in_torque = Series::new("in the torque", Shape::Steps, self.points(&motion.contributing));
        let active =
            Series::new("in contact, by the central computation", Shape::Steps, self.points(&motion.active));
        let figure = Figure {
            name: "active-cells".to_owned(),
            title: "Active cells: those whose torque is in the sum, and those that are in contact".to_owned(),
            size: Size::Wide,
            x: self.time(),
            y: Axis::new("cells", ""),
            series: vec![in_torque, active],
            marks: self.marks(),
        };
        Section {
            name: "cells".to_owned(),
            title: "Active cells".to_owned(),
            figures: vec![figure],
            ..Section::default()
        }
    }

    /// The paper's Fig. 8.
    pub(super) fn cycle(&self) -> Section {
        let motion = &self.run.motion;
        let figure = |name: &str, title: &str, series: Vec<Series>| Figure {
            name: name.to_owned(),
            title: title.to_owned(),
            size: Size::Wide,
            x: self.time(),
            y: Axis::new("time", "µs").log(),
            series,
            marks: self.marks(),
        };
        let figures = vec![
            figure(
                "cycle",
                "How long each tick took, and the central computation in it",
                vec![
                    self.line("tick", &motion.took),
                    self.line("central computation in it", &motion.central_took),
                ],
            ),
            figure("lateness", "How late each tick began", vec![self.line("", &motion.late)]),
        ];
        let rows = [
            ("tick began late", &motion.late_ns),
            ("tick took", &motion.took_ns),
            ("central computation in it", &motion.central_ns),
            ("tick without central computation", &motion.plain_ns),
        ];
        let row = |(name, histogram): &(&str, &hdrhistogram::Histogram<u64>)| {
            let Quantiles { p50, p90, p99, max, count } = Quantiles::of(histogram, 1e-3);
            let values = [p50, p90, p99, max].map(number);
            [(*name).to_owned()].into_iter().chain(values).chain([count.to_string()]).collect::<Vec<_>>()
        };
        let mut rows: Vec<_> = rows.iter().filter(|(_, histogram)| !histogram.is_empty()).map(row).collect();
        let idle = ["idle_late_p50_us", "idle_late_p99_us", "idle_late_max_us"]
            .map(|key| self.run.fact("machine", key));
        if let [Some(p50), Some(p99), Some(max)] = idle {
            let cells = ["the idle machine's thread woke late", p50, "", p99, max, ""];
            rows.push(cells.map(str::to_owned).into());
        }
        let head = ["µs", "median", "90 %", "99 %", "greatest", "values"].map(str::to_owned).into();
        let table = Table { title: "The control loop".to_owned(), head, rows };
        Section {
            name: "cycle".to_owned(),
            title: "Cycle times".to_owned(),
            text: vec![
                "The distributed computation has no part in a tick: the sum is kept while replies come."
                    .to_owned(),
            ],
            figures,
            tables: vec![table],
            ..Section::default()
        }
    }
}
