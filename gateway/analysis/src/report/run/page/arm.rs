//! What the ticks and the cells' torques come to.

use hdrhistogram::Histogram;

use super::Draft;
use crate::paper;
use crate::report::figure::{Axis, Figure, Mark, Section, Shape, Table, number};
use crate::report::thin::Thinned;
use model::quantiles::Quantiles;
use model::table::{Accuracy, Errors};
use protocol::skin::JointKind;

impl Draft<'_> {
    /// The paper's Fig. 6.
    pub(super) fn torque(&self) -> Section {
        let motion = &self.run.motion;
        let pairs = motion.distributed.iter().zip(&motion.central).enumerate();
        let figures = pairs.map(|(joint, (distributed, central))| {
            let name = self.joint(joint);
            let name =
                name.strip_prefix("joint ").map_or_else(|| name.clone(), |number| format!("Joint {number}"));
            let title = format!("{name}: sum of the cells' torques, and the central computation");
            let axis = match self.run.skin.robot.joints.get(joint).map(|joint| joint.kind) {
                Some(kind @ JointKind::Prismatic) => Axis::new("force", kind.torque_unit()),
                Some(JointKind::Revolute) | None => Axis::new("torque", JointKind::Revolute.torque_unit()),
            };
            self.figure(format!("torque-joint{}", joint + 1), title, axis)
                .half()
                .series([self.line("distributed", distributed)])
                .draw("central", Shape::Dashed, self.points(central))
        });
        let errors: Vec<_> =
            self.run.bus_figures.iter().filter(|bus_figures| bus_figures.lines.error.count() > 0).collect();
        let error = (!errors.is_empty()).then(|| {
            let papers = |format: &str, mean| Mark::y(mean, format!("paper, {format}: {} Nm", number(mean)));
            let title = "Mean absolute error of an epoch that all cells answered in time";
            self.figure("torque-error", title, Axis::new("error", "Nm").log())
                .series(
                    errors
                        .iter()
                        .map(|bus_figures| self.line(self.named(bus_figures), &bus_figures.lines.error)),
                )
                .marks([papers("Q3.12", paper::SINGLE_NM), papers("Q7.8", paper::SUMMED_NM)])
        });
        let mut section = Section::new("torque", "Distributed and central torque").text(
            "The curves hold what has come at each tick: while a touch changes they differ by what is on its way. The \
             errors below compare like with like: each torque with the central computation for the joints that it answers.",
        );
        if let Some(advice) = self.advice() {
            section = section.text(advice);
        }
        section.figures(figures.chain(error)).tables(self.errors()).tables(self.formats())
    }

    /// A joint as the skin's file names it; with its number where that is no part of the name.
    fn joint(&self, index: usize) -> String {
        let number = index + 1;
        match self.run.skin.robot.joints.get(index) {
            Some(joint) if joint.name != format!("joint{number}") => format!("{number} {}", joint.name),
            Some(_) | None => format!("joint {number}"),
        }
    }

    /// Errors joint by joint.
    fn errors(&self) -> Option<Table> {
        let skin = &self.run.skin;
        let mut by_joint = vec![[Errors::default(); 2]; skin.robot.joints.len()];
        let mut accuracy = Accuracy::default();
        for (bus, bus_figures) in self.run.bus_figures.iter().enumerate() {
            let here = bus_figures.table.accuracy();
            let both = here.single_by_joint.iter().zip(&here.whole_by_joint);
            for ((joint, _), (single, whole)) in skin.joints_of(bus).zip(both) {
                if let Some([sum, of_whole]) = by_joint.get_mut(joint) {
                    (*sum, *of_whole) = (sum.with(*single), of_whole.with(*whole));
                }
            }
            accuracy = accuracy.with(here);
        }
        let single = by_joint.iter().map(|[single, whole]| (single, whole));
        let text = |errors: &Errors| {
            let mean = number(errors.mean().unwrap_or(f64::NAN));
            [mean, number(errors.max()), errors.count().to_string()]
        };
        let row = |name: String, single: &Errors, whole: &Errors| {
            [name].into_iter().chain(text(single)).chain(text(whole)).collect::<Vec<_>>()
        };
        if accuracy.single.count() == 0 {
            return None;
        }
        let joints = single.enumerate().map(|(joint, (single, whole))| row(self.joint(joint), single, whole));
        let all = row("all".to_owned(), &accuracy.single, &accuracy.whole);
        let [single, whole] = [paper::SINGLE_NM, paper::SUMMED_NM].map(number);
        let slides = skin.robot.joints.iter().any(|joint| joint.kind == JointKind::Prismatic);
        let slides = if slides { " (N where the joint slides)" } else { "" };
        let papers = ["paper", &single, "", "", &whole, "", ""].map(str::to_owned).into();
        Some(Table::new(
            format!(
                "Absolute errors in Nm{slides}, joint by joint: single cells where the joint carries them, and the whole skin's sum"
            ),
            ["", "single cells: mean", "max", "torques", "whole skin: mean", "max", "epochs"],
            joints.chain([all, papers]),
        ))
    }

    /// The paper's Fig. 7, and the positions.
    pub(super) fn motion(&self) -> Section {
        let motion = &self.run.motion;
        let figures = self.groups().into_iter().enumerate().flat_map(|(group, (kind, joints))| {
            let figure = |name: &str, title: &str, y: Axis, all: &[Thinned]| {
                let of_joint = |&joint: &usize| Some(self.line(self.joint(joint), all.get(joint)?));
                let name = if group == 0 { name.to_owned() } else { format!("{name}-{}", group + 1) };
                self.figure(name, title, y).series(joints.iter().filter_map(of_joint)).marks(self.marks())
            };
            let (unit, speed) = (kind.unit(), format!("{}/s", kind.unit()));
            [
                figure("positions", "Joint positions", Axis::new("position", unit), &motion.position),
                figure("velocities", "Joint velocities", Axis::new("velocity", speed), &motion.velocity),
            ]
        });
        Section::new("motion", "The arm").figures(figures)
    }

    /// Joints that share a figure: those of one kind that a chain adds to the chains before it.
    fn groups(&self) -> Vec<(JointKind, Vec<usize>)> {
        let robot = &self.run.skin.robot;
        let mut rest: Vec<_> = (0..robot.joints.len()).collect();
        let mut groups = Vec::new();
        for chain in &robot.chains {
            for kind in [JointKind::Prismatic, JointKind::Revolute] {
                let is_in = |joint: &mut usize| {
                    chain.joints.contains(joint) && robot.joints.get(*joint).is_some_and(|it| it.kind == kind)
                };
                let joints: Vec<_> = rest.extract_if(.., is_in).collect();
                groups.extend(joints.chunks(Figure::COLOURS).map(|joints| (kind, joints.to_vec())));
            }
        }
        groups
    }

    pub(super) fn cells(&self) -> Section {
        let motion = &self.run.motion;
        let title = "Active cells: those whose torque is in the sum, and those that are in contact";
        let figure = self
            .figure("active-cells", title, Axis::new("cells", ""))
            .draw("in the torque", Shape::Steps, self.points(&motion.contributing))
            .draw("in contact, by the central computation", Shape::Steps, self.points(&motion.active))
            .marks(self.marks());
        Section::new("cells", "Active cells").figures([figure])
    }

    /// The paper's Fig. 8.
    pub(super) fn cycle(&self) -> Section {
        let motion = &self.run.motion;
        let figure = |name: &str, title: &str, series: &[(&str, &Thinned)]| {
            let series = series.iter().map(|(caption, thinned)| self.line(*caption, thinned));
            self.figure(name, title, Axis::new("time", "µs").log()).series(series).marks(self.marks())
        };
        let took = [("tick", &motion.took.line), ("central computation in it", &motion.central_took.line)];
        let figures = [
            figure("cycle", "How long each tick took, and the central computation in it", &took),
            figure("lateness", "How late each tick began", &[("", &motion.late.line)]),
        ];
        let rows = [
            ("tick began late", &motion.late.times),
            ("tick took", &motion.took.times),
            ("central computation in it", &motion.central_took.times),
            ("tick without central computation", &motion.plain),
        ];
        let rows = rows.into_iter().map(|(name, times)| (name, times.histogram()));
        let row = |(name, histogram): (&str, &Histogram<u64>)| {
            let Quantiles { p50, p90, p99, max, count } = Quantiles::of(histogram, 1e-3);
            let values = [p50, p90, p99, max].map(number);
            [name.to_owned()].into_iter().chain(values).chain([count.to_string()]).collect::<Vec<_>>()
        };
        let mut rows: Vec<_> = rows.filter(|(_, histogram)| !histogram.is_empty()).map(row).collect();
        let idle = ["idle_late_p50_us", "idle_late_p99_us", "idle_late_max_us"]
            .map(|key| self.run.fact("machine", key));
        if let [Some(p50), Some(p99), Some(max)] = idle {
            let cells = ["the idle machine's thread woke late", p50, "", p99, max, ""];
            rows.push(cells.map(str::to_owned).into());
        }
        let head = ["µs", "median", "90 %", "99 %", "max", "values"];
        Section::new("cycle", "Cycle times")
            .text("The distributed computation has no part in a tick: the sum is kept while replies come.")
            .figures(figures)
            .tables([Table::new("The control loop", head, rows)])
    }
}
