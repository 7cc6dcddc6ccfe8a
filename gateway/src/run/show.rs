//! The table at the end of a run.

use std::cmp::Reverse;
use std::fmt::Display;

use analysis::paper;
use bench::summary::{BusSummary, CellSummary, Halted, Outcome, Processor, Summary, ranges};
use model::table::Errors;

use crate::print::{Rows, count, list, or, quantiles, words};

/// Halts that are listed one by one.
const HALTS: usize = 10;

/// Cells of a bus that are told one by one, because they stand out.
const CELLS: usize = 5;
/// A mean error in Nm that rounding does not explain: four steps of a torque's word.
const OFF_NM: f64 = 4.0 / 4096.0;

/// The whole run.
pub(super) fn rows(summary: &Summary) -> Rows {
    let cells = format!("{}, {:.1} s", count(summary.cells.len(), "cell"), summary.duration_s);
    let (cells, ended) = match summary.halts.last().filter(|_| summary.outcome == Outcome::Halted) {
        Some(halted) => (cells, format!("halted at {:.3} s", halted.at_s)),
        None => (format!("{cells}, {}", summary.outcome), String::new()),
    };
    let mut rows = Rows::new(&summary.skin, cells, ended);
    halts(&mut rows, summary);
    for error in &summary.cell_errors {
        rows.section("ended by errors of their own", count(error.count(), "cell"), &error.reason);
        rows.row("cells", error.names(), "");
    }
    accuracy(&mut rows, summary);
    control(&mut rows, summary);
    for bus in &summary.buses {
        replies(&mut rows, bus);
        frames(&mut rows, bus);
        noteworthy(&mut rows, bus, &summary.cells);
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
        rows.section("halted", format!("{} more", count(more, "time")), "--summary has when and why");
    }
}

fn accuracy(rows: &mut Rows, summary: &Summary) {
    let accuracy = &summary.accuracy;
    let [single, sums] = [&accuracy.single, &accuracy.sums].map(|errors| errors.mean().is_some());
    if !single && !sums {
        return;
    }
    rows.section("accuracy", "mean (max) error, Nm", "distributed against central");
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
    rows.any("saturated words, left out", accuracy.saturated, "beyond the range of the torque format");
}

fn errors(errors: &Errors) -> String {
    errors.mean().map_or_else(
        || "nothing compared".to_owned(),
        |mean| format!("{mean:.2e} ({:.1e}), {} torques", errors.max(), errors.count()),
    )
}

fn control(rows: &mut Rows, summary: &Summary) {
    let control = &summary.control;
    rows.section("control loop", "50 % / 90 % / 99 % / max, µs", "");
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
    let why = "the bus did not take them, or this machine was busy";
    rows.any("frames not sent", control.unsent, why);
    rows.any("records of ticks lost", control.records_lost, why);
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
    rows.section(format!("{} ({})", bus.name, bus.kind), each(&bus.cells), "");
    if bus.outages.times > 0 {
        let end = if bus.outages.at_end { ", also at the end" } else { "" };
        let ticks = format!("{} ticks without it", bus.outages.ticks);
        let times = count(bus.outages.times, "time");
        rows.row("lost", format!("{times}, {:.1} s{end}", bus.outages.lost_s), ticks);
    }
    for it in &bus.hosts {
        let gone = (it.gone > 0).then(|| format!("gone {}, {:.1} s", count(it.gone, "time"), it.gone_s));
        let end = (!it.at_end).then(|| "not reached at the end".to_owned());
        let lost = list(
            [(it.lost_from, "from there"), (it.lost_to, "to there")]
                .map(|(n, way)| format!("{n} frames lost {way}")),
        );
        let cells = count(it.cells, "cell");
        rows.row(format!("host {}", it.name), list([cells].into_iter().chain(gone).chain(end)), lost);
    }
    if !bus.silent_cells.is_empty() {
        rows.row("silent cells", list(ranges(&bus.silent_cells)), "");
    }
    let complete = format!("{} of {} epochs complete", bus.epochs_complete, bus.epochs_due);
    if let Some(sums) = &bus.sums {
        let (counts, parts) = (sums.counts, sums.contributions);
        let unexpected = parts.unasked - parts.contact_unknown;
        due(rows, "cells due in sums", parts.due, complete, [parts.contact_unknown, unexpected]);
        rows.row("  in time", parts.in_time, format!("{} late, {} missing", parts.late, parts.missing));
        let more =
            format!("{} resent, {} overheard, {} stale", counts.resent, counts.overheard, counts.stale);
        rows.row(format!("sums from {}", count(sums.roots, "root")), counts.first, more);
        let on_the_bus = counts.received + bus.uplink.unheard;
        let taken =
            format!("the gateway took {}: the tree saves it frames, but not a shared bus", counts.received);
        rows.row("sums on the bus, of all cells", on_the_bus, taken);
        if let Some(network) = &bus.network {
            let tree_ready =
                network.tree_ready_s.map_or_else(|| "never complete".to_owned(), |s| format!("in {s:.2} s"));
            let changes = format!("{tree_ready}, {} changes of parents", network.parent_changes);
            rows.row("tree, wires deep", network.deepest, changes);
            if !network.unreachable.is_empty() {
                let unreachable = words(&network.unreachable);
                rows.row("unreachable cells", unreachable, "no sum contains them");
            }
            for difference in &network.differences {
                rows.row("not as described", difference, "");
            }
        }
        rows.row("last sum after broadcast, µs", quantiles(&bus.last_reply_us), "by kernel time stamps");
        hearing(rows, bus);
        return;
    }
    due(rows, "replies due", replies.due, complete, [replies.contact_unknown, replies.unexpected]);
    rows.row("  in time", replies.in_time, format!("{} late", replies.late));
    let missing = replies.due - replies.in_time - replies.late;
    let [reasons @ .., _] = replies.missing().map(|(why, count)| (count, spoken(why)));
    rows.row("  missing", missing, explained(&reasons, replies.unknown));
    rows.row("last reply after broadcast, µs", quantiles(&bus.last_reply_us), "by kernel time stamps");
    rows.row("  each reply, µs", quantiles(&bus.reply_us), "late ones included");
    hearing(rows, bus);
}

/// What was due, and torques that came and were not, which are not compared: by reason.
fn due(rows: &mut Rows, name: &str, due: u64, complete: String, [contact_unknown, unexpected]: [u64; 2]) {
    let reasons =
        [(contact_unknown, "their contact is not known"), (unexpected, "nothing touched their cells")];
    let mut reasons = reasons.into_iter().filter(|(count, _)| *count > 0);
    let beside = if due == 0 { reasons.next() } else { None };
    match beside {
        Some((count, why)) => rows.row_in_one_line(name, due, &format!("{count} not due: {why}")),
        None => rows.row(name, due, complete),
    }
    for (count, why) in reasons {
        rows.row("  not due", count, why);
    }
}

/// How late cells hear what stands on the bus.
fn hearing(rows: &mut Rows, bus: &BusSummary) {
    let why = "late here: the machine; lost above: the bus";
    rows.row("joints not yet taken at heartbeats, µs", quantiles(&bus.joints_not_taken_us), why);
}

/// A key of the summary in words.
fn spoken(key: &str) -> String {
    key.replace('_', " ")
}

/// How many there are of each kind.
fn each(kinds: impl IntoIterator<Item = (impl Display, impl Display)>) -> String {
    list(kinds.into_iter().map(|(kind, count)| format!("{count} {kind}")))
}

/// The reasons that there were, and always how many are unknown.
fn explained(reasons: &[(u64, impl Display)], unknown: u64) -> String {
    let known = reasons.iter().filter(|(count, _)| *count > 0);
    let known = known.map(|(count, why)| format!("{count} {why}"));
    list(known.chain([format!("{unknown} unknown")]))
}

/// The cells of a bus that measure, and the worst of those that stand out.
fn noteworthy(rows: &mut Rows, bus: &BusSummary, all: &[CellSummary]) {
    let all = || all.iter().filter(|cell| cell.bus == bus.name);
    let measuring: Vec<_> = all().filter(|cell| cell.measures()).map(|cell| cell.node).collect();
    if !measuring.is_empty() {
        rows.row("cells that measure", words(measuring), "not pressed, their torques not compared");
    }
    let unclear: Vec<_> =
        all().filter(|cell| cell.contact_unknown > 0 && !cell.measures()).map(|cell| cell.node).collect();
    if !unclear.is_empty() {
        rows.row("cells of unknown contact", words(unclear), "stimuli from before this run, or a baseline");
    }
    for cell in all().filter(|cell| !cell.stuck.is_empty()) {
        let kinds = cell.stuck.iter().map(|(kind, count)| format!("{count} times one {kind}"));
        rows.row(format!("stuck: cell {}", cell.node), list(kinds), "while it should have sent others");
    }
    let is_off = |cell: &CellSummary| cell.error.mean().is_some_and(|mean| mean > OFF_NM);
    let rank =
        |cell: &CellSummary| (is_off(cell), cell.missing.values().sum::<u64>(), cell.late, cell.restarts);
    let mut worst: Vec<_> = all().filter(|cell| rank(cell) > (false, 0, 0, 0)).collect();
    worst.sort_by_key(|cell| Reverse(rank(cell)));
    for cell in worst.iter().take(CELLS) {
        let CellSummary { due, in_time, late, restarts, .. } = **cell;
        let late = (late > 0).then(|| format!("{late} late"));
        let missing = cell.missing.iter().map(|(why, count)| format!("{count} {}", spoken(why)));
        let restarts = (restarts > 0).then(|| count(restarts, "restart"));
        let error =
            cell.error.mean().filter(|_| is_off(cell)).map(|mean| format!("mean error {mean:.1e} Nm"));
        let why = late.into_iter().chain(missing).chain(restarts).chain(error);
        let in_time = (due > 0).then(|| format!("{in_time} of {due} replies in time"));
        rows.row(format!("cell {}", cell.node), or(in_time, ""), list(why));
    }
    let more = worst.len().saturating_sub(CELLS);
    rows.any("further cells that stand out", more as u64, "--summary has each cell");
}

fn frames(rows: &mut Rows, bus: &BusSummary) {
    let up = &bus.uplink;
    let lost = up.dropped + up.backlog + up.outage + up.hosts + up.unknown;
    rows.row("packets sent by cells", up.sent, "by their own count");
    rows.row("  delivered", up.delivered, format!("{} rejected", up.rejected));
    rows.any("  for other cells", up.unheard, "sums that the gateway does not take");
    let reasons = [
        (up.dropped, "dropped by the bus"),
        (up.backlog, "by the kernel's backlog"),
        (up.outage, "with the bus"),
        (up.hosts, "between hosts"),
    ];
    rows.row("  lost", lost, explained(&reasons, up.unknown));
    rows.any("  surplus", up.surplus, "");
    rows.any("  of other senders", up.outsiders, "");
    rows.any("  in doubt", up.in_doubt, "");
    rows.any("  after the last heartbeat", up.unsettled, "");
    rows.any("  restarts of cells", up.restarts, "what they sent last is in doubt");
    rows.row("received", each(&bus.received), "");
    let sensors = &bus.sensors;
    if let (Some(min), Some(mean), Some(max)) = (sensors.min_hz, sensors.mean_hz, sensors.max_hz) {
        let touches = list([count(sensors.touches, "touch"), count(sensors.releases, "release")]);
        rows.row("  sensors of a cell, Hz", format!("{min:.1} / {mean:.1} / {max:.1}"), touches);
    }
    rows.row("sent", each(&bus.sent), "");
    if !bus.events.is_empty() {
        rows.row("odd", each(&bus.events), "");
    }
}

fn costs(rows: &mut Rows, summary: &Summary) {
    let Processor { gateway, cells, buses } = summary.processor;
    rows.section("cost", "", "");
    let parts = format!("gateway {gateway:.3}, cells {cells:.3}, buses {buses:.3}");
    rows.row("processor, cores", format!("{:.3}", gateway + cells + buses), parts);
    if let Some(kib) = summary.memory.cell_private_kib {
        rows.row("private memory of a cell process", format!("{kib} KiB"), "the largest");
    }
    if let Some(kib) = summary.memory.gateway_private_kib {
        let buses = summary.memory.buses_private_kib.map(|kib| format!("its servers of buses {kib} KiB"));
        rows.row("private memory of the gateway", format!("{kib} KiB"), buses.unwrap_or_default());
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
