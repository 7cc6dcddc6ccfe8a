//! Table at the end of a run: the verdict and all unusual values; in verbose mode, all values.

use std::cmp::Reverse;
use std::fmt::Display;

use analysis::paper;
use bench::summary::{BusSummary, CELL_ERROR_NM, CellSummary, HaltSummary, Outcome, ProcessorUse, Summary};
use comfy_table::Color;
use model::listing::ranges;
use model::table::Errors;
use protocol::usage::printable;

use crate::print::{
    GREEN, KeyValueTable, PLAIN, RED, YELLOW, comma_separated, count, hanging_indent, or_else_text,
    quantiles, space_separated,
};

/// Maximum number of halts listed one by one.
const MAX_HALTS: usize = 10;
/// Maximum number of a bus's conspicuous cells that are listed one by one.
const MAX_CELLS: usize = 5;
/// Maximum number of lines of the verdict, except in verbose mode.
const MAX_VERDICT_LINES: usize = 6;
/// Maximum width of a row's name in columns, except in verbose mode.
const MAX_NAME_WIDTH: usize = 24;

/// Display options of a run.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct TableStyle {
    /// True to include usual values.
    pub(super) is_verbose: bool,
    /// True to use terminal colours.
    pub(super) is_coloured: bool,
    /// Width of the terminal; `None` detects it.
    pub(super) columns: Option<u16>,
}

/// Returns the verdict and the table of a run.
pub(super) fn text(summary: &Summary, look: TableStyle) -> String {
    let rows = rows(summary, look);
    verdict(summary, look, rows.columns()) + &rows.text()
}

fn verdict(summary: &Summary, look: TableStyle, columns: usize) -> String {
    let look_at = &summary.verdict.look_at;
    let mut lines = Vec::new();
    if summary.verdict.well {
        let is_interrupted = summary.outcome == Outcome::Interrupted;
        let begin = if is_interrupted { "all well until it was interrupted: " } else { "all well: " };
        lines.push(hanging_indent("", &format!("{begin}{}", printable(&summary.totals_line())), columns));
    }
    let many = if look.is_verbose { look_at.len() } else { MAX_VERDICT_LINES };
    let more = look_at.len().saturating_sub(many);
    let more = (more > 0).then(|| format!("and {more} more, with --verbose"));
    for (at, item) in look_at.iter().take(many).chain(&more).enumerate() {
        let begin = if at == 0 { "look at: " } else { "         " };
        lines.push(hanging_indent(begin, &printable(item), columns));
    }
    let text = lines.join("\n");
    let is_unknown = summary.buses.iter().any(|bus| bus.replies.unknown + bus.uplink.unknown > 0);
    let colour = match (summary.verdict.well, summary.outcome.exit_code()) {
        (true, _) => GREEN,
        (false, 0) if !is_unknown => YELLOW,
        (false, _) => RED,
    };
    if look.is_coloured { format!("{colour}{text}{PLAIN}\n") } else { format!("{text}\n") }
}

fn rows(summary: &Summary, look: TableStyle) -> KeyValueTable {
    let cells = format!("{}, {:.1} s", count(summary.cells.len(), "cell"), summary.duration_s);
    let (cells, ended) = match summary.halts.last().filter(|_| summary.outcome == Outcome::Halted) {
        Some(halted) => (cells, format!("halted at {:.3} s", halted.at_s)),
        None => (format!("{cells}, {}", summary.outcome), String::new()),
    };
    let is_verbose = look.is_verbose;
    let mut rows = if is_verbose {
        KeyValueTable::in_columns(look.columns, &summary.skin, cells, ended)
    } else {
        KeyValueTable::in_columns(look.columns, &summary.skin, cells, ended).names_in(MAX_NAME_WIDTH)
    };
    rows = rows.coloured(look.is_coloured);
    halts(&mut rows, summary);
    for error in &summary.cell_errors {
        rows.section("ended by errors of their own", count(error.count(), "cell"), &error.reason);
        rows.row("cells", error.names(), "");
    }
    accuracy(&mut rows, summary, is_verbose);
    control(&mut rows, summary, is_verbose);
    for bus in &summary.buses {
        replies(&mut rows, bus, is_verbose);
        frames(&mut rows, bus, is_verbose);
        noteworthy(&mut rows, bus, &summary.cells);
    }
    costs(&mut rows, summary, is_verbose);
    rows
}

fn halts(rows: &mut KeyValueTable, summary: &Summary) {
    for HaltSummary { at_s, epoch, reason, until_s, .. } in summary.halts.iter().take(MAX_HALTS) {
        let until = until_s.map_or_else(|| "to the end".to_owned(), |until| format!("to {until:.3} s"));
        rows.section("halted", format!("{at_s:.3} s {until}, epoch {epoch}"), reason);
    }
    let more = summary.halts.len().saturating_sub(MAX_HALTS) as u64 + summary.further_halts;
    if more > 0 {
        rows.section("halted", format!("{} more", count(more, "time")), "--summary has when and why");
    }
}

fn accuracy(rows: &mut KeyValueTable, summary: &Summary, is_verbose: bool) {
    let accuracy = &summary.accuracy;
    let [single, sums] = [&accuracy.single, &accuracy.sums].map(|errors| errors.mean().is_some());
    if single || sums {
        rows.section("accuracy", "mean (max) error, Nm", "against central torques");
    }
    let name = |short: &'static str, long: &'static str| if is_verbose { long } else { short };
    let of_paper = |errors: &Errors, paper: f64| format!("{}, paper {paper}", compared(errors));
    if single {
        let errors = &accuracy.single;
        rows.row(
            name("single cells", "single cells, loaded joints"),
            error(errors),
            of_paper(errors, paper::SINGLE_NM),
        );
        if is_verbose {
            let errors = &accuracy.unquantised;
            rows.row("  against unrounded parameters", error(errors), compared(errors));
        }
        let errors = &accuracy.whole;
        if is_verbose || errors.count() > 0 {
            rows.row(name("the whole skin", "the whole skin, all joints"), error(errors), compared(errors));
        }
    }
    if sums {
        let errors = &accuracy.sums;
        rows.row(name("sums", "sums, loaded joints"), error(errors), of_paper(errors, paper::SUMMED_NM));
        let errors = &accuracy.sums_averaged;
        if is_verbose || errors.count() > 0 {
            rows.row("  averaged over 32 epochs", error(errors), compared(errors));
        }
    }
    rows.row_unless_zero(
        "saturated words, left out",
        accuracy.saturated,
        "beyond the range of the torque format",
    );
}

fn error(errors: &Errors) -> String {
    or_else_text(errors.mean().map(|mean| format!("{mean:.2e} ({:.1e})", errors.max())), "nothing compared")
}

fn compared(errors: &Errors) -> String {
    count(errors.count(), "torque")
}

fn control(rows: &mut KeyValueTable, summary: &Summary, is_verbose: bool) {
    let control = &summary.control;
    rows.section("control loop", "median / 90 % / 99 % / max", "µs");
    rows.row("began late", quantiles(&control.late_us), format!("idle {}", quantiles(&control.idle_late_us)));
    if is_verbose && control.central_us.count > 0 {
        rows.row("tick", quantiles(&control.took_us), "");
        rows.row("  central computation in it", quantiles(&control.central_us), "distributed: 0");
    }
    if is_verbose && control.took_distributed_us.count > 0 {
        rows.row("tick, distributed", quantiles(&control.took_distributed_us), "");
    }
    let counts = [
        ("ticks", control.ticks, control.ticks_skipped),
        ("broadcasts", control.broadcasts, control.broadcasts_skipped),
    ];
    for (name, count, skipped) in counts.into_iter().filter(|(_, _, skipped)| is_verbose || *skipped > 0) {
        rows.row(name, count, format!("{skipped} skipped"));
    }
    let why = "the bus refused them, or this machine was busy";
    rows.row_unless_zero("frames not sent", control.unsent, why);
    rows.row_unless_zero("records of ticks lost", control.records_lost, why);
    for (name, count) in &control.controller {
        rows.row("external controller", count, name);
    }
    for (reason, count) in &control.bad_cycles {
        rows.row("bad cycles", count, reason);
    }
    if is_verbose {
        let granted = |granted| if granted { "granted" } else { "refused" };
        let locked = granted(control.memory_locked);
        rows.row("SCHED_FIFO", granted(control.fifo), format!("memory lock {locked}"));
    }
}

fn replies(rows: &mut KeyValueTable, bus: &BusSummary, is_verbose: bool) {
    let replies = &bus.replies;
    rows.section(&bus.name, counts_by_kind(&bus.cells), &bus.kind);
    if bus.outages.times > 0 {
        let end = if bus.outages.at_end { ", also at the end" } else { "" };
        let ticks = format!("{} without it", count(bus.outages.ticks, "tick"));
        let times = count(bus.outages.times, "time");
        rows.row("lost", format!("{times}, {:.1} s{end}", bus.outages.lost_s), ticks);
    }
    for it in &bus.hosts {
        let gone = (it.gone > 0).then(|| format!("gone {}, {:.1} s", count(it.gone, "time"), it.gone_s));
        let end = (!it.at_end).then(|| "not reached at the end".to_owned());
        let lost = comma_separated(
            [(it.lost_from, "from there"), (it.lost_to, "to there")]
                .map(|(n, way)| format!("{} lost {way}", count(n, "frame"))),
        );
        let cells = count(it.cells, "cell");
        rows.row(
            format!("host {}", it.name),
            comma_separated([cells].into_iter().chain(gone).chain(end)),
            lost,
        );
    }
    if !bus.silent_cells.is_empty() {
        rows.row("silent cells", comma_separated(ranges(&bus.silent_cells)), "");
    }
    let complete = format!("{} of {} complete", bus.epochs_complete, count(bus.epochs_due, "epoch"));
    if let Some(sums) = &bus.sums {
        let parts = sums.contributions;
        let unexpected = parts.unasked - parts.contact_unknown;
        let is_brief = !is_verbose && parts.in_time == parts.due;
        due_rows(
            rows,
            "cells due in sums",
            parts.due,
            is_brief,
            complete,
            [parts.contact_unknown, unexpected],
        );
        if !is_brief {
            rows.row("  in time", parts.in_time, format!("{} late, {} missing", parts.late, parts.missing));
        }
        sums_on_the_bus(rows, bus, is_verbose);
    } else {
        let is_brief = !is_verbose && replies.in_time == replies.due;
        due_rows(
            rows,
            "replies due",
            replies.due,
            is_brief,
            complete,
            [replies.contact_unknown, replies.unexpected],
        );
        if !is_brief {
            rows.row("  in time", replies.in_time, format!("{} late", replies.late));
            let missing = replies.due - replies.in_time - replies.late;
            if is_verbose || missing > 0 {
                let [reasons @ .., _] = replies.missing().map(|(why, count)| (count, key_words(why)));
                unexplained(
                    rows,
                    "  missing",
                    missing,
                    reasons_text(&reasons, replies.unknown),
                    replies.unknown,
                );
            }
        }
    }
    if is_verbose {
        let last = if bus.sums.is_some() { "last sum" } else { "last reply" };
        let name = format!("{last} after broadcast, µs");
        rows.row(name, quantiles(&bus.last_reply_us), "by kernel time stamps");
        if bus.sums.is_none() {
            rows.row("  each reply, µs", quantiles(&bus.reply_us), "late ones included");
        }
        joint_age_row(rows, bus);
    } else if bus.last_reply_us.count > 0 {
        let name = if bus.sums.is_some() { "last sum, µs" } else { "last reply, µs" };
        rows.row(name, quantiles(&bus.last_reply_us), "after the joints");
    }
}

/// Adds rows on sums, and on the tree that carries them.
fn sums_on_the_bus(rows: &mut KeyValueTable, bus: &BusSummary, is_verbose: bool) {
    let Some(sums) = &bus.sums else { return };
    let counts = sums.counts;
    if is_verbose || counts.resent + counts.overheard + counts.stale > 0 {
        let more =
            format!("{} resent, {} overheard, {} stale", counts.resent, counts.overheard, counts.stale);
        rows.row(format!("sums from {}", count(sums.roots, "root")), counts.first, more);
    }
    if is_verbose {
        let on_the_bus = counts.received + bus.uplink.unheard;
        let taken =
            format!("the gateway took {}: the tree saves it frames, but not a shared bus", counts.received);
        rows.row("sums on the bus, of all cells", on_the_bus, taken);
    }
    let Some(network) = &bus.network else { return };
    if is_verbose || network.tree_ready_s.is_none() {
        let tree_ready = or_else_text(network.tree_ready_s.map(|s| format!("in {s:.2} s")), "never complete");
        let changes = count(network.parent_changes, "change");
        rows.row("tree, wires deep", network.deepest, format!("{tree_ready}, {changes} of parents"));
    }
    if !network.unreachable.is_empty() {
        rows.row("unreachable cells", space_separated(&network.unreachable), "no sum contains them");
    }
    for difference in &network.differences {
        rows.row("not as described", difference, "");
    }
}

/// Adds a row whose last text is red if something is missing for an unknown reason.
fn unexplained(rows: &mut KeyValueTable, name: &str, value: impl Display, reasons: String, unknown: u64) {
    if unknown > 0 {
        rows.row_in_colour(name, value, reasons, Color::Red);
    } else {
        rows.row(name, value, reasons);
    }
}

/// Adds rows on replies that were due, and on torques that were not due and so not compared, by reason.
fn due_rows(
    rows: &mut KeyValueTable,
    name: &str,
    due: u64,
    is_brief: bool,
    complete: String,
    [contact_unknown, unexpected]: [u64; 2],
) {
    let reasons =
        [(contact_unknown, "their contact is not known"), (unexpected, "nothing touched their cells")];
    let mut reasons = reasons.into_iter().filter(|(count, _)| *count > 0);
    let beside = if due == 0 { reasons.next() } else { None };
    match beside {
        Some((count, why)) => rows.row_in_one_line(name, due, &format!("{count} not due: {why}")),
        None if due == 0 => rows.row(name, due, "no cell was in contact"),
        None if is_brief => rows.row(name, format!("{due}, all in time"), complete),
        None => rows.row(name, due, complete),
    }
    for (count, why) in reasons {
        rows.row("  not due", count, why);
    }
}

/// Adds a row on the age of joints that cells have not received.
fn joint_age_row(rows: &mut KeyValueTable, bus: &BusSummary) {
    let why = "large: busy machine; losses: see the bus";
    rows.row("joint age at heartbeat, µs", quantiles(&bus.joints_not_taken_us), why);
}

/// Converts a key of the summary to words.
fn key_words(key: &str) -> String {
    key.replace('_', " ")
}

/// Formats the kinds with the count of each.
fn counts_by_kind(kinds: impl IntoIterator<Item = (impl Display, impl Display)>) -> String {
    comma_separated(kinds.into_iter().map(|(kind, count)| format!("{count} {kind}")))
}

/// Formats the counts of the reasons that occurred, and always the count of unknown ones.
fn reasons_text(reasons: &[(u64, impl Display)], unknown: u64) -> String {
    let known = reasons.iter().filter(|(count, _)| *count > 0);
    let known = known.map(|(count, why)| format!("{count} {why}"));
    comma_separated(known.chain([format!("{unknown} unknown")]))
}

/// Adds rows on the measuring cells of a bus, and on its most conspicuous cells.
fn noteworthy(rows: &mut KeyValueTable, bus: &BusSummary, all: &[CellSummary]) {
    let all = || all.iter().filter(|cell| cell.bus == bus.name);
    let measuring: Vec<_> = all().filter(|cell| cell.measures()).map(|cell| cell.node).collect();
    if !measuring.is_empty() {
        rows.row("cells that measure", space_separated(measuring), "not pressed, their torques not compared");
    }
    let unclear: Vec<_> =
        all().filter(|cell| cell.contact_unknown > 0 && !cell.measures()).map(|cell| cell.node).collect();
    if !unclear.is_empty() {
        rows.row(
            "cells of unknown contact",
            space_separated(unclear),
            "stimuli from before this run, or a baseline",
        );
    }
    for cell in all().filter(|cell| !cell.stuck.is_empty()) {
        let kinds = cell.stuck.iter().map(|(kind, count)| format!("{count} times one {kind}"));
        rows.row(
            format!("stuck: cell {}", cell.node),
            comma_separated(kinds),
            "while it should have sent others",
        );
    }
    let is_off = |cell: &CellSummary| cell.error.mean().is_some_and(|mean| mean > CELL_ERROR_NM);
    let rank =
        |cell: &CellSummary| (is_off(cell), cell.missing.values().sum::<u64>(), cell.late, cell.restarts);
    let mut worst: Vec<_> = all().filter(|cell| rank(cell) > (false, 0, 0, 0)).collect();
    worst.sort_by_key(|cell| Reverse(rank(cell)));
    for cell in worst.iter().take(MAX_CELLS) {
        let CellSummary { due, in_time, late, restarts, .. } = **cell;
        let late = (late > 0).then(|| format!("{late} late"));
        let missing = cell.missing.iter().map(|(why, count)| format!("{count} {}", key_words(why)));
        let restarts = (restarts > 0).then(|| count(restarts, "restart"));
        let error =
            cell.error.mean().filter(|_| is_off(cell)).map(|mean| format!("mean error {mean:.1e} Nm"));
        let why = late.into_iter().chain(missing).chain(restarts).chain(error);
        let in_time = (due > 0).then(|| format!("{in_time} of {due} replies in time"));
        rows.row(format!("cell {}", cell.node), or_else_text(in_time, ""), comma_separated(why));
    }
    let more = worst.len().saturating_sub(MAX_CELLS);
    rows.row_unless_zero("further cells that stand out", more as u64, "--summary has each cell");
}

fn frames(rows: &mut KeyValueTable, bus: &BusSummary, is_verbose: bool) {
    let up = &bus.uplink;
    let lost = up.dropped + up.backlog + up.outage + up.hosts + up.unknown;
    let odd = up.rejected + up.surplus + up.outsiders + up.in_doubt + u64::from(up.restarts);
    if is_verbose || lost + odd > 0 {
        packets(rows, bus, lost);
    } else {
        rows.row("packets of cells", up.sent, "none lost");
    }
    if is_verbose {
        rows.row("received", counts_by_kind(&bus.received), "");
    }
    let sensors = &bus.sensors;
    if let (Some(min), Some(mean), Some(max)) = (sensors.min_hz, sensors.mean_hz, sensors.max_hz) {
        let touches = comma_separated([count(sensors.touches, "touch"), count(sensors.releases, "release")]);
        rows.row("  sensors of a cell, Hz", format!("{min:.1} / {mean:.1} / {max:.1}"), touches);
    }
    if is_verbose {
        rows.row("sent", counts_by_kind(&bus.sent), "");
    }
    if !bus.events.is_empty() {
        rows.row("anomalies", counts_by_kind(&bus.events), "");
    }
}

/// Adds rows on the packets from the cells, by what became of them.
fn packets(rows: &mut KeyValueTable, bus: &BusSummary, lost: u64) {
    let up = &bus.uplink;
    rows.row("packets sent by cells", up.sent, "by their own count");
    rows.row("  delivered", up.delivered, format!("{} rejected", up.rejected));
    rows.row_unless_zero("  for other cells", up.unheard, "sums that the gateway does not take");
    let reasons = [
        (up.dropped, "dropped by the bus"),
        (up.backlog, "by the kernel's backlog"),
        (up.outage, "with the bus"),
        (up.hosts, "between hosts"),
    ];
    unexplained(rows, "  lost", lost, reasons_text(&reasons, up.unknown), up.unknown);
    rows.row_unless_zero("  surplus", up.surplus, "");
    rows.row_unless_zero("  of other senders", up.outsiders, "");
    rows.row_unless_zero("  in doubt", up.in_doubt, "");
    rows.row_unless_zero("  after the last heartbeat", up.unsettled, "");
    rows.row_unless_zero("  restarts of cells", up.restarts, "what they sent last is in doubt");
}

fn costs(rows: &mut KeyValueTable, summary: &Summary, is_verbose: bool) {
    let ProcessorUse { gateway, cells, buses } = summary.processor;
    // Adding 0.0 turns -0.0 into 0.0.
    let [gateway, cells, buses] = [gateway, cells, buses].map(|cores| cores.max(0.0) + 0.0);
    let cores = format!("{:.3}", gateway + cells + buses);
    if is_verbose {
        rows.section("cost", "", "");
        let parts = format!("gateway {gateway:.3}, cells {cells:.3}, buses {buses:.3}");
        rows.row("processor, cores", cores, parts);
        if let Some(kib) = summary.memory.cell_private_kib {
            rows.row("private memory of a cell process", format!("{kib} KiB"), "the largest");
        }
        if let Some(kib) = summary.memory.gateway_private_kib {
            let buses = summary.memory.buses_private_kib.map(|kib| format!("its servers of buses {kib} KiB"));
            rows.row("private memory of the gateway", format!("{kib} KiB"), buses.unwrap_or_default());
        }
        rows.row("start to first broadcast", format!("{:.2} s", summary.first_broadcast_s), "");
    } else {
        rows.section("processor", format!("{cores} cores"), format!("of them {cells:.3} for cells"));
    }
    let Some(recording) = &summary.recording else { return };
    for file in &recording.files {
        let frames = count(file.frames, "frame");
        let size = size(file.bytes);
        rows.section("recording", &file.path, format!("{frames}, {size}"));
    }
    if is_verbose || recording.lost > 0 || recording.files.is_empty() {
        rows.row("frames in every format", recording.frames, format!("{} lost", recording.lost));
    }
}

fn size(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} bytes"),
        10_000..10_000_000 => format!("{} KB", bytes / 1_000),
        _ => format!("{} MB", bytes / 1_000_000),
    }
}

#[cfg(test)]
mod tests;
