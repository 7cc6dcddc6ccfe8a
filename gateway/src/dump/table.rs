//! Statistics of a capture as tables.

use std::collections::BTreeMap;

use analysis::stats::{
    BusReport, CellReport, EpochStatistics, ForeignFrames, ForeignId, FrameType, StatsReport,
};
use comfy_table::Table;
use model::decode::error_classes;
use protocol::usage::printable;
use trace::capture::{RecordingExtras, Topic};

use crate::print::{
    self, KeyValueTable, comma_separated, drop_empty_columns, format_decimals, or_else_text, space_separated,
};

/// Formats the whole report: the capture, each bus, and each bus's cells.
pub(super) fn report_text(
    name: &str,
    what: &str,
    report: &StatsReport,
    extras: Option<&RecordingExtras>,
) -> String {
    let head = format!("{what}, {:.3} s", report.duration_s);
    let mut rows = KeyValueTable::new(name, head, print::count_with_noun(report.frames, "frame"));
    rows.add_row_unless_zero("frames out of order", report.times_backwards, "earlier than the frame before");
    rows.add_row_unless_zero("not recorded", report.dropped, "lost by the recorder");
    rows.add_row_unless_zero(
        "frames of other buses",
        report.frames_of_other_buses,
        "only the first 64 \
                                                                                       buses are shown",
    );
    for bus in &report.buses {
        bus_rows(&mut rows, bus, report.duration_s);
    }
    if let Some(extras) = extras {
        add_extra_rows(&mut rows, extras);
    }
    let mut text = rows.to_text();
    for bus in &report.buses {
        if !bus.cells.is_empty() {
            text += &format!("\n{}\n", cell_table(bus));
        }
        if bus.foreign.frames > 0 {
            text += &format!("\n{}\n", foreign_identifier_table(bus));
        }
    }
    text
}

/// Shortest time span in s over which a rate is shown.
const MIN_RATE_SPAN_S: f64 = 1e-3;

/// Returns a rate if its time span is long enough.
fn shown_rate(rate: Option<f64>, span_s: f64) -> Option<f64> {
    rate.filter(|_| span_s >= MIN_RATE_SPAN_S)
}

/// A rate with the time span that it covers.
fn rate_text(rate: Option<f64>, span_s: f64) -> String {
    or_else_text(shown_rate(rate, span_s).map(|rate| format!("{rate:.1} per s over {span_s:.3} s")), "")
}

fn bus_rows(rows: &mut KeyValueTable, bus: &BusReport, duration_s: f64) {
    rows.add_section(
        &bus.bus,
        print::count_with_noun(bus.frames, "frame"),
        rate_text(bus.frames_per_s, duration_s),
    );
    for kind in &bus.kinds {
        rows.add_row(kind.kind, kind.packets, rate_text(kind.packets_per_s, kind.span_s));
    }
    let EpochStatistics { first, last, missing, repeated, jumps } = bus.epochs;
    if let (Some(first), Some(last)) = (first, last) {
        let odd = [(missing, "missing"), (repeated, "repeated"), (jumps, "restarts")];
        let odd = comma_separated(odd.map(|(count, what)| format!("{count} {what}")));
        rows.add_row("epochs", format!("{first} to {last}"), odd);
    }
    let rate = Some(rate_text(bus.wires_per_s, bus.wires_span_s)).filter(|rate| !rate.is_empty());
    let rate = or_else_text(rate.map(|rate| format!("{rate}; ")), "");
    rows.add_row_unless_zero("simulated wires", bus.wires, format!("{rate}a real bus has none"));
    let refused: Vec<_> =
        bus.refused.counts_by_reason().into_iter().filter(|(_, count)| *count > 0).collect();
    let reasons = comma_separated(refused.iter().map(|(reason, count)| format!("{count} {reason}")));
    rows.add_row("damaged or invalid", refused.iter().map(|(_, count)| count).sum::<u64>(), reasons);
    let ForeignFrames { standard, extended, remote, error, packets_by_chance, .. } = bus.foreign;
    rows.add_row("foreign", bus.foreign.frames, "");
    rows.add_row_unless_zero("  11-bit identifiers", standard, "");
    rows.add_row_unless_zero("  29-bit identifiers", extended, "");
    rows.add_row_unless_zero("  remote frames", remote, "");
    rows.add_row_unless_zero("  error frames", error, comma_separated(error_counts(&bus.foreign)));
    if packets_by_chance >= 0.05 {
        let chance = format!("{packets_by_chance:.1}");
        rows.add_row("  valid CRC by chance", chance, "expected number");
    }
    let why = if bus.dropped > 0 { "lost by the recorder" } else { "" };
    rows.add_row("not recorded", bus.dropped, why);
}

/// Adds rows on the contents of an MCAP recording other than frames.
fn add_extra_rows(rows: &mut KeyValueTable, extras: &RecordingExtras) {
    if !extras.topics.is_empty() {
        rows.add_section("other topics", "messages", "");
    }
    for Topic { name, schema, messages } in &extras.topics {
        rows.add_row(name, messages, schema);
    }
    if !extras.attachments.is_empty() {
        rows.add_section("attachments", "bytes", "");
    }
    for (name, bytes) in &extras.attachments {
        rows.add_row(name, bytes.len(), "");
    }
}

/// Counts error frames by class; one frame may report several classes.
fn error_counts(foreign: &ForeignFrames) -> Vec<String> {
    let mut counts = BTreeMap::<&str, u64>::new();
    for id in foreign.identifiers.iter().filter(|id| id.of == FrameType::Error) {
        for class in u32::from_str_radix(&id.id, 16).into_iter().flat_map(error_classes) {
            *counts.entry(class).or_default() += id.frames;
        }
    }
    counts.into_iter().map(|(class, count)| format!("{count} {class}")).collect()
}

/// Maximum number of foreign identifiers shown; --json has all.
const MAX_FOREIGN: usize = 40;

/// Formats a table with one line per foreign identifier, the most frequent ones first.
fn foreign_identifier_table(bus: &BusReport) -> Table {
    let head =
        [&format!("{} foreign", printable(&bus.bus)), "frames", "per s", "over s", "first s", "bytes", ""];
    let line = |id: &ForeignId| {
        let (min, most) = (id.bytes_min, id.bytes_max);
        let bytes = if min == most { min.to_string() } else { format!("{min}..{most}") };
        let what = match id.of {
            FrameType::Data if id.wrong_crc > 0 => format!("{} wrong CRC", id.wrong_crc),
            FrameType::Data => String::new(),
            FrameType::Remote => "remote".to_owned(),
            FrameType::Error => "error".to_owned(),
        };
        let first = format!("{:.3}", id.first_s);
        let span_s = id.last_s - id.first_s;
        let rate = shown_rate(id.frames_per_s, span_s);
        let (per_s, in_s) = (format_decimals(rate, 1, ""), format_decimals(rate.map(|_| span_s), 3, ""));
        vec![id.id.clone(), id.frames.to_string(), per_s, in_s, first, bytes, what]
    };
    let ForeignFrames { identifiers, frames_of_other_identifiers: unknown, .. } = &bus.foreign;
    let mut lines: Vec<_> = identifiers.iter().take(MAX_FOREIGN).map(line).collect();
    let further = identifiers.iter().skip(MAX_FOREIGN);
    let count = further.len();
    let frames = further.map(|id| id.frames).sum::<u64>() + unknown;
    if frames > 0 {
        let more = if *unknown > 0 { "more than " } else { "" };
        lines.push(vec![format!("{more}{count} further"), frames.to_string()]);
    }
    print::table(head, lines, |column| column < 6)
}

/// A column: its header, and the text of a cell if it has a value.
type Column<'a> = (&'a str, fn(&CellReport) -> Option<String>);

/// Formats a table with one line per cell, without empty columns (unanswered, lost, ...).
fn cell_table(bus: &BusReport) -> Table {
    // A zero is left blank.
    fn blank_if_zero(count: u64) -> Option<String> {
        (count > 0).then(|| count.to_string())
    }
    const STATE_HEADING: &str = "last state";
    let name = printable(&bus.bus);
    let columns: [Column<'_>; 17] = [
        (&name, |cell| Some(cell.node.to_string())),
        ("torques", |cell| Some(cell.torques.to_string())),
        ("per s", |cell| {
            shown_rate(cell.torques_per_s, cell.torques_span_s).map(|rate| format!("{rate:.1}"))
        }),
        ("over s", |cell| {
            let span_s = cell.torques_span_s;
            shown_rate(cell.torques_per_s, span_s).map(|_| format!("{span_s:.3}"))
        }),
        ("epochs", |cell| Some(format!("{}..{}", cell.first_epoch?, cell.last_epoch?))),
        ("unanswered", |cell| blank_if_zero(cell.unanswered)),
        ("repeated", |cell| blank_if_zero(cell.repeated)),
        ("sums", |cell| blank_if_zero(cell.sums)),
        ("resent", |cell| blank_if_zero(cell.resent)),
        ("parent", |cell| match cell.parent? {
            0 => Some("gateway".to_owned()),
            parent => Some(parent.to_string()),
        }),
        ("depth", |cell| cell.depth.map(|depth| depth.to_string())),
        ("saturated", |cell| blank_if_zero(cell.saturated)),
        ("heartbeats", |cell| Some(cell.heartbeats.to_string())),
        ("refused", |cell| blank_if_zero(cell.refused?.into())),
        ("lost", |cell| blank_if_zero(cell.lost)),
        ("starts", |cell| blank_if_zero(cell.restarts)),
        (STATE_HEADING, |cell| Some(space_separated(&cell.state)).filter(|state| !state.is_empty())),
    ];
    let (heads, lines) = drop_empty_columns(columns, &bus.cells, "");
    let of_words = heads.iter().rposition(|head| *head == STATE_HEADING);
    print::table(heads, lines, |column| Some(column) != of_words)
}
