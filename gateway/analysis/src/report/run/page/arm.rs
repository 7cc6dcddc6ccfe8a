//! The sections on the arm: torques, motion and cycle times, from the ticks and from the cells' torques.

use hdrhistogram::Histogram;

use super::super::bus_figures::BusFigures;
use super::facts::format_micros;
use super::{PageDraft, without_empty_series};
use crate::paper;
use crate::report::figure::{
    Axis, Figure, LowerDiagram, MarkLine, Section, Series, SeriesShape, Table, format_quantity,
};
use crate::report::thin::ThinnedLine;
use model::table::{TorqueAccuracy, TorqueErrors};
use protocol::fixed::TorqueFormat;
use protocol::quantiles::Quantiles;
use protocol::skin::{JointKind, SkinReply};

/// Upper bound of the central computation's rounding error, in Nm: smaller errors count as zero.
const ROUNDING_ERROR_NM: f64 = 1e-12;

/// Sets errors within the rounding of the reference computation to zero.
fn without_rounding(error: f64) -> f64 {
    if error.abs() < ROUNDING_ERROR_NM { 0.0 } else { error }
}

impl PageDraft<'_> {
    /// Creates the section on torques, which corresponds to the paper's Fig. 6.
    pub(super) fn torque_section(&self) -> Section {
        let joints = 0..self.run.skin.robot.joints.len();
        let (loaded, free): (Vec<_>, Vec<_>) = joints.partition(|joint| self.is_loaded(*joint));
        let errors: Vec<_> = self
            .run
            .bus_figures
            .iter()
            .filter(|bus_figures| bus_figures.lines.error.point_count() > 0)
            .collect();
        let error = (!errors.is_empty()).then(|| {
            let papers = |format: &str, mean| {
                MarkLine::at_y(mean, format!("paper, {format}: {}", format_quantity(mean, "Nm")))
            };
            let title = "Mean absolute error of an epoch that all cells answered in time";
            self.time_figure("torque-error", title, Axis::new("error", "Nm").with_log_scale())
                .with_series(errors.iter().map(|bus_figures| {
                    let mut series =
                        self.thinned_series(self.bus_caption(bus_figures), &bus_figures.lines.error);
                    series.points.iter_mut().for_each(|(_, error)| *error = without_rounding(*error));
                    series
                }))
                .with_marks([
                    papers("Q3.12", paper::SINGLE_CELL_ERROR_NM),
                    papers("Q7.8", paper::SUMMED_ERROR_NM),
                ])
        });
        let mut section = Section::new("torque", "Torque, and its difference from the central computation");
        if !loaded.is_empty() {
            let when = if self.run.frames_only.is_some() { "before each broadcast" } else { "at each tick" };
            section = section.with_paragraph(format!("The upper curves are the sum of the torques received {when}, and the central computation. The lower curve is the \
             difference, once per epoch, between the sum of all cells' answers and the central computation for the same positions; an epoch without an \
             answer in time is a gap. Dotted lines: one step of the torque words."));
            let is_compared = self.run.bus_figures.iter().any(|it| it.lines.error.point_count() > 0);
            let lacks =
                self.missing_sentence("the stimuli or sensors from which central torques are computed");
            section.text.extend(lacks.filter(|_| !is_compared));
        }
        if !free.is_empty() {
            let names: Vec<_> = free.iter().map(|joint| self.joint_name(*joint)).collect();
            section = section.with_paragraph(format!(
                "Joints whose torques, distributed and central, are all below the resolution (half a step of the words): {}.",
                names.join(", ")
            ));
        }
        if let Some(advice) = self.advice_by_bus() {
            section = section.with_paragraph(advice);
        }
        let figures = loaded.into_iter().map(|joint| self.torque_figure(joint));
        section
            .with_figures(figures.chain(error))
            .with_tables(self.error_table())
            .with_tables(self.formats_table())
    }

    /// Returns the buses with cells that may load a joint, each with the joint's index in its chain.
    fn buses_with_joint(&self, joint: usize) -> impl Iterator<Item = (usize, usize, &BusFigures)> {
        self.run.bus_figures.iter().enumerate().filter_map(move |(bus, bus_figures)| {
            let place = self.run.skin.joints_on_bus(bus).position(|(of_chain, _)| of_chain == joint)?;
            Some((bus, place, bus_figures))
        })
    }

    /// Returns the size of one step of the torque words of a bus, in Nm or N.
    fn torque_step_size(&self, bus: usize) -> f64 {
        let bus = self.run.skin.buses.get(bus);
        let format = bus.map_or_else(TorqueFormat::default, |bus| match bus.reply {
            SkinReply::Torque => bus.torque_format,
            SkinReply::Sum { .. } => TorqueFormat::Q7_8,
        });
        format.step_size()
    }

    /// Returns true if a joint had a torque of at least half a step of the words.
    fn is_loaded(&self, joint: usize) -> bool {
        let step = self
            .buses_with_joint(joint)
            .map(|(bus, ..)| self.torque_step_size(bus))
            .fold(f64::INFINITY, f64::min);
        let largest = |line: Option<&ThinnedLine>| {
            let points = line.map(ThinnedLine::points).unwrap_or_default();
            points.iter().map(|point| point.1.abs()).fold(0.0, f64::max)
        };
        let motion = &self.run.motion;
        let ticks = [motion.distributed.get(joint), motion.central.get(joint)];
        let epochs = self
            .buses_with_joint(joint)
            .map(|(_, place, bus_figures)| bus_figures.lines.difference.get(place));
        ticks.into_iter().chain(epochs).any(|line| largest(line) >= step * 0.5)
    }

    /// Creates the figure of the torque on one joint, with the distributed minus the central torque below.
    fn torque_figure(&self, joint: usize) -> Figure {
        let name = self.joint_name(joint);
        let name =
            name.strip_prefix("joint ").map_or_else(|| name.clone(), |number| format!("Joint {number}"));
        let title =
            format!("{name}: sum of the cells' torques, and its difference from the central computation");
        let kind = self.run.skin.robot.joints.get(joint).map_or(JointKind::Revolute, |joint| joint.kind);
        let quantity = if kind == JointKind::Prismatic { "force" } else { "torque" };
        let unit = kind.torque_unit();
        let motion = &self.run.motion;
        let distributed =
            motion.distributed.get(joint).map(|line| self.thinned_series("sum of the cells' torques", line));
        let central =
            motion.central.get(joint).filter(|line| line.points().iter().any(|it| it.1.is_finite()));
        let central = central.map(|line| Series {
            shape: SeriesShape::Dashed,
            ..self.thinned_series("central computation", line)
        });
        let of_bus = |(_, place, bus_figures): (usize, usize, &BusFigures)| {
            let line = bus_figures.lines.difference.get(place)?;
            (line.point_count() > 0).then(|| self.thinned_series(self.bus_caption(bus_figures), line))
        };
        let series: Vec<_> = self.buses_with_joint(joint).filter_map(of_bus).collect();
        let figure = self
            .time_figure(format!("torque-joint{}", joint + 1), title, Axis::new(quantity, unit))
            .with_half_width()
            .with_series(distributed)
            .with_series(central);
        if series.is_empty() {
            return figure;
        }
        let step =
            self.buses_with_joint(joint).map(|(bus, ..)| self.torque_step_size(bus)).fold(0.0, f64::max);
        let marks = vec![MarkLine::at_y(step, "one step"), MarkLine::at_y(-step, "")];
        figure.with_lower_diagram(LowerDiagram { y: Axis::new("difference", unit), series, marks })
    }

    /// Returns a joint's name in the skin's file, with its number unless the name contains it.
    fn joint_name(&self, index: usize) -> String {
        let number = index + 1;
        match self.run.skin.robot.joints.get(index) {
            Some(joint) if joint.name != format!("joint{number}") => format!("{number} {}", joint.name),
            Some(_) | None => format!("joint {number}"),
        }
    }

    /// Returns the unit of the torques of all joints together: Nm, N, or both.
    pub(super) fn torque_unit(&self) -> &'static str {
        let slides = self.run.skin.robot.joints.iter().any(|joint| joint.kind == JointKind::Prismatic);
        if slides { "Nm or N" } else { JointKind::Revolute.torque_unit() }
    }

    /// Creates the table of torque errors by joint.
    fn error_table(&self) -> Option<Table> {
        let skin = &self.run.skin;
        let mut by_joint = vec![[TorqueErrors::default(); 2]; skin.robot.joints.len()];
        let mut accuracy = TorqueAccuracy::default();
        for (bus, bus_figures) in self.run.bus_figures.iter().enumerate() {
            let here = bus_figures.table.accuracy();
            let both = here.single_by_joint.iter().zip(&here.whole_by_joint);
            for ((joint, _), (single, whole)) in skin.joints_on_bus(bus).zip(both) {
                if let Some([sum, of_whole]) = by_joint.get_mut(joint) {
                    (*sum, *of_whole) = (sum.merged(*single), of_whole.merged(*whole));
                }
            }
            accuracy = accuracy.merged(here);
        }
        let single = by_joint.iter().map(|[single, whole]| (single, whole));
        let text = |errors: &TorqueErrors, unit: &str| {
            let [mean, max] = [errors.mean().unwrap_or(f64::NAN), errors.max()].map(without_rounding);
            [format_quantity(mean, unit), format_quantity(max, unit), errors.count().to_string()]
        };
        let row = |name: String, unit: &str, single: &TorqueErrors, whole: &TorqueErrors| {
            [name].into_iter().chain(text(single, unit)).chain(text(whole, unit)).collect::<Vec<_>>()
        };
        if accuracy.single.count() == 0 {
            return None;
        }
        let joints =
            single.zip(&skin.robot.joints).enumerate().map(|(joint, ((single, whole), described))| {
                row(self.joint_name(joint), described.kind.torque_unit(), single, whole)
            });
        let all = row("all".to_owned(), self.torque_unit(), &accuracy.single, &accuracy.whole);
        let [single, whole] =
            [paper::SINGLE_CELL_ERROR_NM, paper::SUMMED_ERROR_NM].map(|mean| format_quantity(mean, "Nm"));
        let papers = ["paper", &single, "", "", &whole, "", ""].map(str::to_owned).into();
        Some(Table::new(
            "Absolute torque errors by joint: of single cells that load the joint, and of the sum over the whole skin",
            ["", "single cells: mean", "max", "torques", "whole skin: mean", "max", "epochs"],
            joints.chain([all, papers]),
        ))
    }

    /// Creates the section on joint positions and torques over time, which corresponds to the paper's Fig. 7.
    pub(super) fn motion_section(&self) -> Section {
        let motion = &self.run.motion;
        let figures = self.joint_groups().into_iter().enumerate().flat_map(|(group, (kind, joints))| {
            let figure = |name: &str, title: &str, y: Axis, all: &[ThinnedLine]| {
                let of_joint =
                    |&joint: &usize| Some(self.thinned_series(self.joint_name(joint), all.get(joint)?));
                let name = if group == 0 { name.to_owned() } else { format!("{name}-{}", group + 1) };
                self.time_figure(name, title, y)
                    .with_series(joints.iter().filter_map(of_joint))
                    .with_marks(self.marks())
            };
            let (unit, speed) = (kind.unit(), format!("{}/s", kind.unit()));
            [
                figure("positions", "Joint positions", Axis::new("position", unit), &motion.position),
                figure("velocities", "Joint velocities", Axis::new("velocity", speed), &motion.velocity),
            ]
        });
        let no_velocity =
            self.missing_sentence("joint velocities, because joints frames contain only positions");
        let is_there = |figure: &Figure| no_velocity.is_none() || !figure.name.starts_with("velocities");
        let (still, figures): (Vec<_>, Vec<_>) = figures.filter(is_there).partition(has_only_zeros);
        let mut section = Section::new("motion", "The arm")
            .with_figures(figures.into_iter().filter_map(without_empty_series));
        section.text.extend(no_velocity);
        if still.is_empty() {
            section
        } else {
            section.with_paragraph("Quantities that are not drawn were 0 throughout.")
        }
    }

    /// Groups the joints that share a figure. A group has joints of one kind (revolute or prismatic) that a chain has
    /// and the chains before it do not, at most one for each colour.
    fn joint_groups(&self) -> Vec<(JointKind, Vec<usize>)> {
        let robot = &self.run.skin.robot;
        let mut rest: Vec<_> = (0..robot.joints.len()).collect();
        let mut groups = Vec::new();
        for chain in &robot.chains {
            for kind in [JointKind::Prismatic, JointKind::Revolute] {
                let is_in = |joint: &mut usize| {
                    chain.joints.contains(joint) && robot.joints.get(*joint).is_some_and(|it| it.kind == kind)
                };
                let joints: Vec<_> = rest.extract_if(.., is_in).collect();
                groups.extend(joints.chunks(Figure::COLOUR_COUNT).map(|joints| (kind, joints.to_vec())));
            }
        }
        groups
    }

    pub(super) fn cells_section(&self) -> Section {
        let motion = &self.run.motion;
        let is_known = motion.active.point_count() > 0 && !self.lacks_forces();
        let active = if is_known { self.points(&motion.active) } else { Vec::new() };
        let title = "Active cells: cells in the torque sum, and cells in contact";
        let figure = self
            .time_figure("active-cells", title, Axis::new("cells", ""))
            .draw_series("in the torque sum", SeriesShape::Steps, self.points(&motion.contributing))
            .draw_series("in contact, according to the central computation", SeriesShape::Steps, active)
            .with_marks(self.marks());
        let mut section = Section::new("cells", "Active cells");
        section.text.extend(
            self.missing_sentence(
                "the stimuli or sensors of all cells, which show which cells are in contact",
            )
            .filter(|_| !is_known),
        );
        if has_only_zeros(&figure) {
            let none =
                if is_known || self.run.frames_only.is_none() { "was in contact" } else { "sent a torque" };
            section.with_paragraph(format!("No cell {none}."))
        } else {
            section.with_figures(without_empty_series(figure))
        }
    }

    /// Creates the section on cycle times, which corresponds to the paper's Fig. 8.
    pub(super) fn cycle_section(&self) -> Section {
        let motion = &self.run.motion;
        let lacks = "the durations of ticks and of the central computation, and the lateness of ticks";
        if let Some(lacks) = self.missing_sentence(lacks) {
            return Section::new("cycle", "Cycle times").with_paragraph(lacks);
        }
        let figure = |name: &str, title: &str, series: &[(&str, &ThinnedLine)]| {
            let series = series.iter().map(|(caption, thinned)| self.thinned_series(*caption, thinned));
            self.time_figure(name, title, Axis::new("time", "µs").with_log_scale())
                .with_series(series)
                .with_marks(self.marks())
        };
        let took = [("tick", &motion.took.line), ("central computation", &motion.central_took.line)];
        let figures = [
            figure("cycle", "Duration of each tick, and of its central computation", &took),
            figure("lateness", "Lateness of each tick", &[("", &motion.late.line)]),
        ];
        let rows = [
            ("lateness of a tick", &motion.late.times),
            ("duration of a tick", &motion.took.times),
            ("central computation in a tick", &motion.central_took.times),
            ("duration of a tick without central computation", &motion.plain),
        ];
        let rows = rows.into_iter().map(|(name, times)| (name, times.histogram()));
        let row = |(name, histogram): (&str, &Histogram<u64>)| {
            let Quantiles { p50, p90, p99, max, count } = Quantiles::from_histogram(histogram, 1e-3);
            let values = [p50, p90, p99, max].map(|micros| format_quantity(micros, "µs"));
            [name.to_owned()].into_iter().chain(values).chain([count.to_string()]).collect::<Vec<_>>()
        };
        let mut rows: Vec<_> = rows.filter(|(_, histogram)| !histogram.is_empty()).map(row).collect();
        let idle = ["idle_late_p50_us", "idle_late_p99_us", "idle_late_max_us"]
            .map(|key| self.run.metadata_value("machine", key));
        if let [Some(p50), Some(p99), Some(max)] = idle {
            let [p50, p99, max] = [p50, p99, max].map(format_micros);
            let name = "lateness of a wake-up on the idle machine".to_owned();
            rows.push(vec![name, p50, String::new(), p99, max, String::new()]);
        }
        let head = ["", "median", "90 %", "99 %", "max", "values"];
        Section::new("cycle", "Cycle times")
            .with_paragraph(
                "The distributed computation takes no time in a tick: the sum is updated as replies arrive.",
            )
            .with_figures(figures.into_iter().filter_map(without_empty_series))
            .with_tables([Table::new("The control loop", head, rows)])
    }
}

/// Returns true if all values of a figure are 0.
fn has_only_zeros(figure: &Figure) -> bool {
    figure.series.iter().flat_map(|series| &series.points).all(|(_, y)| y.abs() < 1e-9 || !y.is_finite())
}
