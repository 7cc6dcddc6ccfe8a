//! The numbers of a capture as tables.

use analysis::stats::{BusReport, CellReport, Epochs, ForeignFrames, ForeignId, FrameType, Report};
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use trace::capture::{Extras, Topic};

use crate::print::Rows;

/// All of it: what the capture is, each bus, and each bus' cells.
pub(super) fn text(name: &str, what: &str, report: &Report, extras: Option<&Extras>) -> String {
    let head = format!("{what}, {:.3} s", report.duration_s);
    let mut rows = Rows::new([name.to_owned(), head, format!("{} frames", report.frames)]);
    if report.times_backwards > 0 {
        rows.row("frames before the one before them", report.times_backwards, "times run backwards");
    }
    if report.dropped > 0 {
        rows.row("frames missing", report.dropped, "lost by whoever took the capture");
    }
    if report.frames_of_other_buses > 0 {
        rows.row("frames of further buses", report.frames_of_other_buses, "64 buses are told apart");
    }
    for bus in &report.buses {
        numbers(&mut rows, bus);
    }
    if let Some(extras) = extras {
        beside(&mut rows, extras);
    }
    let mut text = format!("{}\n", rows.table());
    for bus in &report.buses {
        if !bus.cells.is_empty() {
            text += &format!("\n{}\n", cells(bus));
        }
        if bus.foreign.frames > 0 {
            text += &format!("\n{}\n", foreign(bus));
        }
    }
    text
}

fn per_s(rate: Option<f64>) -> String {
    rate.map(|rate| format!("{rate:.1} a second")).unwrap_or_default()
}

fn numbers(rows: &mut Rows, bus: &BusReport) {
    rows.section(&bus.bus, format!("{} frames", bus.frames), per_s(bus.frames_per_s));
    for kind in &bus.kinds {
        rows.row(kind.kind, kind.packets, per_s(kind.packets_per_s));
    }
    let Epochs { first, last, missing, repeated, jumps } = bus.epochs;
    if let (Some(first), Some(last)) = (first, last) {
        let odd = [(missing, "missing"), (repeated, "repeated"), (jumps, "begun anew")];
        let odd = odd.map(|(count, what)| format!("{count} {what}")).join(", ");
        rows.row("epochs", format!("{first} to {last}"), odd);
    }
    if bus.wires > 0 {
        rows.row("wires", bus.wires, format!("{}, on no real bus", per_s(bus.wires_per_s)));
    }
    let refused: Vec<_> = bus.refused.by_reason().into_iter().filter(|(_, count)| *count > 0).collect();
    let reasons: Vec<_> = refused.iter().map(|(reason, count)| format!("{count} {reason}")).collect();
    let total: u64 = refused.iter().map(|(_, count)| count).sum();
    rows.row("damaged or refused", total, reasons.join(", "));
    let ForeignFrames { standard, extended, remote, error, packets_by_chance, .. } = bus.foreign;
    rows.row("foreign", bus.foreign.frames, "");
    let of = [
        (standard, "  11-bit identifiers"),
        (extended, "  29-bit identifiers"),
        (remote, "  remote frames"),
        (error, "  error frames"),
    ];
    for (frames, of) in of.into_iter().filter(|(frames, _)| *frames > 0) {
        rows.row(of, frames, "");
    }
    if packets_by_chance >= 0.05 {
        let chance = format!("{packets_by_chance:.1}");
        rows.row("  packets by chance", chance, "expected");
    }
    let why = if bus.dropped > 0 { "lost by whoever took the capture" } else { "" };
    rows.row("frames missing", bus.dropped, why);
}

/// What an MCAP recording has beside frames.
fn beside(rows: &mut Rows, extras: &Extras) {
    if !extras.topics.is_empty() {
        rows.section("other topics", "messages", "");
    }
    for Topic { name, schema, messages } in &extras.topics {
        rows.row(name, messages, schema);
    }
    if !extras.attachments.is_empty() {
        rows.section("attachments", "bytes", "");
    }
    for (name, bytes) in &extras.attachments {
        rows.row(name, bytes.len(), "");
    }
}

/// Foreign identifiers that are shown; --json has all.
const FOREIGN: usize = 40;

/// One line a foreign identifier, those with the most frames.
fn foreign(bus: &BusReport) -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_BORDERS_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
    let head = format!("{} foreign", bus.bus);
    table.set_header([head.as_str(), "frames", "per s", "first s", "last s", "bytes", ""]);
    for id in bus.foreign.identifiers.iter().take(FOREIGN) {
        let ForeignId { bytes_min, bytes_max, .. } = *id;
        let bytes =
            if bytes_min == bytes_max { bytes_min.to_string() } else { format!("{bytes_min}..{bytes_max}") };
        let what = match id.of {
            FrameType::Data if id.wrong_crc > 0 => format!("{} wrong CRC", id.wrong_crc),
            FrameType::Data => String::new(),
            FrameType::Remote => "remote".to_owned(),
            FrameType::Error => "error".to_owned(),
        };
        table.add_row([
            id.id.clone(),
            id.frames.to_string(),
            id.frames_per_s.map(|rate| format!("{rate:.1}")).unwrap_or_default(),
            format!("{:.3}", id.first_s),
            format!("{:.3}", id.last_s),
            bytes,
            what,
        ]);
    }
    let further = bus.foreign.identifiers.iter().skip(FOREIGN);
    let count = further.len();
    let frames = further.map(|id| id.frames).sum::<u64>() + bus.foreign.frames_of_other_identifiers;
    if frames > 0 {
        let more = if bus.foreign.frames_of_other_identifiers > 0 { "more than " } else { "" };
        table.add_row([format!("{more}{count} further"), frames.to_string()]);
    }
    for column in table.column_iter_mut().take(6) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// What stands in a column: its head, and a cell's text there.
type Column = (&'static str, fn(&CellReport) -> String);

/// One line a cell. What no cell has (missed, lost, ...) has no column.
fn cells(bus: &BusReport) -> Table {
    // What is not there is no zero.
    fn some(count: u64) -> String {
        if count == 0 { String::new() } else { count.to_string() }
    }
    let columns: [Column; 15] = [
        ("torques", |cell| cell.torques.to_string()),
        ("per s", |cell| cell.torques_per_s.map(|rate| format!("{rate:.1}")).unwrap_or_default()),
        ("epochs", |cell| match (cell.first_epoch, cell.last_epoch) {
            (Some(first), Some(last)) => format!("{first}..{last}"),
            (_, _) => String::new(),
        }),
        ("missed", |cell| some(cell.missed)),
        ("twice", |cell| some(cell.repeated)),
        ("sums", |cell| some(cell.sums)),
        ("again", |cell| some(cell.resent)),
        ("parent", |cell| match cell.parent {
            None => String::new(),
            Some(0) => "gateway".to_owned(),
            Some(parent) => parent.to_string(),
        }),
        ("depth", |cell| cell.depth.map(|depth| depth.to_string()).unwrap_or_default()),
        ("satur.", |cell| some(cell.saturated)),
        ("beats", |cell| cell.heartbeats.to_string()),
        ("refused", |cell| cell.refused.map(|refused| some(refused.into())).unwrap_or_default()),
        ("lost", |cell| some(cell.lost)),
        ("starts", |cell| some(cell.restarts)),
        ("last state", |cell| cell.state.join(" ")),
    ];
    let there = |(_, text): &Column| bus.cells.iter().any(|cell| !text(cell).is_empty());
    let columns: Vec<_> = columns.into_iter().filter(there).collect();
    let mut table = Table::new();
    table.load_style(presets::UTF8_BORDERS_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
    table.set_header(std::iter::once(bus.bus.as_str()).chain(columns.iter().map(|(head, _)| *head)));
    for cell in &bus.cells {
        table.add_row(
            std::iter::once(cell.node.to_string()).chain(columns.iter().map(|(_, text)| text(cell))),
        );
    }
    let states = columns.last().is_some_and(|(head, _)| *head == "last state");
    for column in table.column_iter_mut().take(columns.len() + usize::from(!states)) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}
