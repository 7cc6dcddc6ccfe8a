//! Table at the end of a run: the verdict and all unusual values; in verbose mode, all values.

mod frames;

use std::cmp::Reverse;
use std::fmt::Display;

use analysis::paper;
use bench::summary::{
    BusSummary, CellSummary, HaltSummary, MAX_CELL_ERROR_NM, Outcome, ProcessorUse, Summary,
};
use comfy_table::Color;
use model::listing::node_id_ranges;
use model::table::TorqueErrors;
use protocol::usage::printable;

use crate::print::{
    GREEN, KeyValueTable, RED, RESET_COLOUR, YELLOW, comma_separated, count_with_noun, format_quantiles,
    hanging_indent, or_else_text, space_separated,
};

const MAX_LISTED_HALTS: usize = 10;
/// Maximum number of a bus's conspicuous cells that are listed one by one.
const MAX_LISTED_CELLS: usize = 5;
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
pub(super) fn format_summary(summary: &Summary, look: TableStyle) -> String {
    let rows = summary_rows(summary, look);
    verdict(summary, look, rows.width_in_columns()) + &rows.to_text()
}

fn verdict(summary: &Summary, look: TableStyle, columns: usize) -> String {
    let look_at = &summary.verdict.look_at;
    let mut lines = Vec::new();
    if summary.verdict.well {
        let is_interrupted = summary.outcome == Outcome::Interrupted;
        let begin = if is_interrupted { "all well until the run was interrupted: " } else { "all well: " };
        lines.push(hanging_indent("", &format!("{begin}{}", printable(&summary.totals_line())), columns));
    }
    let many = if look.is_verbose { look_at.len() } else { MAX_VERDICT_LINES };
    let more = look_at.len().saturating_sub(many);
    let more = (more > 0).then(|| format!("and {more} more: use --verbose"));
    for (at, item) in look_at.iter().take(many).chain(&more).enumerate() {
        let begin = if at == 0 { "problems: " } else { "          " };
        lines.push(hanging_indent(begin, &printable(item), columns));
    }
    let text = lines.join("\n");
    let is_unknown = summary.buses.iter().any(|bus| bus.replies.unknown + bus.uplink.unknown > 0);
    let colour = match (summary.verdict.well, summary.outcome.exit_code()) {
        (true, _) => GREEN,
        (false, 0) if !is_unknown => YELLOW,
        (false, _) => RED,
    };
    if look.is_coloured { format!("{colour}{text}{RESET_COLOUR}\n") } else { format!("{text}\n") }
}

fn summary_rows(summary: &Summary, look: TableStyle) -> KeyValueTable {
    let cells = format!("{}, {:.1} s", count_with_noun(summary.cells.len(), "cell"), summary.duration_s);
    let (cells, ended) = match summary.halts.last().filter(|_| summary.outcome == Outcome::Halted) {
        Some(halted) => (cells, format!("halted at {:.3} s", halted.at_s)),
        None => (format!("{cells}, {}", summary.outcome), String::new()),
    };
    let is_verbose = look.is_verbose;
    let mut rows = if is_verbose {
        KeyValueTable::with_terminal_width(look.columns, &summary.skin, cells, ended)
    } else {
        KeyValueTable::with_terminal_width(look.columns, &summary.skin, cells, ended)
            .with_name_width(MAX_NAME_WIDTH)
    };
    rows = rows.with_colours(look.is_coloured);
    add_halt_sections(&mut rows, summary);
    for error in &summary.cell_errors {
        rows.add_section("cells that failed", count_with_noun(error.count(), "cell"), &error.reason);
        rows.add_row("cells", error.names(), "");
    }
    add_accuracy_rows(&mut rows, summary, is_verbose);
    add_control_rows(&mut rows, summary, is_verbose);
    for bus in &summary.buses {
        add_reply_rows(&mut rows, bus, is_verbose);
        frames::add_timed_rows(&mut rows, bus, is_verbose);
        frames::add_frame_rows(&mut rows, bus, is_verbose);
        add_noteworthy_cell_rows(&mut rows, bus, &summary.cells);
    }
    add_cost_rows(&mut rows, summary, is_verbose);
    rows
}

fn add_halt_sections(rows: &mut KeyValueTable, summary: &Summary) {
    for HaltSummary { at_s, epoch, reason, until_s, .. } in summary.halts.iter().take(MAX_LISTED_HALTS) {
        let until = until_s.map_or_else(|| "to the end".to_owned(), |until| format!("to {until:.3} s"));
        rows.add_section("halted", format!("{at_s:.3} s {until}, epoch {epoch}"), reason);
    }
    let more = summary.halts.len().saturating_sub(MAX_LISTED_HALTS) as u64 + summary.further_halts;
    if more > 0 {
        rows.add_section(
            "halted",
            format!("{} more", count_with_noun(more, "time")),
            "--summary lists times and reasons",
        );
    }
}

fn add_accuracy_rows(rows: &mut KeyValueTable, summary: &Summary, is_verbose: bool) {
    let accuracy = &summary.accuracy;
    let [single, sums] = [&accuracy.single, &accuracy.sums].map(|errors| errors.mean().is_some());
    if single || sums {
        rows.add_section("accuracy", "mean (max) error, Nm", "against central torques");
    }
    let name = |short: &'static str, long: &'static str| if is_verbose { long } else { short };
    let mean = name("", ": mean");
    let of_paper = |errors, paper: f64| format!("{}, paper{mean} {paper}", format_torque_count(errors));
    if single {
        let errors = &accuracy.single;
        rows.add_row(
            name("each cell", "each cell, joints that move it"),
            format_mean_and_max(errors),
            of_paper(errors, paper::SINGLE_CELL_ERROR_NM),
        );
        if is_verbose {
            let errors = &accuracy.unquantised;
            rows.add_row(
                "  against unrounded parameters",
                format_mean_and_max(errors),
                format_torque_count(errors),
            );
        }
        let errors = &accuracy.whole;
        if is_verbose || errors.count() > 0 {
            rows.add_row(
                name("the whole skin", "the whole skin, all joints"),
                format_mean_and_max(errors),
                format_torque_count(errors),
            );
        }
    }
    if sums {
        let errors = &accuracy.sums;
        rows.add_row(
            name("sums", "sums, joints that move cells"),
            format_mean_and_max(errors),
            of_paper(errors, paper::SUMMED_ERROR_NM),
        );
        let errors = &accuracy.sums_averaged;
        if is_verbose || errors.count() > 0 {
            rows.add_row(
                "  averaged over 32 epochs",
                format_mean_and_max(errors),
                format_torque_count(errors),
            );
        }
    }
    rows.add_row_unless_zero(
        "saturated words, not compared",
        accuracy.saturated,
        "beyond the range of the torque format",
    );
}

fn format_mean_and_max(errors: &TorqueErrors) -> String {
    or_else_text(errors.mean().map(|mean| format!("{mean:.2e} ({:.1e})", errors.max())), "not compared")
}

fn format_torque_count(errors: &TorqueErrors) -> String {
    count_with_noun(errors.count(), "torque")
}

fn add_control_rows(rows: &mut KeyValueTable, summary: &Summary, is_verbose: bool) {
    let control = &summary.control;
    rows.add_section("control loop", "median / 90 % / 99 % / max", "µs");
    rows.add_row(
        "tick lateness",
        format_quantiles(&control.late_us),
        format!("before the run: {}", format_quantiles(&control.idle_late_us)),
    );
    if is_verbose && control.central_us.count > 0 {
        rows.add_row("tick duration", format_quantiles(&control.took_us), "");
        rows.add_row(
            "  its central computation",
            format_quantiles(&control.central_us),
            "part of it; none in distributed mode",
        );
    }
    if is_verbose && control.took_distributed_us.count > 0 {
        rows.add_row("tick duration, distributed", format_quantiles(&control.took_distributed_us), "");
    }
    let counts = [
        ("ticks", control.ticks, control.ticks_skipped),
        ("broadcasts", control.broadcasts, control.broadcasts_skipped),
    ];
    for (name, count, skipped) in counts.into_iter().filter(|(_, _, skipped)| is_verbose || *skipped > 0) {
        rows.add_row(name, count, format!("{skipped} skipped"));
    }
    let why = "the bus refused them, or this machine was busy";
    rows.add_row_unless_zero("frames not sent", control.unsent, why);
    rows.add_row_unless_zero("tick records lost", control.records_lost, why);
    for (name, count) in &control.controller {
        rows.add_row("external controller", count, name);
    }
    for (reason, count) in &control.bad_cycles {
        rows.add_row("bad cycles", count, reason);
    }
    if is_verbose {
        let granted = |granted| if granted { "granted" } else { "refused" };
        let lock = format!("memory lock {}", granted(control.memory_locked));
        rows.add_row("SCHED_FIFO", granted(control.fifo), lock);
    }
}

fn add_reply_rows(rows: &mut KeyValueTable, bus: &BusSummary, is_verbose: bool) {
    let replies = &bus.replies;
    let cells = format!("cells: {}", frames::cells_by_status(&bus.cells));
    rows.add_section(&bus.name, cells, format!("at the end; {} bus", bus.kind));
    if bus.outages.times > 0 {
        let end = if bus.outages.at_end { ", also at the end" } else { "" };
        let ticks = format!("{} ran without this bus", count_with_noun(bus.outages.ticks, "tick"));
        let times = count_with_noun(bus.outages.times, "time");
        rows.add_row("bus lost", format!("{times}, {:.1} s{end}", bus.outages.lost_s), ticks);
    }
    for it in &bus.hosts {
        let gone = (it.gone > 0)
            .then(|| format!("unreachable {}, {:.1} s", count_with_noun(it.gone, "time"), it.gone_s));
        let end = (!it.at_end).then(|| "unreachable at the end".to_owned());
        let lost = comma_separated(
            [(it.lost_from, "from this host"), (it.lost_to, "to this host")]
                .map(|(n, way)| format!("{} lost {way}", count_with_noun(n, "frame"))),
        );
        let cells = count_with_noun(it.cells, "cell");
        rows.add_row(
            format!("host {}", it.name),
            comma_separated([cells].into_iter().chain(gone).chain(end)),
            lost,
        );
    }
    if !bus.silent_cells.is_empty() {
        rows.add_row("silent cells", comma_separated(node_id_ranges(&bus.silent_cells)), "");
    }
    let complete =
        format!("{} of {} complete", bus.epochs_complete, count_with_noun(bus.epochs_due, "epoch"));
    if let Some(sums) = &bus.sums {
        let parts = sums.contributions;
        let unexpected = parts.unasked - parts.contact_unknown;
        let is_brief = !is_verbose && parts.in_time == parts.due;
        add_due_rows(
            rows,
            "cells due in sums",
            parts.due,
            is_brief,
            complete,
            [parts.contact_unknown, unexpected],
        );
        if !is_brief {
            rows.add_row(
                "  in time",
                parts.in_time,
                format!("{} late, {} missing", parts.late, parts.missing),
            );
        }
        add_sum_rows(rows, bus, is_verbose);
    } else {
        let is_brief = !is_verbose && replies.in_time == replies.due;
        add_due_rows(
            rows,
            "replies due",
            replies.due,
            is_brief,
            complete,
            [replies.contact_unknown, replies.unexpected],
        );
        if !is_brief {
            rows.add_row("  replies in time", replies.in_time, format!("{} late", replies.late));
            let missing = replies.due - replies.in_time - replies.late;
            if is_verbose || missing > 0 {
                let [reasons @ .., _] =
                    replies.missing_replies_by_reason().map(|(why, count)| (count, key_words(why)));
                add_unexplained_row(
                    rows,
                    "  missing replies",
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
        rows.add_row(
            name,
            format_quantiles(&bus.last_reply_us),
            frames::last_reply_remark(bus, "by kernel time stamps"),
        );
        if bus.sums.is_none() {
            rows.add_row(
                "  each reply after broadcast, µs",
                format_quantiles(&bus.reply_us),
                "including late replies",
            );
        }
        frames::add_joint_age_row(rows, bus);
    } else if bus.last_reply_us.count > 0 {
        let name = if bus.sums.is_some() { "last sum, µs" } else { "last reply, µs" };
        rows.add_row(
            name,
            format_quantiles(&bus.last_reply_us),
            frames::last_reply_remark(bus, "after the joints message"),
        );
    }
}

/// Adds rows on sums, and on the tree that carries them.
fn add_sum_rows(rows: &mut KeyValueTable, bus: &BusSummary, is_verbose: bool) {
    let Some(sums) = &bus.sums else { return };
    let counts = sums.counts;
    if is_verbose || counts.resent + counts.overheard + counts.stale > 0 {
        let more = format!(
            "{} sent again, {} for other cells, {} too old",
            counts.resent, counts.overheard, counts.stale
        );
        rows.add_row(format!("sums from {}", count_with_noun(sums.roots, "root")), counts.first, more);
    }
    if is_verbose {
        let on_the_bus = counts.received + bus.uplink.unheard;
        let taken =
            format!("the gateway received {}; on a shared bus, all sums use bus time", counts.received);
        rows.add_row("sums on the bus, of all cells", on_the_bus, taken);
    }
    let Some(network) = &bus.network else { return };
    if is_verbose || network.tree_ready_s.is_none() {
        let tree_ready =
            or_else_text(network.tree_ready_s.map(|s| format!("complete in {s:.2} s")), "never complete");
        let changes = count_with_noun(network.parent_changes, "change");
        rows.add_row("tree depth, wires", network.deepest, format!("{tree_ready}, {changes} of parents"));
    }
    if !network.unreachable.is_empty() {
        rows.add_row("unreachable cells", space_separated(&network.unreachable), "no sum contains them");
    }
    for difference in &network.differences {
        rows.add_row("differs from the skin", difference, "");
    }
}

/// Adds a row whose last text is red if something is missing for an unknown reason.
fn add_unexplained_row(
    rows: &mut KeyValueTable,
    name: &str,
    value: impl Display,
    reasons: String,
    unknown: u64,
) {
    if unknown > 0 {
        rows.add_coloured_row(name, value, reasons, Color::Red);
    } else {
        rows.add_row(name, value, reasons);
    }
}

/// Adds rows on replies that were due, and on torques that were not due and so not compared, by reason.
fn add_due_rows(
    rows: &mut KeyValueTable,
    name: &str,
    due: u64,
    is_brief: bool,
    complete: String,
    [contact_unknown, unexpected]: [u64; 2],
) {
    let reasons = [
        (contact_unknown, "it is unknown whether the cells were touched"),
        (unexpected, "the cells were not touched"),
    ];
    let mut reasons = reasons.into_iter().filter(|(count, _)| *count > 0);
    let beside = if due == 0 { reasons.next() } else { None };
    match beside {
        Some((count, why)) => rows.add_row_in_one_line(name, due, &format!("{count} not due: {why}")),
        None if due == 0 => rows.add_row(name, due, "no cell was in contact"),
        None if is_brief => rows.add_row(name, format!("{due}, all in time"), complete),
        None => rows.add_row(name, due, complete),
    }
    for (count, why) in reasons {
        rows.add_row("  not due", count, why);
    }
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
    comma_separated(known.chain([format!("{unknown} of unknown cause")]))
}

/// Adds rows on the measuring cells of a bus, and on its most conspicuous cells.
fn add_noteworthy_cell_rows(rows: &mut KeyValueTable, bus: &BusSummary, all: &[CellSummary]) {
    let all = || all.iter().filter(|cell| cell.bus == bus.name);
    let measuring: Vec<_> = all().filter(|cell| cell.is_measuring()).map(|cell| cell.node).collect();
    if !measuring.is_empty() {
        rows.add_row(
            "cells in mode measure",
            space_separated(measuring),
            "own sensors, so torques were not compared",
        );
    }
    let unclear: Vec<_> =
        all().filter(|cell| cell.contact_unknown > 0 && !cell.is_measuring()).map(|cell| cell.node).collect();
    if !unclear.is_empty() {
        rows.add_row("contact unknown", space_separated(unclear), "cells with earlier stimuli or a baseline");
    }
    for cell in all().filter(|cell| !cell.stuck.is_empty()) {
        let kinds = cell.stuck.iter().map(|(kind, count)| format!("{count} equal {kind} words"));
        rows.add_row(
            format!("stuck: cell {}", cell.node),
            comma_separated(kinds),
            "although the expected words changed",
        );
    }
    let is_off = |cell: &CellSummary| cell.error.mean().is_some_and(|mean| mean > MAX_CELL_ERROR_NM);
    let rank =
        |cell: &CellSummary| (is_off(cell), cell.missing.values().sum::<u64>(), cell.late, cell.restarts);
    let mut worst: Vec<_> = all().filter(|cell| rank(cell) > (false, 0, 0, 0)).collect();
    worst.sort_by_key(|cell| Reverse(rank(cell)));
    for cell in worst.iter().take(MAX_LISTED_CELLS) {
        let CellSummary { due, in_time, late, restarts, .. } = **cell;
        let late = (late > 0).then(|| format!("{late} late"));
        let missing = cell.missing.iter().map(|(why, count)| format!("{count} {}", key_words(why)));
        let restarts = (restarts > 0).then(|| count_with_noun(restarts, "restart"));
        let error =
            cell.error.mean().filter(|_| is_off(cell)).map(|mean| format!("mean error {mean:.1e} Nm"));
        let why = late.into_iter().chain(missing).chain(restarts).chain(error);
        let in_time = (due > 0).then(|| format!("{in_time} of {due} replies in time"));
        rows.add_row(format!("cell {}", cell.node), or_else_text(in_time, ""), comma_separated(why));
    }
    let more = worst.len().saturating_sub(MAX_LISTED_CELLS);
    rows.add_row_unless_zero("further cells with problems", more as u64, "--summary lists each cell");
}

fn add_cost_rows(rows: &mut KeyValueTable, summary: &Summary, is_verbose: bool) {
    let ProcessorUse { gateway, cells, buses } = summary.processor;
    // Adding 0.0 turns -0.0 into 0.0.
    let [gateway, cells, buses] = [gateway, cells, buses].map(|cores| cores.max(0.0) + 0.0);
    let cores = format!("{:.3}", gateway + cells + buses);
    if is_verbose {
        rows.add_section("resources used", "", "");
        let parts = format!("gateway {gateway:.3}, cells {cells:.3}, bus servers {buses:.3}");
        rows.add_row("processor, cores", cores, parts);
        if let Some(kib) = summary.memory.cell_private_kib {
            rows.add_row("private memory of a cell process", format!("{kib} KiB"), "of the largest one");
        }
        if let Some(kib) = summary.memory.gateway_private_kib {
            let buses = summary.memory.buses_private_kib.map(|kib| format!("bus servers: {kib} KiB"));
            rows.add_row("private memory of the gateway", format!("{kib} KiB"), buses.unwrap_or_default());
        }
        rows.add_row("start to first broadcast", format!("{:.2} s", summary.first_broadcast_s), "");
    } else {
        rows.add_section("processor", format!("{cores} cores"), format!("{cells:.3} of them for cells"));
    }
    let Some(recording) = &summary.recording else { return };
    for file in &recording.files {
        let frames = count_with_noun(file.frames, "frame");
        let size = format_size(file.bytes);
        rows.add_section("recording", &file.path, format!("{frames}, {size}"));
    }
    if is_verbose || recording.lost > 0 || recording.files.is_empty() {
        rows.add_row("frames recorded", recording.frames, format!("{} lost", recording.lost));
    }
}

fn format_size(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} bytes"),
        10_000..10_000_000 => format!("{} KB", bytes / 1_000),
        _ => format!("{} MB", bytes / 1_000_000),
    }
}

#[cfg(test)]
mod tests;
