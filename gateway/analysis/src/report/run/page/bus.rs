//! The sections on the buses: replies and packets of the cells, and the load of real buses.

use super::super::bus_figures::{BusFigures, Latency};
use super::{PageDraft, without_empty_series};
use crate::fit;
use crate::fit::limits::MAX_NODES_PER_BUS;
use crate::fit::verdict::{FitSummary, format_percent};
use crate::report::figure::{
    Axis, Figure, Finding, MarkLine, Section, Series, SeriesShape, Table, format_number, format_quantity,
};
use crate::report::svg::stair_points;
use crate::report::thin::{BinnedSums, ThinnedLine};
use crate::shadow::BusShadow;
use model::table::{CellState, FrameEvent};
use protocol::quantiles::Quantiles;

/// Maximum number of cells in the table of the cells with most problems.
const MAX_WORST_CELLS: usize = 12;

impl PageDraft<'_> {
    pub(super) fn replies_section(&self) -> Section {
        let due = self.run.bus_figures.iter().filter(|bus_figures| bus_figures.reply_counts().due > 0);
        let mut section = Section::new("replies", "Replies")
            .with_paragraph(
                "A reply is due from every cell that is configured, awake and in contact; it is in time if it \
                 arrives before the next joints message, and late if it arrives within three more periods.",
            )
            .with_figures(due.flat_map(|bus_figures| self.reply_figures(bus_figures)).filter_map(without_empty_series))
            .with_tables([self.reply_account_table()])
            .with_tables(self.worst_cells_table());
        let none_due = |bus_figures: &&BusFigures| bus_figures.reply_counts().due == 0;
        let complete = |bus_figures: &&BusFigures| {
            let account = bus_figures.reply_counts();
            account.due > 0 && account.late + account.missing == 0
        };
        for (which, sentence) in [
            (&none_due as &dyn Fn(&&BusFigures) -> bool, "no reply was due"),
            (&complete, "every reply that was due arrived in time"),
        ] {
            let names: Vec<_> =
                self.run.bus_figures.iter().filter(which).map(|it| it.name.as_str()).collect();
            if !names.is_empty() {
                section = section.with_paragraph(format!("{}: {sentence}.", names.join(", ")));
            }
        }
        section
    }

    fn reply_figures(&self, bus_figures: &BusFigures) -> Vec<Figure> {
        let name = &bus_figures.name;
        let unit = if bus_figures.sums { "cells in sums" } else { "replies" };
        let steps = |figure: &str, title: &str, y: Axis, of: [(&str, &ThinnedLine); 2]| {
            let of =
                of.map(|(caption, thinned)| Series::new(caption, SeriesShape::Steps, self.points(thinned)));
            self.time_figure(format!("{figure}-{name}"), format!("{name}: {unit} {title}"), y)
                .with_half_width()
                .with_series(of)
        };
        let y = Axis::new(unit, "");
        let lost = bus_figures.reply_counts().late + bus_figures.reply_counts().missing;
        let slowest = format!("{name}: time from the joints message to its last reply, by epoch");
        let [due, late] = [
            [("due", &bus_figures.lines.due), ("in time", &bus_figures.lines.in_time)],
            [("late", &bus_figures.lines.late), ("missing", &bus_figures.lines.missing)],
        ];
        let mut figures = vec![steps("replies", "due and in time, per epoch", y.clone(), due)];
        figures.extend((lost > 0).then(|| steps("late", "late and missing, when detected", y, late)));
        let slowest = self.time_figure(format!("slowest-{name}"), slowest, Axis::new("time", "ms"));
        let slowest = slowest
            .with_series([self.thinned_series("", &bus_figures.lines.slowest)])
            .with_marks(self.last_reply_bound(bus_figures));
        figures.push(if lost > 0 { slowest } else { slowest.with_half_width() });
        figures
    }

    fn reply_account_table(&self) -> Table {
        let row = |bus_figures: &BusFigures| {
            let account = bus_figures.reply_counts();
            let counters = bus_figures.table.counters();
            let reply = Quantiles::from_histogram(bus_figures.table.delays().last_reply_delays(), 1.0);
            let numbers = [
                account.due,
                account.in_time,
                account.late,
                account.missing,
                counters.epochs_due,
                counters.epochs_complete,
            ];
            let numbers = numbers.map(|count| count.to_string());
            let times = [reply.p50, reply.p99, reply.max];
            let times =
                times.map(|micros| format_quantity(if reply.count > 0 { micros } else { f64::NAN }, "µs"));
            [bus_figures.name.clone()].into_iter().chain(numbers).chain(times).collect::<Vec<_>>()
        };
        let rows = self.run.bus_figures.iter().map(row);
        let head = [
            "bus",
            "due",
            "in time",
            "late",
            "missing",
            "epochs due",
            "epochs complete",
            "last reply: median",
            "99 %",
            "max",
        ];
        Table::new("Replies by bus", head, rows)
    }

    /// Creates the table of the cells with most problems; among cells with equally many, the slowest come first.
    fn worst_cells_table(&self) -> Option<Table> {
        let cells = self.run.bus_figures.iter().enumerate().flat_map(|(bus, bus_figures)| {
            let described = self.run.skin.cells_on_bus(bus);
            bus_figures.table.cells().iter().zip(described).zip(&bus_figures.latency).map(
                move |((cell, described), latency)| {
                    // The robot's numbering of joints.
                    let joint =
                        self.run.skin.joints_on_bus(bus).nth(usize::from(described.joint).saturating_sub(1));
                    (bus_figures, cell, joint.map_or(0, |(joint, _)| joint + 1), latency)
                },
            )
        });
        let mut cells: Vec<_> = cells.collect();
        let stands_out =
            |cell: &CellState| cell.replies.due + cell.uplink().lost > 0 || cell.uplink().restarts > 0;
        if !cells.iter().any(|(_, cell, ..)| stands_out(cell)) {
            return None;
        }
        cells.sort_by_key(|(_, cell, _, latency)| {
            let (replies, uplink) = (&cell.replies, cell.uplink());
            std::cmp::Reverse((replies.missing + replies.late, uplink.lost, uplink.restarts, latency.max))
        });
        let row = |(bus_figures, cell, joint, latency): &(&BusFigures, &CellState, usize, &Latency)| {
            let (mean, slowest) = if latency.count == 0 {
                (f64::NAN, f64::NAN)
            } else {
                (latency.sum as f64 / latency.count as f64, latency.max as f64)
            };
            let replies = &cell.replies;
            let counts = [replies.due, replies.in_time, replies.late, replies.missing, cell.uplink().lost];
            let counts = counts.map(|count| count.to_string());
            [format!("{}\u{a0}{}", bus_figures.name, cell.node), joint.to_string()]
                .into_iter()
                .chain(counts)
                .chain([
                    cell.uplink().restarts.to_string(),
                    format_quantity(mean, "µs"),
                    format_quantity(slowest, "µs"),
                ])
                .collect::<Vec<_>>()
        };
        let rows: Vec<_> = cells.iter().take(MAX_WORST_CELLS).map(row).collect();
        let head = [
            "cell",
            "joint",
            "due",
            "in time",
            "late",
            "missing",
            "packets lost",
            "restarts",
            "reply: mean",
            "max",
        ];
        let of = self.run.skin.cells.len();
        let title = if rows.len() < of {
            format!("The {MAX_WORST_CELLS} worst of {of} cells")
        } else {
            "All cells".to_owned()
        };
        let title = format!("{title}, sorted by late or missing replies, then losses, then slowest reply");
        Some(Table::new(title, head, rows))
    }

    /// Returns the load in % from the first tick or joints on. Before that the load is not typical, because all cells
    /// start at once.
    pub(super) fn load_percent(&self, binned: &BinnedSums) -> Vec<(f64, f64)> {
        let rates = binned.bin_rates().into_iter().map(|(x, part)| (x - self.zero, part * 100.0));
        rates.filter(|(x, _)| *x >= 0.0).collect()
    }

    /// Returns a line at the latest end of the last reply in the worst case, if frames take time on the bus. `None`
    /// without such an upper bound.
    fn last_reply_bound(&self, bus_figures: &BusFigures) -> Option<MarkLine> {
        self.bus_shadows.iter().find(|bus| bus.bus == bus_figures.name && bus.is_timed)?;
        let skin = &self.run.skin;
        let index = skin.bus_index(&bus_figures.name)?;
        let micros = fit::last_reply_bound_us(skin, index, bus_figures.rates.rates)?;
        Some(MarkLine::at_y(micros / 1e3, "worst case of skinbus fit"))
    }

    /// Creates the findings on whether real buses can carry the traffic, in this run and in the worst case. They are
    /// rated only if the bit rates were chosen, not for defaults.
    pub(super) fn fit_findings(&self) -> Vec<Finding> {
        let mut findings = Vec::new();
        let limits = format!(
            "load at most 100 %, replies before the next joints message, at most \
                              {MAX_NODES_PER_BUS} nodes"
        );
        for bus in &self.bus_shadows {
            let bus_figures = self.run.bus_figures.iter().find(|bus_figures| bus_figures.name == bus.bus);
            let origin = bus_figures.and_then(|bus_figures| bus_figures.rates_from);
            for answer in bus.this_run.iter().chain(&bus.worst_case) {
                let FitSummary { load, rates, cells, verdict } = answer;
                let what = format!("{} at {rates}, {}: {verdict} ({cells})", bus.bus, answer.case_name());
                let finding = Finding::new_unrated(what, (round_to_tenths(100.0 * load), "%"));
                findings.push(match origin {
                    Some(origin) => {
                        finding.with_requirement(limits.as_str(), verdict.fits()).with_origin(origin)
                    }
                    None => finding.with_reference("not rated: these bit rates are defaults"),
                });
            }
        }
        findings
    }

    /// Creates the section on the load of real buses.
    pub(super) fn load_section(&self) -> Section {
        let figure = |bus_figures: &BusFigures| {
            let BusFigures { name, load, load_of_all, rates, .. } = bus_figures;
            let (rates, width) = (rates.rates, format_quantity(load.bin_width(), "s"));
            let title = format!("{name}: load of a real bus at {rates}, averaged over {width}");
            self.time_figure(format!("load-{name}"), title, Axis::new("load", "%"))
                .draw_series("load of a real bus", SeriesShape::Steps, self.load_percent(load))
                .draw_series(
                    "including bench-only frames",
                    SeriesShape::Dashed,
                    stair_points(&self.load_percent(load_of_all)),
                )
                .with_marks([MarkLine::at_y(100.0, "full load")])
        };
        let (timed, untimed): (Vec<_>, Vec<_>) = self.bus_shadows.iter().partition(|bus| bus.is_timed);
        let names =
            |buses: &[&BusShadow]| buses.iter().map(|bus| bus.bus.as_str()).collect::<Vec<_>>().join(", ");
        let mut section = Section::new("load", "Load of the buses");
        if !untimed.is_empty() {
            section = section.with_paragraph(format!(
                "On {} a frame took no time. On a real bus it takes the time of its bits, including its stuff bits.",
                names(&untimed)
            ));
        }
        if !timed.is_empty() {
            section = section.with_paragraph(format!(
                "On {} each frame took the time of its bits, including its stuff bits, as on a real bus. Time stamps \
                 are the ends of frames.",
                names(&timed)
            ));
        }
        let text = "This run is rated by its second with the highest load; the worst case assumes that all cells answer \
                    with the longest possible frames. Frames that only a bench sends are left out: stimuli, sync and \
                    report with their answers, and simulated wires. Start-up, before the first joints message, \
                    is shown separately.";
        let assumed = self.run.bus_figures.iter().any(|bus_figures| !bus_figures.rates.is_chosen);
        section = section.with_paragraph(text);
        if assumed {
            section = section.with_paragraph(
                "The skin does not give bit rates for every bus; for the others, common bit rates are assumed, and \
                 the load is only for information.",
            );
        }
        section
            .with_figures(self.run.bus_figures.iter().map(figure).filter_map(without_empty_series))
            .with_tables(self.bus_shadows.iter().map(load_table))
    }

    pub(super) fn losses_section(&self) -> Section {
        let (run, ticks) = (self.run, &self.run.motion.counts);
        let mut rows: Vec<Vec<String>> = Vec::new();
        let mut row = |what: String, count: u64, always: bool| {
            if always || count > 0 {
                rows.push(vec![what, count.to_string()]);
            }
        };
        let has_loop = run.frames_only.is_none();
        if has_loop {
            row("ticks skipped by the loop".to_owned(), ticks.skipped, true);
            row("ticks missing from the recording".to_owned(), ticks.unrecorded, true);
        }
        row("bad cycles".to_owned(), ticks.bad, false);
        row("ticks while the robot was halted".to_owned(), ticks.halted, false);
        row("ticks whose velocity was not finite".to_owned(), ticks.refused, false);
        for bus_figures in &run.bus_figures {
            let name = &bus_figures.name;
            let uplink = bus_figures.table.uplink();
            row(format!("{name}: frames recorded"), bus_figures.frames, true);
            row(format!("{name}: frames that the recorder reported as lost"), bus_figures.dropped, true);
            row(format!("{name}: packets that cells sent, according to their counters"), uplink.sent, true);
            row(format!("{name}: packets that cells sent, but that were lost"), uplink.lost, true);
            row(format!("{name}: packets that cells sent, but that were refused"), uplink.rejected, false);
            row(format!("{name}: restarts of cells during the run"), u64::from(uplink.restarts), false);
            for event in FrameEvent::ALL {
                row(
                    format!("{name}: {}", event.name()),
                    bus_figures.table.counters().event_count(event),
                    false,
                );
            }
        }
        row("packets of any network that the kernel's backlog dropped".to_owned(), run.backlog, false);
        row("frames of buses that the skin does not have".to_owned(), run.others, false);
        row("messages or lines that cannot be read".to_owned(), run.unreadable, false);
        let mut section = Section::new("losses", "Losses")
            .with_paragraph("Rows of possible losses are always shown; other rows only when they are not 0.");
        section.text.extend(self.missing_sentence("the counts of skipped ticks and bad cycles"));
        section.with_tables(self.halt_table()).with_tables(self.loss_table()).with_tables([Table::new(
            "All counts",
            ["what", "count"],
            rows,
        )])
    }
}

/// Creates the table of a bus's load, with a column for operation and one for start-up.
fn load_table(bus: &BusShadow) -> Table {
    let share = |share: Option<f64>| share.map_or_else(|| "?".to_owned(), format_percent);
    let mut rows = Vec::new();
    let mut row = |cells: [&str; 6]| rows.push(cells.map(str::to_owned));
    if let Some(worst) = &bus.worst_case {
        let (verdict, load, cells) =
            (worst.verdict.to_string(), format_percent(worst.load), worst.cells.to_string());
        row([worst.case_name(), &verdict, &load, "", "", &cells]);
    }
    if let Some(run) = &bus.this_run {
        let mean = bus.answering.and_then(|it| it.mean).unwrap_or(0.0);
        let cells = format!("{}, {} on average", run.cells, format_number(round_to_tenths(mean)));
        let [second, short] = [run.load, bus.load.worst_16_ms.value].map(format_percent);
        row([run.case_name(), &run.verdict.to_string(), &share(bus.load.mean), &second, &short, &cells]);
    }
    if let Some(start) = &bus.start_up {
        let frames = format!(
            "{} frames in {}, without joints messages",
            start.frames,
            format_quantity(start.duration_s, "s")
        );
        let [second, short] =
            [start.load.worst_1_s, start.load.worst_16_ms].map(|it| format_percent(it.value));
        row(["start-up", "", &share(start.load.mean), &second, &short, &frames]);
    }
    if bus.counts.bench.total() > 0 {
        row(["left out", "", "", "", "", &format!("{} bench-only frames", bus.counts.bench.total())]);
    }
    let head = ["", "verdict", "load on average", "in any second", "in any 16 ms", "details"];
    Table::new(format!("Fit of {} at {}", bus.bus, bus.name), head, rows)
}

/// Rounds to one decimal.
fn round_to_tenths(value: f64) -> f64 {
    (value * 10.0).round() / 10.0
}
