//! Verdict on a run: all is well, or a list of findings.
//!
//! The verdict is a pure function of the other figures of the [`Summary`]. A run is well only if everything that can be
//! checked was checked: a run without contact, or without a comparison, has a finding.

use std::collections::BTreeMap;

use model::listing::node_id_ranges;
use model::table::FrameEvent;
use serde::Serialize;

use super::{BusSummary, CellSummary, Outcome, RepliesSummary, Summary, cells_in_error};

/// Maximum mean error of one cell's torques in Nm that rounding explains: four steps of a torque's word. A correct cell
/// has a tenth of this error.
pub const MAX_CELL_ERROR_NM: f64 = 4.0 / 4_096.0;
/// Maximum mean error of sums along a tree in Nm that rounding explains: four steps of a sum's word.
const MAX_SUM_ERROR_NM: f64 = 4.0 / 256.0;
/// Names under which the summary counts events that have a finding of their own.
const SATURATED_EVENT_NAME: &str = FrameEvent::Saturated.name();
const STALE_TORQUE_EVENT_NAME: &str = FrameEvent::StaleTorque.name();
/// Maximum number of groups of node ids in a list; further groups are only counted.
const MAX_LISTED_NODE_RANGES: usize = 12;

/// Verdict on a run.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Verdict {
    /// True if the run came to its end, everything was checked, and no problem was found.
    pub well: bool,
    /// Findings, the most important first; empty if all is well.
    pub look_at: Vec<String>,
}

impl Verdict {
    /// Returns the verdict on a run, computed from the other figures of its summary.
    #[must_use]
    pub fn new(summary: &Summary) -> Self {
        let mut look_at = Vec::new();
        add_ending_findings(&mut look_at, summary);
        let buses = || summary.buses.iter();
        add_absence_findings(&mut look_at, summary);
        buses().for_each(|bus| add_unexplained_losses(&mut look_at, bus));
        buses().for_each(|bus| add_network_findings(&mut look_at, bus));
        add_torque_findings(&mut look_at, summary);
        add_restart_findings(&mut look_at, summary);
        add_recording_findings(&mut look_at, summary);
        buses().for_each(|bus| add_explained_losses(&mut look_at, bus));
        add_unchecked_findings(&mut look_at, summary);
        add_control_findings(&mut look_at, summary);
        buses().for_each(|bus| add_late_replies(&mut look_at, bus));
        buses().for_each(|bus| add_incomplete_epochs(&mut look_at, bus));
        add_tick_findings(&mut look_at, summary);
        buses().for_each(|bus| add_irregular_frames(&mut look_at, bus));
        let ended_well = matches!(summary.outcome, Outcome::Done | Outcome::Interrupted);
        if look_at.is_empty() && !ended_well {
            look_at.push(format!("the outcome of the run is \"{}\"", summary.outcome));
        }
        Self { well: look_at.is_empty(), look_at }
    }
}

impl Summary {
    /// Returns the totals of a run that is well, in one line.
    #[must_use]
    pub fn totals_line(&self) -> String {
        let of = |figure: fn(&BusSummary) -> u64| self.buses.iter().map(figure).sum::<u64>();
        let (complete, due) = (of(|bus| bus.epochs_complete), of(|bus| bus.epochs_due));
        let on = match self.buses.len() {
            0 | 1 => String::new(),
            buses => format!(" on {buses} buses"),
        };
        let mut parts = vec![
            count_noun(self.cells.len(), "cell", "cells"),
            format!("{complete} of {} complete{on}", count_noun(due, "epoch", "epochs")),
        ];
        let replies = of(|bus| bus.replies.in_time);
        if replies > 0 {
            parts.push(format!("{} in time", count_noun(replies, "reply", "replies")));
        }
        let contributions = of(|bus| bus.sums.map_or(0, |sums| sums.contributions.in_time));
        if contributions > 0 {
            parts.push(format!(
                "{} in time",
                count_noun(contributions, "contribution to sums", "contributions to sums")
            ));
        }
        let accuracy = &self.accuracy;
        let error = accuracy.single.mean().or_else(|| accuracy.sums.mean());
        parts.extend(error.map(|mean| format!("mean error {mean:.1e} Nm")));
        parts.join(", ")
    }
}

/// Formats a count with its noun in the singular or plural.
pub(crate) fn count_noun(count: impl TryInto<u64>, one: &str, more: &str) -> String {
    let count = count.try_into().unwrap_or(u64::MAX);
    format!("{count} {}", if count == 1 { one } else { more })
}

/// Formats the number of times that an event happened: `once`, `3 times`.
fn occurrence_count_text(count: u64) -> String {
    if count == 1 { "once".to_owned() } else { format!("{count} times") }
}

/// Formats cells of a bus: `cell 3 on vcan0`, `cells 1-4, 6 on vcan0`.
fn cell_names(nodes: &[u8], bus: &str) -> String {
    let all = node_id_ranges(nodes);
    let noun = if nodes.len() == 1 { "cell" } else { "cells" };
    match all.get(..MAX_LISTED_NODE_RANGES).filter(|_| all.len() > MAX_LISTED_NODE_RANGES) {
        Some(first) => format!("{} cells ({}, ...) on {bus}", nodes.len(), first.join(", ")),
        None => format!("{noun} {} on {bus}", all.join(", ")),
    }
}

/// Lists the cells for which a condition holds, by bus.
fn cells_where(summary: &Summary, holds: impl Fn(&CellSummary) -> bool) -> Vec<String> {
    let mut buses = BTreeMap::<&str, Vec<u8>>::new();
    for cell in summary.cells.iter().filter(|cell| holds(cell)) {
        buses.entry(&cell.bus).or_default().push(cell.node);
    }
    for nodes in buses.values_mut() {
        nodes.sort_unstable();
    }
    buses.into_iter().map(|(bus, nodes)| cell_names(&nodes, bus)).collect()
}

/// Lists counts with their nouns, without counts of 0.
fn nonzero_counts<'a>(counts: impl IntoIterator<Item = (u64, &'a str)>) -> Vec<String> {
    let counts = counts.into_iter().filter(|(count, _)| *count > 0);
    counts.map(|(count, what)| format!("{count} {what}")).collect()
}

/// Returns true if the value is above the limit or is not a number.
fn is_above(value: f64, limit: f64) -> bool {
    value.is_nan() || value > limit
}

/// Adds findings on a run that ended early or badly.
fn add_ending_findings(look_at: &mut Vec<String>, summary: &Summary) {
    look_at.extend(summary.failure.as_ref().map(|failure| format!("the run failed: {failure}")));
    if let Some(why) = &summary.halted {
        let at = summary.halts.last().map_or_else(String::new, |halt| format!(" at {:.3} s", halt.at_s));
        look_at.push(format!(
            "the robot was halted{at} and not resumed: {why}; before_halt in --summary FILE lists the ticks before it"
        ));
    }
    look_at.extend(summary.no_controller.clone());
    look_at.extend(cells_in_error(&summary.cell_errors, true));
}

/// Adds findings on buses that were lost, and on cells that were silent at the end.
fn add_absence_findings(look_at: &mut Vec<String>, summary: &Summary) {
    for bus in summary.buses.iter().filter(|bus| bus.outages.times > 0) {
        let end = if bus.outages.at_end { ", also at the end" } else { "" };
        look_at.push(format!(
            "{} was lost {} for {:.1} s in total{end}: the torques of its cells decayed to zero",
            bus.name,
            occurrence_count_text(bus.outages.times),
            bus.outages.lost_s
        ));
    }
    for bus in summary.buses.iter().filter(|bus| !bus.silent_cells.is_empty()) {
        look_at.push(format!(
            "{}: stopped sending, or never sent; check that each cell is running and wired",
            cell_names(&bus.silent_cells, &bus.name)
        ));
    }
    // A receiver that panicked has left no figures of its bus.
    let is_known = |cell: &CellSummary| summary.buses.iter().any(|bus| bus.name == cell.bus);
    if summary.failure.is_none() {
        let unknown = cells_where(summary, |cell| !is_known(cell));
        look_at
            .extend(unknown.into_iter().map(|cells| format!("{cells}: the run has no results of this bus")));
    }
    for host in summary.buses.iter().flat_map(|bus| &bus.hosts) {
        let lost = host.lost_from + host.lost_to;
        let gone = (host.gone > 0).then(|| {
            format!("unreachable {} for {:.1} s in total", occurrence_count_text(host.gone), host.gone_s)
        });
        let end = (!host.at_end).then(|| "unreachable at the end".to_owned());
        let lost = (lost > 0).then(|| format!("{} lost", count_noun(lost, "frame", "frames")));
        let parts: Vec<_> = [gone, end, lost].into_iter().flatten().collect();
        if !parts.is_empty() {
            look_at.push(format!(
                "host {}: {}; `vcan-setup status` shows its link",
                host.name,
                parts.join(", ")
            ));
        }
    }
}

/// Adds findings on replies and packets that are missing for an unknown reason.
fn add_unexplained_losses(look_at: &mut Vec<String>, bus: &BusSummary) {
    let (name, replies, up) = (&bus.name, &bus.replies, &bus.uplink);
    if replies.unknown > 0 {
        look_at.push(format!(
            "{} missing on {name} for no known reason (unknown): cells[].missing in --summary FILE lists the cells",
            count_noun(replies.unknown, "reply", "replies")
        ));
    }
    if up.unknown > 0 {
        look_at.push(format!(
            "{} of cells on {name} lost for no known reason (unknown): check the wiring and the load of the bus",
            count_noun(up.unknown, "packet", "packets")
        ));
    }
    if let Some(parts) = bus.sums.map(|sums| sums.contributions).filter(|parts| parts.missing > 0) {
        look_at.push(format!(
            "{} of {} were missing on {name}: a cell had no route to the gateway, sums were lost, or the machine was \
             busy",
            parts.missing,
            count_noun(parts.due, "contribution to sums", "contributions to sums")
        ));
    }
}

/// Adds findings on trees that differ from the description.
fn add_network_findings(look_at: &mut Vec<String>, bus: &BusSummary) {
    let Some(network) = &bus.network else { return };
    if !network.unreachable.is_empty() {
        look_at.push(format!(
            "{}: no route to the gateway at the end, so no sum contains their torques; check their wires",
            cell_names(&network.unreachable, &bus.name)
        ));
    } else if network.tree_ready_s.is_none() {
        look_at.push(format!("the tree on {} was not complete when the run began", bus.name));
    }
    for difference in &network.differences {
        look_at.push(format!("{} differs from the skin: {difference}", bus.name));
    }
}

/// Adds findings on wrong torques.
fn add_torque_findings(look_at: &mut Vec<String>, summary: &Summary) {
    let accuracy = &summary.accuracy;
    let is_off = |cell: &CellSummary| cell.error.mean().is_some_and(|mean| is_above(mean, MAX_CELL_ERROR_NM));
    for cells in cells_where(summary, is_off) {
        look_at.push(format!(
            "{cells}: mean error above {MAX_CELL_ERROR_NM:.1e} Nm, more than rounding explains; check the parameters"
        ));
    }
    let of_all = [
        ("the cells' torques", &accuracy.single, MAX_CELL_ERROR_NM),
        ("the sums", &accuracy.sums, MAX_SUM_ERROR_NM),
    ];
    for (what, errors, limit) in of_all {
        if let Some(mean) = errors.mean().filter(|mean| is_above(*mean, limit)) {
            look_at.push(format!(
                "the mean error of {what} is {mean:.1e} Nm, but rounding explains at most {limit:.1e} Nm"
            ));
        }
    }
    let saturated: u64 = summary.buses.iter().filter_map(|bus| bus.events.get(SATURATED_EVENT_NAME)).sum();
    if saturated > 0 {
        look_at.push(format!(
            "{} saturated: too large for the torque format, and therefore not compared",
            count_noun(saturated, "torque", "torques")
        ));
    } else if accuracy.saturated > 0 {
        look_at.push(format!(
            "{} saturated, and therefore not compared",
            count_noun(accuracy.saturated, "torque word", "torque words")
        ));
    }
    for cells in cells_where(summary, |cell| !cell.stuck.is_empty()) {
        look_at.push(format!("{cells}: stuck, sent constant values while the expected values changed"));
    }
    for bus in &summary.buses {
        let parts = bus.sums.map(|sums| sums.contributions);
        let in_sums = parts.map_or(0, |parts| parts.unasked.saturating_sub(parts.contact_unknown));
        let RepliesSummary { unexpected, .. } = bus.replies;
        if unexpected + in_sums > 0 {
            look_at.push(format!(
                "{} on {} not compared, because the cells were not touched or were halted",
                count_noun(unexpected + in_sums, "torque", "torques"),
                bus.name
            ));
        }
    }
}

/// Adds findings on restarts of cells, and on halts that have ended.
fn add_restart_findings(look_at: &mut Vec<String>, summary: &Summary) {
    for cells in cells_where(summary, |cell| cell.restarts > 0) {
        look_at.push(format!(
            "{cells}: restarted; it is unknown whether replies that were due at that time were sent"
        ));
    }
    for bus in &summary.buses {
        let of_cells = summary.cells.iter().filter(|cell| cell.bus == bus.name).map(|cell| cell.restarts);
        let others = bus.uplink.restarts.saturating_sub(of_cells.sum());
        if others > 0 {
            look_at.push(format!(
                "{} on {}",
                count_noun(others, "restart of a cell", "restarts of cells"),
                bus.name
            ));
        }
    }
    let halts = summary.halts.len() as u64 + summary.further_halts;
    let ended = halts.saturating_sub(summary.halted.is_some().into());
    if ended > 0 {
        let why = summary.halts.first().map_or("", |halt| &halt.reason);
        look_at.push(format!(
            "the robot was halted {} and resumed; the reason for the first halt: {why}",
            occurrence_count_text(ended)
        ));
    }
}

fn add_recording_findings(look_at: &mut Vec<String>, summary: &Summary) {
    let Some(recording) = &summary.recording else { return };
    let messages = recording.messages_lost.values().sum::<u64>();
    // If the run failed, its error already names the file that could not be written.
    if recording.lost + messages > 0 && summary.failure.is_none() {
        look_at.push(format!(
            "the recording is incomplete: it lacks {} and {}, because this machine was busy or its disk is slow",
            count_noun(recording.lost, "frame", "frames"),
            count_noun(messages, "other message", "other messages")
        ));
    }
}

/// Adds findings on losses whose reason is known.
fn add_explained_losses(look_at: &mut Vec<String>, bus: &BusSummary) {
    let (name, replies, up) = (&bus.name, &bus.replies, &bus.uplink);
    let reasons = [
        (replies.lost, "lost on the way to the gateway"),
        (replies.not_heard, "not sent, because the cell did not receive the joints message"),
        (replies.refused, "refused by the transmit queues of the timed bus"),
        (replies.in_doubt, "uncertain, because the cell was silent or restarted, or the bus was lost"),
    ];
    let missing = nonzero_counts(reasons);
    if !missing.is_empty() {
        look_at.push(format!("replies missing on {name}: {}", missing.join(", ")));
    }
    let reasons = [
        (up.dropped, "dropped by the bus, because this machine did not read them in time"),
        (up.backlog, "dropped by the kernel's backlog (net.core.netdev_max_backlog)"),
        (up.outage, "lost while the bus was down"),
        (up.hosts, "lost between hosts"),
        (up.queues, "refused by the transmit queues of the timed bus"),
        (up.rejected, "damaged"),
        (up.in_doubt, "uncertain, because the cell restarted afterwards"),
        (up.surplus, "more than the cells sent: duplicates, or from another sender"),
    ];
    let packets = nonzero_counts(reasons);
    if !packets.is_empty() {
        look_at.push(format!("packets from cells on {name}: {}", packets.join(", ")));
    }
    if bus.dropped_by_bus > up.dropped {
        look_at.push(format!(
            "{name} dropped {}, from cells or other senders, because this machine did not read them in time",
            count_noun(bus.dropped_by_bus - up.dropped, "frame", "frames")
        ));
    }
}

fn add_control_findings(look_at: &mut Vec<String>, summary: &Summary) {
    let control = &summary.control;
    let bad = control.bad_cycles.values().sum::<u64>();
    if bad > 0 {
        let worst = control.bad_cycles.iter().max_by_key(|(_, count)| **count);
        let why = worst.map_or("", |(reason, _)| reason);
        look_at.push(format!(
            "{}, mostly because {why}",
            count_noun(bad, "bad control cycle", "bad control cycles")
        ));
    }
    if control.unsent > 0 {
        let frames = count_noun(control.unsent, "frame", "frames");
        look_at.push(format!("the gateway could not send {frames}, because a bus refused them"));
    }
    if control.records_lost > 0 {
        let records = count_noun(control.records_lost, "record of a tick", "records of ticks");
        look_at.push(format!(
            "{records} missing in the figures of the control loop, because this machine was busy"
        ));
    }
}

/// Adds a finding on skipped ticks.
fn add_tick_findings(look_at: &mut Vec<String>, summary: &Summary) {
    let control = &summary.control;
    if control.ticks_skipped > 0 {
        let fifo = if control.fifo { "" } else { " (SCHED_FIFO was refused)" };
        let joints = match control.broadcasts_skipped {
            0 => String::new(),
            joints => format!(", {joints} of them with a joints message"),
        };
        look_at.push(format!(
            "the control loop skipped {} of {}{joints}: this machine was busy{fifo}",
            control.ticks_skipped,
            count_noun(control.ticks + control.ticks_skipped, "tick", "ticks")
        ));
    }
}

/// Adds findings on late replies, and on replies of cells that received the joints too late.
fn add_late_replies(look_at: &mut Vec<String>, bus: &BusSummary) {
    let RepliesSummary { due, late, too_late, skipped, .. } = bus.replies;
    let parts = nonzero_counts([
        (late + too_late, "late"),
        (skipped, "skipped, because joints messages reached the cells late"),
    ]);
    if !parts.is_empty() {
        look_at.push(format!(
            "{} on {}: {}; {}; -v shows the times",
            count_noun(due, "reply due", "replies due"),
            bus.name,
            parts.join(", "),
            bus.lateness_cause()
        ));
    }
    if let Some(parts) = bus.sums.map(|sums| sums.contributions).filter(|parts| parts.late > 0) {
        look_at.push(format!(
            "{} of {} were late on {}: this machine was busy, or the tree is deep",
            parts.late,
            count_noun(parts.due, "contribution to sums", "contributions to sums"),
            bus.name
        ));
    }
}

/// Adds a finding on incomplete epochs that late or missing replies do not explain.
fn add_incomplete_epochs(look_at: &mut Vec<String>, bus: &BusSummary) {
    let parts = bus.sums.map(|sums| sums.contributions);
    let explained =
        bus.replies.due > bus.replies.in_time || parts.is_some_and(|parts| parts.due > parts.in_time);
    let missing = bus.epochs_due.saturating_sub(bus.epochs_complete);
    if missing > 0 && !explained {
        look_at.push(format!(
            "{} of {} were not complete on {}",
            missing,
            count_noun(bus.epochs_due, "epoch", "epochs"),
            bus.name
        ));
    }
}

/// Adds a finding on irregular frames, except those reported above: saturated torques and torques that came too late.
fn add_irregular_frames(look_at: &mut Vec<String>, bus: &BusSummary) {
    let odd = bus.events.iter().map(|(name, count)| match *name {
        SATURATED_EVENT_NAME => (0, SATURATED_EVENT_NAME),
        STALE_TORQUE_EVENT_NAME => (count.saturating_sub(bus.replies.too_late), STALE_TORQUE_EVENT_NAME),
        name => (*count, name),
    });
    let odd = nonzero_counts(odd);
    if !odd.is_empty() {
        look_at.push(format!(
            "anomalies on {}: {}; `skinbus dump` shows the frames",
            bus.name,
            odd.join(", ")
        ));
    }
}

/// Adds findings on everything that the run could not check.
fn add_unchecked_findings(look_at: &mut Vec<String>, summary: &Summary) {
    for cells in cells_where(summary, |cell| cell.contact_unknown > 0 && !cell.is_measuring()) {
        look_at.push(format!(
            "{cells}: contact unknown, because of stimuli from before this run or a baseline; torques not compared"
        ));
    }
    for cells in cells_where(summary, CellSummary::is_measuring) {
        look_at.push(format!(
            "{cells}: in mode \"measure\" and not pressed by the scenario; torques not compared"
        ));
    }
    // If the run failed early, its error is already in the list.
    if summary.failure.is_some() {
        return;
    }
    let due = |bus: &BusSummary| bus.replies.due + bus.sums.map_or(0, |sums| sums.contributions.due);
    let compared = summary.accuracy.single.count() + summary.accuracy.sums.count();
    if summary.buses.iter().map(due).sum::<u64>() == 0 {
        look_at.push(
            "no torque was due, because no cell was in contact: use --scenario FILE to touch cells"
                .to_owned(),
        );
    } else if compared == 0 {
        look_at.push(
            "no torque was compared with the central computation: none arrived in time while the mode was \"compare\""
                .to_owned(),
        );
    }
}

#[cfg(test)]
mod tests;
