//! The table at the end of a run.

use std::fmt::Display;

use analysis::paper;
use bench::summary::{BusSummary, Halted, Outcome, Summary};
use comfy_table::{ColumnConstraint, ContentArrangement, Table, presets};
use model::quantiles::Quantiles;
use model::table::Errors;
use protocol::usage::{Failure, print};

/// A space before a name that stays when the name takes two lines.
const INDENT: &str = "\u{a0}";
/// Halts that are told one by one.
const HALTS: usize = 10;
/// Columns of a table that is not on a narrower terminal.
const WIDTH: u16 = 110;

/// Prints the whole run on standard output.
pub(crate) fn summary(summary: &Summary) -> Result<(), Failure> {
    print(&format!("{}\n", rows(summary).table()))
}

/// What is printed: a name, a value, and what it is to be compared with.
pub(super) struct Rows(Table);

impl Rows {
    /// A table with this head and no rows, as wide as the terminal and not wider than is good to read.
    pub(super) fn new(head: [String; 3]) -> Self {
        let mut table = Table::new();
        table.load_style(presets::UTF8_BORDERS_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
        if table.width().is_none_or(|width| width > WIDTH) {
            table.set_width(WIDTH);
        }
        table.set_header(head);
        Self(table)
    }

    /// The same where names are not broken, however narrow the terminal.
    pub(super) fn names_in_one_line(mut self) -> Self {
        if let Some(names) = self.0.column_mut(0) {
            names.set_constraint(ColumnConstraint::ContentWidth);
        }
        self
    }

    /// The table as it is printed.
    pub(super) fn table(&self) -> String {
        self.0.to_string().replace(INDENT, " ")
    }

    pub(super) fn section(&mut self, name: impl Display, value: impl Display, beside: impl Display) {
        self.0.add_row([name.to_string(), value.to_string(), beside.to_string()]);
    }

    pub(super) fn row(&mut self, name: impl Display, value: impl Display, beside: impl Display) {
        let name = format!("  {name}");
        let text = name.trim_start_matches(' ');
        let indented = INDENT.repeat(name.len() - text.len()) + text;
        self.0.add_row([indented, value.to_string(), beside.to_string()]);
    }
}

fn rows(summary: &Summary) -> Rows {
    let cells = format!("{} cells, {:.1} s", summary.cells, summary.duration_s);
    let (cells, ended) = match summary.halts.last().filter(|_| summary.outcome == Outcome::Halted) {
        Some(halted) => (cells, format!("halted at {:.3} s", halted.at_s)),
        None => (format!("{cells}, {}", summary.outcome), String::new()),
    };
    let mut rows = Rows::new([summary.skin.clone(), cells, ended]);
    halts(&mut rows, summary);
    accuracy(&mut rows, summary);
    control(&mut rows, summary);
    for bus in &summary.buses {
        replies(&mut rows, bus);
        frames(&mut rows, bus);
    }
    costs(&mut rows, summary);
    rows
}

fn halts(rows: &mut Rows, summary: &Summary) {
    for Halted { at_s, epoch, reason, until_s, .. } in summary.halts.iter().take(HALTS) {
        let until = until_s.map_or_else(|| "to the end".to_owned(), |until| format!("to {until:.3} s"));
        rows.section("halted", format!("{at_s:.3} s {until}, epoch {epoch}"), reason);
    }
    let more = summary.halts.len().saturating_sub(HALTS) as u64 + summary.further_halts;
    if more > 0 {
        rows.section("halted", format!("{more} times more"), "--summary has when and why");
    }
}

fn accuracy(rows: &mut Rows, summary: &Summary) {
    let accuracy = &summary.accuracy;
    let [single, sums] = [&accuracy.single, &accuracy.sums].map(|errors| errors.mean().is_some());
    if !single && !sums {
        return;
    }
    rows.section("accuracy", "mean (greatest) error, Nm", "distributed against central");
    if single {
        let paper = format!("paper {}", paper::SINGLE_NM);
        rows.row("single cells, loaded joints", errors(&accuracy.single), paper);
        rows.row("  against unrounded parameters", errors(&accuracy.unquantised), "");
        rows.row("the whole skin, all joints", errors(&accuracy.whole), "");
    }
    if sums {
        let paper = format!("paper {}", paper::SUMMED_NM);
        rows.row("sums, loaded joints", errors(&accuracy.sums), paper);
        rows.row("  averaged over 32 epochs", errors(&accuracy.sums_averaged), "");
    }
    if accuracy.saturated > 0 {
        rows.row("saturated words, left out", accuracy.saturated, "above 8 Nm");
    }
}

fn errors(errors: &Errors) -> String {
    errors.mean().map_or_else(
        || "nothing compared".to_owned(),
        |mean| format!("{mean:.2e} ({:.1e}), {} torques", errors.max(), errors.count()),
    )
}

fn control(rows: &mut Rows, summary: &Summary) {
    let control = &summary.control;
    rows.section("control loop", "50 % / 90 % / 99 % / greatest, µs", "");
    rows.row("began late", quantiles(&control.late_us), format!("idle {}", quantiles(&control.idle_late_us)));
    if control.central_us.count > 0 {
        rows.row("tick", quantiles(&control.took_us), "");
        rows.row("  central computation in it", quantiles(&control.central_us), "distributed: 0");
    }
    if control.took_distributed_us.count > 0 {
        rows.row("tick, distributed", quantiles(&control.took_distributed_us), "");
    }
    rows.row("ticks", control.ticks, format!("{} skipped", control.ticks_skipped));
    rows.row("broadcasts", control.broadcasts, format!("{} skipped", control.broadcasts_skipped));
    for (name, count) in
        [("frames not sent", control.unsent), ("records of ticks lost", control.records_lost)]
    {
        if count > 0 {
            rows.row(name, count, "the bus did not take them, or this machine was busy");
        }
    }
    for (name, count) in &control.controller {
        rows.row("external controller", count, name);
    }
    for (reason, count) in &control.bad_cycles {
        rows.row("bad cycles", count, reason);
    }
    let granted = |granted| if granted { "granted" } else { "refused" };
    let locked = granted(control.memory_locked);
    rows.row("SCHED_FIFO", granted(control.fifo), format!("memory lock {locked}"));
}

fn replies(rows: &mut Rows, bus: &BusSummary) {
    let replies = &bus.replies;
    let statuses: Vec<_> = bus.cells.iter().map(|(status, count)| format!("{count} {status}")).collect();
    rows.section(format!("{} ({})", bus.name, bus.kind), statuses.join(", "), "");
    if bus.outages.times > 0 {
        let end = if bus.outages.at_end { ", also at the end" } else { "" };
        let ticks = format!("{} ticks without it", bus.outages.ticks);
        rows.row("lost", format!("{} times, {:.1} s{end}", bus.outages.times, bus.outages.lost_s), ticks);
    }
    if !bus.silent_cells.is_empty() {
        let names: Vec<_> = bus.silent_cells.iter().map(u8::to_string).collect();
        rows.row("silent cells", names.join(" "), "");
    }
    let complete = format!("{} of {} epochs complete", bus.epochs_complete, bus.epochs_due);
    if let Some(sums) = &bus.sums {
        let (counts, parts) = (sums.counts, sums.contributions);
        rows.row("cells due in sums", parts.due, complete);
        rows.row("  in time", parts.in_time, format!("{} late, {} missing", parts.late, parts.missing));
        let more =
            format!("{} resent, {} overheard, {} stale", counts.resent, counts.overheard, counts.stale);
        rows.row(format!("sums from {} roots", sums.roots), counts.first, more);
        let on_the_bus = counts.received + bus.uplink.unheard;
        let plainly =
            format!("the gateway took {}: the tree spares it frames, and a shared bus none", counts.received);
        rows.row("sums on the bus, of all cells", on_the_bus, plainly);
        if let Some(network) = &bus.network {
            let organised =
                network.organised_s.map_or_else(|| "never whole".to_owned(), |s| format!("in {s:.2} s"));
            let changes = format!("{organised}, {} changes of parents", network.parent_changes);
            rows.row("tree, wires deep", network.deepest, changes);
            let without: Vec<_> = network.without_way.iter().map(u8::to_string).collect();
            if !without.is_empty() {
                rows.row("cells without a way to a root", without.join(" "), "no sum holds them");
            }
            for difference in &network.differences {
                rows.row("not as described", difference, "");
            }
        }
        rows.row("last sum after broadcast, µs", quantiles(&bus.last_reply_us), "by kernel time stamps");
        return;
    }
    rows.row("replies due", replies.due, complete);
    rows.row("  in time", replies.in_time, format!("{} late", replies.late));
    let missing = replies.due - replies.in_time - replies.late;
    let reasons = [
        (replies.too_late, "too late"),
        (replies.skipped, "skipped by cells"),
        (replies.not_heard, "not heard"),
        (replies.lost, "lost"),
        (replies.in_doubt, "in doubt"),
    ];
    rows.row("  missing", missing, explained(&reasons, replies.unknown));
    rows.row("last reply after broadcast, µs", quantiles(&bus.last_reply_us), "by kernel time stamps");
}

/// The reasons that there were, and always how many nobody knows.
fn explained(reasons: &[(u64, &str)], unknown: u64) -> String {
    let known = reasons.iter().filter(|(count, _)| *count > 0).map(|(count, why)| format!("{count} {why}, "));
    known.collect::<String>() + &format!("{unknown} unknown")
}

fn frames(rows: &mut Rows, bus: &BusSummary) {
    let up = &bus.uplink;
    let lost = up.dropped + up.backlog + up.outage + up.unknown;
    rows.row("packets sent by cells", up.sent, "by their own count");
    rows.row("  delivered", up.delivered, format!("{} rejected", up.rejected));
    if up.unheard > 0 {
        rows.row("  for other cells", up.unheard, "sums that the gateway does not take");
    }
    let reasons = [
        (up.dropped, "dropped by the bus"),
        (up.backlog, "by the kernel's backlog"),
        (up.outage, "with the bus"),
    ];
    rows.row("  lost", lost, explained(&reasons, up.unknown));
    for (name, count) in
        [("surplus", up.surplus), ("in doubt", up.in_doubt), ("after the last heartbeat", up.unsettled)]
    {
        if count > 0 {
            rows.row(format!("  {name}"), count, "");
        }
    }
    if up.restarts > 0 {
        rows.row("  restarts of cells", up.restarts, "what they sent last is in doubt");
    }
    let list = |kinds: &std::collections::BTreeMap<&str, u64>| {
        kinds.iter().map(|(kind, count)| format!("{count} {kind}")).collect::<Vec<_>>().join(", ")
    };
    rows.row("received", list(&bus.received), "");
    let sensors = &bus.sensors;
    // A frame or two are answers to reports.
    if let (Some(least), Some(mean), Some(greatest @ 1.0..)) =
        (sensors.least_hz, sensors.mean_hz, sensors.greatest_hz)
    {
        let touches = format!("{} touches, {} releases", sensors.touches, sensors.releases);
        rows.row("  sensors of a cell, Hz", format!("{least:.1} / {mean:.1} / {greatest:.1}"), touches);
    }
    rows.row("sent", list(&bus.sent), "");
    if !bus.events.is_empty() {
        rows.row("odd", list(&bus.events), "");
    }
}

fn costs(rows: &mut Rows, summary: &Summary) {
    let processor = &summary.processor;
    rows.section("cost", "", "");
    rows.row(
        "processor, cores",
        format!("{:.3}", processor.gateway + processor.cells + processor.buses),
        format!(
            "gateway {:.3}, cells {:.3}, buses {:.3}",
            processor.gateway, processor.cells, processor.buses
        ),
    );
    if let Some(kib) = summary.cell_private_kib {
        rows.row("private memory of a cell process", format!("{kib} KiB"), "the largest");
    }
    rows.row("start to first broadcast", format!("{:.2} s", summary.first_broadcast_s), "");
    if let Some(recording) = &summary.recording {
        for file in &recording.files {
            rows.row("recording", &file.path, format!("{} frames, {}", file.frames, size(file.bytes)));
        }
        rows.row("  frames in every format", recording.frames, format!("{} lost", recording.lost));
    }
}

fn size(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} bytes"),
        10_000..10_000_000 => format!("{} KB", bytes / 1_000),
        _ => format!("{} MB", bytes / 1_000_000),
    }
}

fn quantiles(quantiles: &Quantiles) -> String {
    let Quantiles { p50, p90, p99, max, .. } = quantiles;
    format!("{p50:.0} / {p90:.0} / {p99:.0} / {max:.0}")
}
