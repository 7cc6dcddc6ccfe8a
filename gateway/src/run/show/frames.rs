//! The rows about frames and packets on a bus.

use std::collections::BTreeMap;

use bench::summary::BusSummary;
use model::table::CellStatus;

use super::{add_unexplained_row, counts_by_kind, format_quantiles, reasons_text};
use crate::print::{KeyValueTable, comma_separated, count_with_noun};

/// Formats the numbers of cells by their status at the end of the run.
pub(super) fn cells_by_status(cells: &BTreeMap<&'static str, usize>) -> String {
    let words = [
        (CellStatus::Active, "in contact"),
        (CellStatus::Quiet, "not in contact"),
        (CellStatus::Stale, "in contact without a reply"),
    ];
    counts_by_kind(cells.iter().map(|(&name, count)| {
        let words = words.iter().find(|(status, _)| status.name() == name).map_or(name, |(_, words)| words);
        (words, count)
    }))
}

pub(super) fn add_frame_rows(rows: &mut KeyValueTable, bus: &BusSummary, is_verbose: bool) {
    let up = &bus.uplink;
    let lost = up.dropped + up.backlog + up.outage + up.hosts + up.queues + up.unknown;
    let odd = up.rejected + up.surplus + up.outsiders + up.in_doubt + u64::from(up.restarts);
    if is_verbose || lost + odd > 0 {
        add_packet_rows(rows, bus, lost);
    } else {
        rows.add_row("packets of cells", up.sent, "none lost");
    }
    if is_verbose {
        rows.add_row("received", counts_by_kind(&bus.received), "");
    }
    let sensors = &bus.sensors;
    if let (Some(min), Some(mean), Some(max)) = (sensors.min_hz, sensors.mean_hz, sensors.max_hz) {
        let touches = comma_separated([
            count_with_noun(sensors.touches, "touch"),
            count_with_noun(sensors.releases, "release"),
        ]);
        rows.add_row("  sensor frames per cell, Hz", format!("{min:.1} / {mean:.1} / {max:.1}"), touches);
    }
    if is_verbose {
        rows.add_row("sent", counts_by_kind(&bus.sent), "");
    }
    if !bus.events.is_empty() {
        rows.add_row("anomalies", counts_by_kind(&bus.events), "");
    }
}

/// Adds rows on the frames of a timed bus.
pub(super) fn add_timed_rows(rows: &mut KeyValueTable, bus: &BusSummary, is_verbose: bool) {
    let Some(timed) = &bus.timed else { return };
    let load = timed.load.map_or_else(|| "-".to_owned(), |load| format!("{:.1} %", load * 100.0));
    rows.add_row("  bus load", load, format!("at {}; transmit queues: {}", timed.rates, timed.queue));
    rows.add_row(
        "  time of a frame, µs",
        format_quantiles(&timed.wait_us),
        "from its send request to its end",
    );
    if is_verbose || timed.behind > 0 {
        let behind = format!(
            "from the frame's end to the receivers; {} over 1 ms",
            count_with_noun(timed.behind, "time")
        );
        rows.add_row("  delivery, µs", format_quantiles(&timed.delay_us), behind);
    }
    rows.add_row_unless_zero("  damaged frames", timed.damaged, "sent again");
    rows.add_row_unless_zero("  refused frames", timed.refused, "a transmit queue was full");
}

/// Returns the remark on the time of the last reply: its upper bound on a timed bus, and else this one.
pub(super) fn last_reply_remark(bus: &BusSummary, untimed: &str) -> String {
    match (&bus.timed, bus.last_reply_bound_us) {
        (None, _) => untimed.to_owned(),
        (Some(_), Some(bound)) => format!("after the joints message; at most {bound:.0} by `skinbus fit`"),
        (Some(_), None) => "after the joints message; fit has no bound".to_owned(),
    }
}

/// Adds a row on the age of joints that cells have not yet processed.
pub(super) fn add_joint_age_row(rows: &mut KeyValueTable, bus: &BusSummary) {
    let why = "at each heartbeat; large: machine busy, or frames lost";
    rows.add_row("age of joints not yet processed, µs", format_quantiles(&bus.joints_not_taken_us), why);
}

/// Adds rows on the packets from the cells, by what became of them.
fn add_packet_rows(rows: &mut KeyValueTable, bus: &BusSummary, lost: u64) {
    let up = &bus.uplink;
    rows.add_row("packets sent by cells", up.sent, "according to their own counters");
    rows.add_row("  delivered", up.delivered, format!("{} rejected", up.rejected));
    rows.add_row_unless_zero(
        "  sums sent from cell to cell",
        up.unheard,
        "the gateway does not listen to them",
    );
    let reasons = [
        (up.dropped, "dropped by the bus"),
        (up.backlog, "dropped by the kernel's backlog"),
        (up.outage, "lost with the bus"),
        (up.hosts, "lost between hosts"),
        (up.queues, "refused by transmit queues"),
    ];
    add_unexplained_row(rows, "  lost", lost, reasons_text(&reasons, up.unknown), up.unknown);
    rows.add_row_unless_zero("  surplus", up.surplus, "more than the cells sent");
    rows.add_row_unless_zero("  from other senders", up.outsiders, "");
    rows.add_row_unless_zero("  in doubt", up.in_doubt, "sent just before a restart");
    rows.add_row_unless_zero("  after the last heartbeat", up.unsettled, "");
    rows.add_row_unless_zero("  restarts of cells", up.restarts, "packets sent just before may be lost");
}
