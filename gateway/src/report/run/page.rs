//! What a run's report says, and in which order.

use protocol::packet::WORDS;

use super::Run;
use super::lane::Lane;
use crate::report::figure::{
    Axis, Figure, Finding, Mark, On, Page, Quantity, Section, Series, Shape, Size, Table, number,
};
use crate::report::thin::{Binned, Thinned};
use crate::summary::Quantiles;
use crate::table::{Errors, Event, Uplink};

/// The paper's mean absolute errors of single torques in Q3.12, and of sums in Q7.8, in Nm.
const PAPER_SINGLE_NM: f64 = 0.0054;
const PAPER_SUMS_NM: f64 = 0.0356;
/// The paper's cells, control loop and broadcasts.
const PAPER_CELLS: f64 = 253.0;
const PAPER_CONTROL_HZ: f64 = 500.0;
const PAPER_BROADCAST_HZ: f64 = 62.5;
/// The paper's law of the central computation (Eq. 29 and 30), in µs: of each active cell, of each cell, of none.
const PAPER_CENTRAL_US: [f64; 3] = [0.798, 0.827, 10.7];

/// Cells in the table of the worst.
const WORST: usize = 12;

/// What a page is made of.
struct Draft<'a> {
    run: &'a Run,
    /// When the loop began, in s after the recording's first message.
    zero: f64,
}

pub(super) fn page(run: &Run, command: &str, missing: Option<&str>) -> Page {
    let draft = Draft { run, zero: run.motion.first.unwrap_or(0.0) };
    let (skin, motion) = (&run.skin, &run.motion);
    let seconds = number((motion.seconds() * 100.0).round() / 100.0);
    let mut intro = format!(
        "A run of {} with {} cells on {} and {seconds} s of its {} Hz control loop, from the recording {}. \
         Times count from the first tick.",
        skin.name,
        skin.cells.len(),
        several(skin.buses.len(), "bus", "buses"),
        number(skin.timing.control_hz),
        run.name,
    );
    if let Some(missing) = missing {
        intro = format!("Not all of the run is here: {missing}. {intro}");
    }
    let mut sections = vec![draft.summary()];
    if motion.ticks > 0 {
        sections.extend([draft.torque(), draft.motion(), draft.cells(), draft.cycle()]);
    }
    sections.extend([draft.replies(), draft.load(), draft.losses()]);
    Page { title: format!("{}: report on a run", skin.name), intro, facts: facts(run, command), sections }
}

impl Draft<'_> {
    fn points(&self, thinned: &Thinned) -> Vec<(f64, f64)> {
        thinned.points().into_iter().map(|(x, y)| (x - self.zero, y)).collect()
    }

    fn line(&self, label: impl Into<String>, thinned: &Thinned) -> Series {
        Series::new(label, Shape::Line, self.points(thinned))
    }

    fn time(&self) -> Axis {
        let axis = Axis::new("time", "s");
        if self.run.motion.ticks > 1 { axis.between(0.0, self.run.motion.seconds()) } else { axis }
    }

    fn marks(&self) -> Vec<Mark> {
        let mark = |(at, what): &(f64, &'static str)| Mark {
            on: On::X,
            at: at - self.zero,
            label: (*what).to_owned(),
        };
        self.run.motion.turns.iter().map(mark).collect()
    }

    /// All numbers that the paper has too, and what must hold.
    fn summary(&self) -> Section {
        let (skin, motion) = (&self.run.skin, &self.run.motion);
        let mut findings = Vec::new();
        let accuracy =
            self.run.lanes.iter().map(|lane| lane.table.accuracy()).reduce(crate::table::Accuracy::with);
        let accuracy = accuracy.unwrap_or_default();
        let nm = |value| Quantity::new(value, "Nm");
        for (what, paper, errors) in [
            ("torques of single cells, loaded joints: mean absolute error", PAPER_SINGLE_NM, accuracy.single),
            ("the whole skin's torque, all joints: mean absolute error", PAPER_SUMS_NM, accuracy.whole),
            ("sums along the tree, loaded joints: mean absolute error", PAPER_SUMS_NM, accuracy.sums),
        ] {
            if let Some(mean) = errors.mean() {
                findings.push(Finding::less_is_better(what, nm(paper), nm(mean)));
            }
        }
        if !motion.central_ns.is_empty() {
            let median = motion.central_ns.value_at_quantile(0.5) as f64 * 1e-3;
            let (active, ticks) = motion.active_sum;
            let active = active as f64 / ticks.max(1) as f64;
            let [of_active, of_each, of_none] = PAPER_CENTRAL_US;
            let law = of_active * active + of_each * skin.cells.len() as f64 + of_none;
            let what = format!(
                "central computation in a tick, median (paper: its law at these {} cells, {} of them active on average)",
                skin.cells.len(),
                number((active * 10.0).round() / 10.0)
            );
            findings.push(Finding::less_is_better(
                what,
                Quantity::new(law, "µs"),
                Quantity::new(median, "µs"),
            ));
        }
        let cells = Quantity::new(skin.cells.len() as f64, "");
        findings.push(Finding::told("cells", cells).beside(Quantity::new(PAPER_CELLS, "")));
        if motion.seconds() > 0.0 {
            let hertz = |count: u64| Quantity::new(count.saturating_sub(1) as f64 / motion.seconds(), "Hz");
            let ticks = motion.ticks + motion.unrecorded;
            findings.push(
                Finding::told("control loop", hertz(ticks)).beside(Quantity::new(PAPER_CONTROL_HZ, "Hz")),
            );
            let epochs = self.run.lanes.iter().map(|lane| lane.table.counters().epochs).max().unwrap_or(0);
            findings
                .push(Finding::told("joints", hertz(epochs)).beside(Quantity::new(PAPER_BROADCAST_HZ, "Hz")));
            let none = motion.skipped == 0;
            findings.push(Finding::told("ticks skipped", count(motion.skipped)).must("none", none));
        }
        let accounts = self.run.lanes.iter().map(Lane::account);
        let (due, in_time) = accounts.fold((0, 0), |sum, one| (sum.0 + one.due, sum.1 + one.in_time));
        if due > 0 {
            let what = format!("replies not there before the next joints, of {due} that were due");
            findings.push(Finding::told(what, count(due - in_time)).must("none", in_time == due));
        }
        for lane in &self.run.lanes {
            let greatest = lane.load.rates().into_iter().map(|(_, part)| part * 100.0).fold(0.0, f64::max);
            let what = format!("{}: greatest load of a real bus at {}", lane.name, lane.rates);
            findings.push(
                Finding::told(what, Quantity::new(greatest, "%")).must("below 100 %", greatest < 100.0),
            );
        }
        let uplink =
            Uplink::total(self.run.lanes.iter().flat_map(|lane| lane.table.cells()).map(|cell| cell.uplink));
        findings.push(
            Finding::told("packets of cells lost, by their own count", count(uplink.lost))
                .must("none", uplink.lost == 0),
        );
        let text = vec![
            "Beside the paper's numbers (Efficient Distributed Torque Computation for Large Scale Robot Skin). Within \
             5 % of the paper's, a number is the same."
                .to_owned(),
        ];
        Section {
            name: "summary".to_owned(),
            title: "In numbers".to_owned(),
            text,
            findings,
            ..Section::default()
        }
    }

    /// The paper's Fig. 6.
    fn torque(&self) -> Section {
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
            figures.push(Figure {
                name: "torque-error".to_owned(),
                title: "Mean absolute error of an epoch that all cells answered in time".to_owned(),
                size: Size::Wide,
                x: self.time(),
                y: Axis::new("error", "Nm").log(),
                series: errors.iter().map(|lane| self.line(self.named(lane), &lane.error)).collect(),
                marks: vec![
                    Mark { on: On::Y, at: PAPER_SINGLE_NM, label: "paper, Q3.12: 0.0054 Nm".to_owned() },
                    Mark { on: On::Y, at: PAPER_SUMS_NM, label: "paper, Q7.8: 0.0356 Nm".to_owned() },
                ],
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
        let accuracy =
            self.run.lanes.iter().map(|lane| lane.table.accuracy()).reduce(crate::table::Accuracy::with)?;
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
            number(PAPER_SINGLE_NM),
            String::new(),
            String::new(),
            number(PAPER_SUMS_NM),
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
    fn motion(&self) -> Section {
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

    fn cells(&self) -> Section {
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
    fn cycle(&self) -> Section {
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

    fn named(&self, lane: &Lane) -> String {
        if self.run.lanes.len() > 1 { lane.name.clone() } else { String::new() }
    }

    fn replies(&self) -> Section {
        let mut figures = Vec::new();
        for lane in self.run.lanes.iter().filter(|lane| lane.account().due > 0) {
            let name = &lane.name;
            let steps =
                |label: &str, thinned: &Thinned| Series::new(label, Shape::Steps, self.points(thinned));
            let unit = if lane.sums { "cells in sums" } else { "replies" };
            figures.push(Figure {
                name: format!("replies-{name}"),
                title: format!("{name}: {unit} due and in time, epoch by epoch"),
                size: Size::Half,
                x: self.time(),
                y: Axis::new(unit, ""),
                series: vec![steps("due", &lane.due), steps("in time", &lane.in_time)],
                marks: Vec::new(),
            });
            let lost = lane.account().late + lane.account().missing;
            let y = Axis::new(unit, "");
            figures.push(Figure {
                name: format!("late-{name}"),
                title: format!("{name}: {unit} late and missing, when that was settled"),
                size: Size::Half,
                x: self.time(),
                y: if lost == 0 { y.between(0.0, 1.0) } else { y },
                series: vec![steps("late", &lane.late), steps("missing", &lane.missing)],
                marks: Vec::new(),
            });
            figures.push(Figure {
                name: format!("slowest-{name}"),
                title: format!("{name}: from joints to the last reply for them, epoch by epoch"),
                size: Size::Wide,
                x: self.time(),
                y: Axis::new("time", "ms"),
                series: vec![self.line("", &lane.slowest)],
                marks: Vec::new(),
            });
        }
        Section {
            name: "replies".to_owned(),
            title: "Replies".to_owned(),
            text: vec![
                "A reply is due from every cell that is configured, awake and in contact; it is in time before the next \
                 joints, late within three more."
                    .to_owned(),
            ],
            figures,
            tables: vec![self.accounts(), self.worst()],
            ..Section::default()
        }
    }

    fn accounts(&self) -> Table {
        let row = |lane: &Lane| {
            let account = lane.account();
            let counters = lane.table.counters();
            let reply = Quantiles::of(lane.table.last_reply(), 1.0);
            let numbers = [
                account.due,
                account.in_time,
                account.late,
                account.missing,
                counters.epochs_due,
                counters.epochs_complete,
            ];
            let numbers = numbers.map(|count| count.to_string());
            let times = [reply.p50, reply.p99, reply.max].map(|micros| number(micros * 1e-3));
            [lane.name.clone()].into_iter().chain(numbers).chain(times).collect::<Vec<_>>()
        };
        let head = [
            "bus",
            "due",
            "in time",
            "late",
            "missing",
            "epochs due",
            "complete",
            "last reply, ms: median",
            "99 %",
            "greatest",
        ];
        Table {
            title: "Replies by bus".to_owned(),
            head: head.map(str::to_owned).into(),
            rows: self.run.lanes.iter().map(row).collect(),
        }
    }

    /// Cells by what went wrong with them, and then by how slow they were.
    fn worst(&self) -> Table {
        let cells = self.run.lanes.iter().enumerate().flat_map(|(bus, lane)| {
            let described = self.run.skin.cells_of(bus);
            lane.table
                .cells()
                .iter()
                .zip(described)
                .zip(&lane.latency)
                .map(move |((cell, described), latency)| (lane, cell, described.joint, latency))
        });
        let mut cells: Vec<_> = cells.collect();
        cells.sort_by_key(|(_, cell, _, latency)| {
            let (replies, uplink) = (&cell.replies, &cell.uplink);
            std::cmp::Reverse((
                replies.missing + replies.late,
                uplink.lost,
                uplink.restarts,
                latency.greatest,
            ))
        });
        let row = |(lane, cell, joint, latency): &(&Lane, &crate::table::Cell, u8, &super::lane::Latency)| {
            let mean =
                if latency.count == 0 { f64::NAN } else { latency.sum as f64 / latency.count as f64 * 1e-3 };
            let slowest = if latency.count == 0 { f64::NAN } else { latency.greatest as f64 * 1e-3 };
            let replies = &cell.replies;
            let counts = [replies.due, replies.in_time, replies.late, replies.missing, cell.uplink.lost];
            let counts = counts.map(|count| count.to_string());
            [format!("{} {}", lane.name, cell.node), joint.to_string()]
                .into_iter()
                .chain(counts)
                .chain([cell.uplink.restarts.to_string(), number(mean), number(slowest)])
                .collect::<Vec<_>>()
        };
        let rows: Vec<_> = cells.iter().take(WORST).map(row).collect();
        let head = [
            "cell",
            "joint",
            "due",
            "in time",
            "late",
            "missing",
            "packets lost",
            "restarts",
            "reply, ms: mean",
            "greatest",
        ];
        let of = self.run.skin.cells.len();
        let title =
            if rows.len() < of { format!("The {WORST} worst of {of} cells") } else { "All cells".to_owned() };
        Table {
            title: format!("{title}: by replies late or missing, then losses, then the slowest reply"),
            head: head.map(str::to_owned).into(),
            rows,
        }
    }

    /// What a real bus would carry.
    fn load(&self) -> Section {
        let percent = |binned: &Binned| {
            let rates = binned.rates().into_iter();
            rates.map(|(x, part)| (x - self.zero, part * 100.0)).collect::<Vec<_>>()
        };
        let figure = |lane: &Lane| Figure {
            name: format!("load-{}", lane.name),
            title: format!(
                "{}: load of a real bus at {}, over {} s each",
                lane.name,
                lane.rates,
                number(lane.load.width())
            ),
            size: Size::Wide,
            x: self.time(),
            y: Axis::new("load", "%"),
            series: vec![
                Series::new("what a real bus would carry", Shape::Steps, percent(&lane.load)),
                Series::new(
                    "with stimuli and simulated wires",
                    Shape::Dashed,
                    stairs(&percent(&lane.load_of_all)),
                ),
            ],
            marks: vec![Mark { on: On::Y, at: 100.0, label: "all that it can".to_owned() }],
        };
        Section {
            name: "load".to_owned(),
            title: "Load of the buses".to_owned(),
            text: vec![
                "Here a frame took no time. On a real bus it takes that of its bits: counted with the stuff bits that its \
                 own bits make. Stimuli and simulated wires exist on a bench only."
                    .to_owned(),
            ],
            figures: self.run.lanes.iter().map(figure).collect(),
            ..Section::default()
        }
    }

    fn losses(&self) -> Section {
        let (run, motion) = (self.run, &self.run.motion);
        let mut rows: Vec<Vec<String>> = Vec::new();
        let mut row = |what: String, count: u64, always: bool| {
            if always || count > 0 {
                rows.push(vec![what, count.to_string()]);
            }
        };
        row("ticks skipped by the loop".to_owned(), motion.skipped, true);
        row("ticks that happened and are not in the recording".to_owned(), motion.unrecorded, true);
        row("bad cycles".to_owned(), motion.bad, false);
        row("ticks while the robot was halted".to_owned(), motion.halted, false);
        row("ticks whose velocity was not finite".to_owned(), motion.refused, false);
        for lane in &run.lanes {
            let name = &lane.name;
            let uplink = Uplink::total(lane.table.cells().iter().map(|cell| cell.uplink));
            row(format!("{name}: frames recorded"), lane.frames, true);
            row(
                format!("{name}: frames that are not in the recording, by its own notes"),
                lane.dropped,
                true,
            );
            row(format!("{name}: packets that cells sent, by their own count"), uplink.sent, true);
            row(format!("{name}: of these lost"), uplink.lost, true);
            row(format!("{name}: of these refused"), uplink.rejected, false);
            row(format!("{name}: starts of cells while it ran"), u64::from(uplink.restarts), false);
            for event in Event::ALL {
                row(format!("{name}: {}", event.name()), lane.table.counters().events(event), false);
            }
        }
        row("packets of any network in the kernel's backlog".to_owned(), run.backlog, false);
        row("frames of buses that the skin does not have".to_owned(), run.others, false);
        row("messages that cannot be read".to_owned(), run.unreadable, false);
        let table = Table { title: String::new(), head: vec!["what".to_owned(), "count".to_owned()], rows };
        Section {
            name: "losses".to_owned(),
            title: "Losses".to_owned(),
            text: vec!["What can be lost and was not has a 0; other rows are there only when there is something to say.".to_owned()],
            tables: vec![table],
            ..Section::default()
        }
    }
}

/// A line that holds each value until the next one.
fn stairs(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let held = points.windows(2).filter_map(|pair| Some((pair.get(1)?.0, pair.first()?.1)));
    let mut stairs: Vec<_> = points.iter().copied().zip(held).flat_map(|(from, to)| [from, to]).collect();
    stairs.extend(points.last());
    stairs
}

fn count(count: u64) -> Quantity {
    Quantity::new(count as f64, "")
}

fn several(count: usize, one: &str, more: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { more })
}

/// What it came about with.
fn facts(run: &Run, command: &str) -> Vec<(String, String)> {
    let fact = |record: &str, key: &str| run.fact(record, key).unwrap_or("unknown").to_owned();
    let machine = format!(
        "{} {} on {}, {} processors",
        fact("machine", "sysname"),
        fact("machine", "release"),
        fact("machine", "machine"),
        fact("machine", "processors")
    );
    let mut facts = vec![
        ("run's command".to_owned(), fact("program", "command_line")),
        (
            "program".to_owned(),
            format!("{}, revision {}", fact("program", "program"), fact("program", "git_revision")),
        ),
        ("began".to_owned(), fact("program", "began_ns").parse().map_or_else(|_| "unknown".to_owned(), utc)),
        ("machine".to_owned(), machine),
        (
            "clock".to_owned(),
            format!(
                "{}, of {}; wall clock in steps of {} ns",
                fact("machine", "clocksource"),
                fact("machine", "clocksources"),
                fact("machine", "realtime_resolution_ns")
            ),
        ),
        (
            "recording".to_owned(),
            format!("{}, part {}, {} bytes", run.name, fact("part", "number"), run.bytes),
        ),
        ("report's command".to_owned(), command.to_owned()),
    ];
    if let Some(idle) = run.fact("machine", "idle_late_p50_us") {
        let (p99, max) = (fact("machine", "idle_late_p99_us"), fact("machine", "idle_late_max_us"));
        let text = format!("woke a thread {idle} µs late (median), 99 % within {p99} µs, at most {max} µs");
        facts.insert(5, ("idle machine".to_owned(), text));
    }
    let configuration = run.metadata.iter().find(|(name, _)| name == "configuration");
    let pairs = configuration
        .map(|(_, facts)| facts.iter().map(|(key, value)| format!("{key} = {value}")).collect::<Vec<_>>());
    facts.extend(pairs.map(|pairs| ("configuration".to_owned(), pairs.join("; "))));
    facts
}

/// A time in ns since 1970 as people write it (Hinnant's `civil_from_days`).
fn utc(nanos: u64) -> String {
    let seconds = nanos / 1_000_000_000;
    let (days, second) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let (day, month) = (day - (153 * month + 2) / 5 + 1, if month < 10 { month + 3 } else { month - 9 });
    let year = year + era * 400 + u64::from(month <= 2);
    let (hour, minute, second) = (second / 3_600, second / 60 % 60, second % 60);
    format!("{year}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02} UTC")
}
