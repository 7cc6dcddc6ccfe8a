//! Results of the model of buses as JSON lines and as tables.

use std::io::{self, Write};

use analysis::fit::verdict::format_percent;
use analysis::shadow::{
    AnsweringCounts, BusShadow, BusyStretches, DelayQuantiles, FrameTiming, Identifier, Loads, Peak,
    ReplyStatistics, Shadow, ShadowReport, StartUpFigures,
};
use bus_model::traffic::BenchFrames;

use trace::capture::seconds_since;

use crate::print::{KeyValueTable, comma_separated, count_with_noun, escape_controls, or_else_text};

/// Writes the frames whose sending the model has computed, one object per line.
pub(super) fn write_frames(shadow: &mut Shadow, out: &mut impl Write) -> io::Result<()> {
    let mut line = Vec::with_capacity(192);
    while let Some(frame) = shadow.poll() {
        line.clear();
        let is_timed = frame.bus.is_some_and(|bus| shadow.is_timed(bus));
        write_frame(&mut line, frame.bus.map(|bus| shadow.bus(bus)), &frame, is_timed)?;
        out.write_all(&line)?;
    }
    Ok(())
}

fn write_frame(line: &mut Vec<u8>, bus: Option<&str>, frame: &FrameTiming, is_timed: bool) -> io::Result<()> {
    let FrameTiming { nanos, id, extended, bits, sent, .. } = *frame;
    line.extend_from_slice(b"{\"time\":");
    append_seconds(line, Some(nanos));
    line.extend_from_slice(b",\"bus\":");
    line.extend_from_slice(escape_controls(serde_json::to_string(&bus)?).as_bytes());
    write!(line, ",\"id\":\"{}\"", Identifier(id, extended))?;
    for (key, bits) in [("nominal", bits.map(|bits| bits.nominal)), ("data", bits.map(|bits| bits.data))] {
        write!(line, ",\"{key}_bits\":")?;
        serde_json::to_writer(&mut *line, &bits)?;
    }
    for (key, nanos) in [("start", sent.map(|(start, _)| start)), ("end", sent.map(|(_, end)| end))] {
        write!(line, ",\"{key}_s\":")?;
        append_seconds(line, nanos);
    }
    if is_timed {
        line.extend_from_slice(b",\"time_is\":\"end\"");
    }
    line.extend_from_slice(b"}\n");
    Ok(())
}

/// Writes seconds with nine digits after the point. A double cannot hold that many for times since 1970, and `fmt` is
/// much slower.
fn append_seconds(line: &mut Vec<u8>, nanos: Option<u64>) {
    const NANOS_PER_SECOND: u64 = 1_000_000_000;
    let Some(nanos) = nanos else { return line.extend_from_slice(b"null") };
    let mut digits = itoa::Buffer::new();
    line.extend_from_slice(digits.format(nanos / NANOS_PER_SECOND).as_bytes());
    line.push(b'.');
    // Add a leading 1, which is then skipped, so that zeros at the beginning are kept.
    line.extend(digits.format(NANOS_PER_SECOND + nanos % NANOS_PER_SECOND).bytes().skip(1));
}

/// Formats the result for all buses as a table.
pub(super) fn format_report(name: &str, what: &str, missing: u64, report: &ShadowReport) -> String {
    let head = format!("{what}, {} frames", report.frames);
    let beside = if missing > 0 { format!("{missing} frames are missing from it") } else { String::new() };
    let mut rows = KeyValueTable::new(name, head, beside).names_in_one_line();
    for bus in &report.buses {
        bus_rows(&mut rows, bus, report);
    }
    rows.add_row_unless_zero(
        "frames of other buses",
        report.frames_of_other_buses,
        "only the first 64 \
                                                                                       buses are shown",
    );
    rows.to_text()
}

fn bus_rows(rows: &mut KeyValueTable, bus: &BusShadow, report: &ShadowReport) {
    let bit_error_rate = report.bit_error_rate;
    let count = format!("{} frames in {:.3} s", bus.frames, bus.duration_s);
    let missing = if bus.counts.missing > 0 {
        format!("{} more are missing", bus.counts.missing)
    } else {
        String::new()
    };
    rows.add_section(format!("{} at {}", bus.bus, bus.name), count, missing);
    if bus.is_timed {
        rows.add_row("time stamps", "ends of frames", "of a timed bus: no queueing is computed");
    }
    add_fit_rows(rows, bus, report.has_times);
    if bus.this_run.is_some() {
        add_operation_rows(rows, bus);
    }
    if let Some(start_up) = &bus.start_up {
        add_start_up_rows(rows, bus, start_up);
    }
    if bit_error_rate > 0.0 {
        let each = format!("bit error rate {bit_error_rate:e}");
        rows.add_row("frames sent again", format!("{} attempts", bus.counts.damaged), each);
    }
    add_bench_traffic_row(rows, bus);
    let of_all =
        |count: u64| format!("{:.1} % of the frames", 100.0 * count as f64 / bus.frames.max(1) as f64);
    rows.add_row_unless_zero(
        "error frames, left out",
        bus.counts.error_frames,
        "reported by a driver, not sent on the bus",
    );
    rows.add_row_unless_zero("frames out of order", bus.counts.out_of_order, of_all(bus.counts.out_of_order));
    rows.add_row_unless_zero(
        "  too late to sort",
        bus.counts.too_late_to_sort,
        "counted as if they came later",
    );
    rows.add_row_unless_zero("never sent", bus.counts.no_room, "because 4 million frames already waited");
}

/// Adds rows on whether the traffic fits on the bus, in the worst case and in this run.
fn add_fit_rows(rows: &mut KeyValueTable, bus: &BusShadow, has_times: bool) {
    match (&bus.worst_case, &bus.answering) {
        (Some(worst), _) => rows.add_row(worst.case_name(), worst.table_value(), worst.cells),
        (None, Some(_)) => rows.add_row("worst case", "?", "name a skin with this bus: --skin"),
        (None, None) => {}
    }
    match &bus.this_run {
        Some(run) => rows.add_row(run.case_name(), run.table_value(), run.cells),
        None if !has_times => rows.add_row("this run", "?", "the frames have no time stamps"),
        None if bus.duration_s == 0.0 => rows.add_row("this run", "?", "all frames have the same time stamp"),
        None => rows.add_row("this run", "no joints messages", ""),
    }
    match bus.answering {
        Some(AnsweringCounts { epochs, epochs_halted: 0, mean: Some(mean), .. }) => {
            rows.add_row(
                "  cells that answered",
                format!("{mean:.1} on average"),
                format!("{epochs} joints messages"),
            );
        }
        Some(AnsweringCounts { epochs, epochs_halted, mean: Some(mean), .. }) => {
            let beside = format!("{epochs} joints messages; {epochs_halted} more while halted");
            rows.add_row("  cells that answered", format!("{mean:.1} on average"), beside);
        }
        Some(AnsweringCounts { epochs_halted: halted @ 1.., mean: None, .. }) => {
            rows.add_row("  cells that answered", "none, always halted", format!("{halted} joints messages"));
        }
        _ => {}
    }
}

fn add_operation_rows(rows: &mut KeyValueTable, bus: &BusShadow) {
    add_load_rows(rows, bus, &bus.load, ("average load", &format!("{:.3} s in operation", bus.operation_s)));
    rows.add_row("  bus busy", format_share(bus.load.busy), "");
    add_busy_stretch_row(rows, bus, &bus.stretches);
    if !bus.is_timed {
        add_delay_rows(rows, bus);
    }
    if let Some(replies) = &bus.replies {
        add_answer_rows(rows, replies);
    }
    if !bus.is_timed {
        add_queue_rows(rows, bus);
    }
}

fn add_delay_rows(rows: &mut KeyValueTable, bus: &BusShadow) {
    rows.add_row("delay, µs", "50 % / 99 % / max", "from queueing to end of frame");
    rows.add_row("  all frames", format_delays(&bus.delay_us), format!("{} frames", bus.delay_us.count));
    for kind in &bus.kinds {
        let (name, delay) = (kind.kind, &kind.delay_us);
        rows.add_row(format!("  {name}"), format_delays(delay), format!("{} frames", delay.count));
    }
}

fn add_queue_rows(rows: &mut KeyValueTable, bus: &BusShadow) {
    rows.add_row("longest queue", format!("{} frames", bus.queue.value), format_peak_time(bus, bus.queue));
    if bus.queue_of_one.value > 0.0 {
        let of = format!("{} frames of {}", bus.queue_of_one.value, Identifier(bus.queue_of_one_id, false));
        rows.add_row("  of one identifier", of, format_peak_time(bus, bus.queue_of_one));
    }
}

/// Adds rows on the start-up, for which no limits apply.
fn add_start_up_rows(rows: &mut KeyValueTable, bus: &BusShadow, start_up: &StartUpFigures) {
    let beside = format!("{} frames, {:.3} s before joints", start_up.frames, start_up.duration_s);
    add_load_rows(rows, bus, &start_up.load, ("start-up: average load", &beside));
    add_busy_stretch_row(rows, bus, &start_up.stretches);
    if !bus.is_timed {
        rows.add_row("  delay, µs", format_delays(&start_up.delay_us), "50 % / 99 % / max");
    }
}

fn add_bench_traffic_row(rows: &mut KeyValueTable, bus: &BusShadow) {
    let BenchFrames { stimuli, syncs, reports, wires } = bus.counts.bench;
    if bus.counts.bench.total() == 0 {
        return;
    }
    let name = if bus.counts.bench_omitted { "bench frames, left out" } else { "bench frames, counted" };
    let parts = [("stimuli", stimuli), ("sync", syncs), ("report", reports), ("simulated wires", wires)];
    let parts = parts.iter().filter(|it| it.1 > 0).map(|(what, count)| format!("{count} {what}"));
    rows.add_row(name, format!("{} frames", bus.counts.bench.total()), comma_separated(parts));
}

fn add_load_rows(rows: &mut KeyValueTable, bus: &BusShadow, load: &Loads, (name, beside): (&str, &str)) {
    rows.add_row(name, format_share(load.mean), beside);
    rows.add_row(
        "  highest in any 16 ms",
        format_percent(load.worst_16_ms.value),
        format_peak_time(bus, load.worst_16_ms),
    );
    rows.add_row(
        "  highest in any second",
        format_percent(load.worst_1_s.value),
        format_peak_time(bus, load.worst_1_s),
    );
}

fn add_busy_stretch_row(rows: &mut KeyValueTable, bus: &BusShadow, stretches: &BusyStretches) {
    let longest = stretches.longest_s;
    let beside = format!("longest {:.1} ms, {}", 1e3 * longest.value, format_peak_time(bus, longest));
    let times = format!("{}, {:.3} s", count_with_noun(stretches.count, "time"), stretches.total_s);
    rows.add_row("  busy at least 16 ms", times, beside);
}

fn format_share(share: Option<f64>) -> String {
    or_else_text(share.map(format_percent), "?")
}

fn add_answer_rows(rows: &mut KeyValueTable, replies: &ReplyStatistics) {
    let ReplyStatistics { count, late_before, late, late_when_ready, after_joints_us } = replies;
    rows.add_row("answers after joints, µs", format_delays(after_joints_us), "50 % / 99 % / max");
    let beside = [
        Some("after the next joints message".to_owned()),
        (*late_when_ready > 0).then(|| format!("{late_when_ready} not because of the bus")),
        (*late_before > 0).then(|| format!("{late_before} others were already late in the recording")),
    ];
    rows.add_row("  late", format!("{late} of {count}"), comma_separated(beside.into_iter().flatten()));
}

fn format_delays(delays: &DelayQuantiles) -> String {
    let DelayQuantiles { p50, p99, max, count } = delays;
    if *count == 0 {
        return "none".to_owned();
    }
    format!("{p50:.0} / {p99:.0} / {max:.0}")
}

fn format_peak_time(bus: &BusShadow, most: Peak) -> String {
    format!("at {:.3} s", seconds_since(bus.zero_ns, most.at_ns))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_are_written_as_fmt_writes_them() {
        for nanos in [0, 1, 9, 10, 999_999_999, 1_000_000_000, 1_700_000_000_000_000_000, u64::MAX] {
            let mut line = Vec::new();
            append_seconds(&mut line, Some(nanos));
            let expected = format!("{}.{:09}", nanos / 1_000_000_000, nanos % 1_000_000_000);
            assert_eq!(String::from_utf8(line).unwrap(), expected);
        }
        let mut line = Vec::new();
        append_seconds(&mut line, None);
        assert_eq!(line, b"null");
    }
}
