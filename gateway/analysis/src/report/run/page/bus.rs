//! What became of the cells' replies and packets, and what a real bus would carry.

use super::super::lane::{Lane, Latency};
use super::Draft;
use crate::fit::verdict::{Answer, percent};
use crate::report::figure::{
    Axis, Figure, Finding, Mark, On, Quantity, Section, Series, Shape, Size, Table, number,
};
use crate::report::thin::{Binned, Thinned};
use crate::shadow::BusShadow;
use model::quantiles::Quantiles;
use model::table::{Cell, Event, Uplink};

/// Cells in the table of the worst.
const WORST: usize = 12;

impl Draft<'_> {
    pub(super) fn replies(&self) -> Section {
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
        let row = |(lane, cell, joint, latency): &(&Lane, &Cell, u8, &Latency)| {
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

    /// A load in % from the first tick on: before it cells start, all at once.
    pub(super) fn percent(&self, binned: &Binned) -> Vec<(f64, f64)> {
        let rates = binned.rates().into_iter().map(|(x, part)| (x - self.zero, part * 100.0));
        rates.filter(|(x, _)| *x >= 0.0).collect()
    }

    /// What a real bus would have made of each bus that had frames.
    fn shadows(&self) -> impl Iterator<Item = BusShadow> {
        let buses = self.run.shadow.report().buses;
        buses.into_iter().filter(|bus| self.run.skin.bus_named(&bus.bus).is_some())
    }

    /// Whether real buses would carry it: in this run, and at most. Only rates that somebody chose are judged.
    pub(super) fn fits(&self) -> Vec<Finding> {
        let mut findings = Vec::new();
        for bus in self.shadows() {
            let lane = self.run.lanes.iter().find(|lane| lane.name == bus.bus);
            let is_chosen = lane.is_some_and(|lane| lane.rates.is_chosen);
            for answer in bus.this_run.iter().chain(&bus.worst_case) {
                let Answer { load, rates, cells, verdict } = answer;
                let what = format!("{} at {rates}, {}: {verdict} ({cells})", bus.bus, answer.case());
                let finding = Finding::told(what, Quantity::new(tenths(100.0 * load), "%"));
                findings.push(if is_chosen {
                    finding.must("within all limits", verdict.fits())
                } else {
                    finding
                });
            }
        }
        findings
    }

    /// What a real bus would carry.
    pub(super) fn load(&self) -> Section {
        let figure = |lane: &Lane| Figure {
            name: format!("load-{}", lane.name),
            title: format!(
                "{}: load of a real bus at {}, over {} s each",
                lane.name,
                lane.rates.rates,
                number(lane.load.width())
            ),
            size: Size::Wide,
            x: self.time(),
            y: Axis::new("load", "%"),
            series: vec![
                Series::new("what a real bus would carry", Shape::Steps, self.percent(&lane.load)),
                Series::new(
                    "with what only a bench sends",
                    Shape::Dashed,
                    stairs(&self.percent(&lane.load_of_all)),
                ),
            ],
            marks: vec![Mark { on: On::Y, at: 100.0, label: "all that it can".to_owned() }],
        };
        let text = "Here a frame took no time. On a real bus it takes that of its bits: counted with the stuff bits that its \
                    own bits make. This run is judged by the second in which most is asked of the bus; in the worst case all cells \
                    answer, with the longest frames there can be. Stimuli, sync and report with their answers and simulated \
                    wires exist on a bench only and are left out. Start-up, before the first joints, stands apart.";
        let assumed = self.run.lanes.iter().any(|lane| !lane.rates.is_chosen);
        let assumed = assumed.then(|| {
            "The skin has no bit rates for every bus, so common ones are shown, for information.".to_owned()
        });
        Section {
            name: "load".to_owned(),
            title: "Load of the buses".to_owned(),
            text: [text.to_owned()].into_iter().chain(assumed).collect(),
            figures: self.run.lanes.iter().map(figure).collect(),
            tables: self.shadows().map(|bus| carried(&bus)).collect(),
            ..Section::default()
        }
    }

    pub(super) fn losses(&self) -> Section {
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

/// What a bus would carry in operation and in start-up.
fn carried(bus: &BusShadow) -> Table {
    let share = |share: Option<f64>| share.map_or_else(|| "?".to_owned(), percent);
    let mut rows: Vec<Vec<String>> = Vec::new();
    let mut row = |cells: [&str; 6]| rows.push(cells.map(str::to_owned).into());
    if let Some(worst) = &bus.worst_case {
        let (verdict, load, cells) =
            (worst.verdict.to_string(), percent(worst.load), worst.cells.to_string());
        row([worst.case(), &verdict, &load, "", "", &cells]);
    }
    if let Some(run) = &bus.this_run {
        let mean = bus.answering.and_then(|it| it.mean).unwrap_or(0.0);
        let cells = format!("{}, {} on average", run.cells, number(tenths(mean)));
        let [second, short] = [run.load, bus.load.worst_16_ms.value].map(percent);
        row([run.case(), &run.verdict.to_string(), &share(bus.load.mean), &second, &short, &cells]);
    }
    if let Some(start) = &bus.start_up {
        let frames = format!("{} frames in {} s without joints", start.frames, number(start.duration_s));
        let [second, short] = [start.load.worst_1_s, start.load.worst_16_ms].map(|it| percent(it.value));
        row(["start-up", "", &share(start.load.mean), &second, &short, &frames]);
    }
    if bus.bench.total() > 0 {
        row(["left out", "", "", "", "", &format!("{} frames that only a bench sends", bus.bench.total())]);
    }
    let head = ["", "verdict", "load on average", "in any second", "in any 16 ms", "what"];
    let title = format!("{} at {}: does it fit", bus.bus, bus.name);
    Table { title, head: head.map(str::to_owned).into(), rows }
}

/// With one decimal.
fn tenths(value: f64) -> f64 {
    (value * 10.0).round() / 10.0
}

/// A line that holds each value until the next one.
fn stairs(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let held = points.windows(2).filter_map(|pair| Some((pair.get(1)?.0, pair.first()?.1)));
    let mut stairs: Vec<_> = points.iter().copied().zip(held).flat_map(|(from, to)| [from, to]).collect();
    stairs.extend(points.last());
    stairs
}
