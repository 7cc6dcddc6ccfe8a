#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use bench::summary::{
    LoopSummary, OutagesSummary, PrivateMemory, RecordingAccount, RepliesSummary, UplinkSummary, Verdict,
    WrittenFile,
};
use protocol::quantiles::Quantiles;

use super::*;

const EIGHTY: TableStyle = TableStyle { is_verbose: false, is_coloured: false, columns: Some(80) };
const LONG: &str = "abcdefghijklmno";

fn some(count: u64) -> Quantiles {
    Quantiles { p50: 214.0, p90: 1_343.0, p99: 11_210.0, max: 15_300.0, count }
}

fn bus(name: &str, cells: usize, replies: u64) -> BusSummary {
    BusSummary {
        name: name.to_owned(),
        kind: "socketcan".to_owned(),
        cells: [("quiet", cells)].into(),
        uplink: UplinkSummary { sent: 31_245, delivered: 31_245, ..UplinkSummary::default() },
        replies: RepliesSummary { due: replies, in_time: replies, ..RepliesSummary::default() },
        epochs_due: replies.min(575),
        epochs_complete: replies.min(575),
        received: [("torque", replies), ("network", 1_012)].into(),
        sent: [("command", 750), ("stimulus", 3_000)].into(),
        last_reply_us: some(replies),
        reply_us: some(replies),
        joints_not_taken_us: some(1_012),
        ..BusSummary::default()
    }
}

/// Creates a run that is well, with `each` cells on each of these buses.
fn run(skin: &str, buses: &[&str], each: u8, replies: u64) -> Summary {
    let cells = buses.iter().flat_map(|bus| {
        (1..=each).map(|node| CellSummary {
            node,
            bus: (*bus).to_owned(),
            mode: Some("test"),
            ..CellSummary::default()
        })
    });
    let errors = |count: u64| (0..count).map(|_| 6.2e-5).collect();
    let mut summary = Summary {
        skin: skin.to_owned(),
        cells: cells.collect(),
        duration_s: 12.0,
        control: LoopSummary {
            ticks: 6_000,
            broadcasts: 750,
            late_us: some(6_000),
            idle_late_us: some(6_000),
            took_us: some(6_000),
            central_us: some(2_850),
            took_distributed_us: some(3_150),
            fifo: true,
            memory_locked: true,
            ..LoopSummary::default()
        },
        buses: buses.iter().map(|name| bus(name, each.into(), replies)).collect(),
        processor: ProcessorUse { gateway: 0.061, cells: 0.412, buses: -0.0 },
        memory: PrivateMemory {
            cell_private_kib: Some(768),
            gateway_private_kib: Some(12_345),
            buses_private_kib: Some(812),
        },
        first_broadcast_s: 1.25,
        ..Summary::default()
    };
    if replies > 0 {
        summary.accuracy.single = errors(24_364);
        summary.accuracy.unquantised = errors(24_364);
        summary.accuracy.whole = errors(1_740);
    }
    summary.with_verdict(None)
}

/// Creates the run of the demonstration, with its log.
fn demo() -> Summary {
    let path = "skinbus-demo.log".to_owned();
    let file = WrittenFile { path, format: "candump", frames: 34_567, messages: 34_567, bytes: 2_345_678 };
    let recording = RecordingAccount { files: vec![file], frames: 34_567, ..RecordingAccount::default() };
    Summary { recording: Some(recording), ..run("ur5-253", &["vcan0"], 253, 17_772) }
}

fn widest(text: &str) -> usize {
    text.lines().map(|line| line.chars().count()).max().unwrap()
}

#[test]
fn a_run_that_is_well_is_short_and_fits_eighty_columns() {
    for (summary, lines) in [
        (demo(), 20),
        (run("two-cells", &["vcan0"], 2, 575), 18),
        (run("two-cells", &["vcan0"], 2, 0), 18),
        (run(LONG, &[LONG, "abcdefghijklmn2"], 126, 17_772), 25),
    ] {
        let text = format_summary(&summary, EIGHTY);
        assert!(widest(&text) <= 80 && text.lines().count() <= lines, "{}\n{text}", text.lines().count());
    }
}

#[test]
fn the_verdict_is_the_first_line() {
    let first = |summary: &Summary, columns| {
        format_summary(summary, TableStyle { columns, ..EIGHTY }).split('┌').next().unwrap().to_owned()
    };
    let well =
        "all well: 253 cells, 575 of 575 epochs complete, 17772 replies in time, mean error 6.2e-5 Nm\n";
    assert_eq!(first(&demo(), Some(100)), well);
    assert_eq!(
        first(&demo(), Some(80)),
        "all well: 253 cells, 575 of 575 epochs complete, 17772 replies in time, mean\n  error 6.2e-5 Nm\n"
    );
    let interrupted = Summary { interrupted: true, ..demo() }.with_verdict(None);
    assert!(first(&interrupted, None).starts_with("all well until the run was interrupted: 253 cells, "));
    let look_at = [
        "first".to_owned(),
        "a second thing that is long enough to be broken when there is no more room".to_owned(),
    ];
    let wrong = Summary { verdict: Verdict { well: false, look_at: look_at.to_vec() }, ..demo() };
    assert_eq!(
        first(&wrong, Some(80)),
        "problems: first\n          a second thing that is long enough to be broken when there is \
         no more\n            room\n"
    );
    let many = Summary { verdict: Verdict { well: false, look_at: vec!["one".to_owned(); 9] }, ..demo() };
    let all = first(&many, Some(80));
    assert!(all.lines().count() == 7 && all.ends_with("\n          and 3 more: use --verbose\n"), "{all}");
    let verbose = format_summary(&many, TableStyle { is_verbose: true, ..EIGHTY });
    assert_eq!(verbose.lines().take_while(|line| line.ends_with("one")).count(), 9, "{verbose}");
}

#[test]
fn verbose_has_all_rows() {
    let columns = Some(110);
    let [brief, verbose] =
        [false, true].map(|is_verbose| format_summary(&demo(), TableStyle { is_verbose, columns, ..EIGHTY }));
    let usual = [
        "against unrounded parameters",
        "central computation",
        "broadcasts",
        "SCHED_FIFO",
        "each reply",
        "missing",
        "received",
        "private memory",
        "start to first broadcast",
        "frames recorded",
    ];
    for row in usual {
        assert!(verbose.contains(row) && !brief.contains(row), "{row}\n{brief}\n{verbose}");
    }
    for row in ["each cell", "the whole skin", "tick lateness", "replies due", "recording", "vcan0"] {
        assert!(verbose.contains(row) && brief.contains(row), "{row}\n{brief}\n{verbose}");
    }
    assert!(widest(&format_summary(&demo(), TableStyle { is_verbose: true, ..EIGHTY })) <= 80);
    assert!(!brief.contains("-0.000") && !verbose.contains("-0.000"), "{verbose}");
}

#[test]
fn what_is_not_usual_is_shown_without_verbose() {
    type Change = (fn(&mut Summary), &'static str);
    let changes: [Change; 11] = [
        (|it| it.control.ticks_skipped = 3, "3 skipped"),
        (|it| it.control.unsent = 1, "frames not sent"),
        (|it| it.control.records_lost = 1, "tick records lost"),
        (|it| it.accuracy.saturated = 1, "saturated words"),
        (
            |it| it.buses[0].outages = OutagesSummary { times: 1, lost_s: 0.5, at_end: false, ticks: 1 },
            "1 tick ran without this bus",
        ),
        (|it| it.buses[0].silent_cells = vec![7], "silent cells"),
        (|it| (it.buses[0].replies.in_time, it.buses[0].replies.late) = (17_771, 1), "1 late"),
        (
            |it| (it.buses[0].replies.in_time, it.buses[0].replies.lost) = (17_771, 1),
            "1 lost, 0 of unknown cause",
        ),
        (|it| it.buses[0].uplink.dropped = 1, "1 dropped by the bus, 0 of unknown cause"),
        (|it| it.buses[0].uplink.restarts = 1, "restarts of cells"),
        (|it| it.buses[0].events = [("wrong CRC", 1)].into(), "1 wrong CRC"),
    ];
    for (change, shown) in changes {
        let mut summary = demo();
        change(&mut summary);
        let columns = Some(110);
        let text = format_summary(&summary.with_verdict(None), TableStyle { columns, ..EIGHTY });
        assert!(text.contains(shown) && text.starts_with("problems: "), "{shown}:\n{text}");
    }
}

#[test]
fn colours_say_how_bad_it_is_and_only_where_they_are_due() {
    let in_colour = |change: fn(&mut Summary)| {
        let mut summary = demo();
        change(&mut summary);
        let summary = summary.with_verdict(None);
        let plain = format_summary(&summary, EIGHTY);
        assert!(!plain.contains('\x1b'), "{plain}");
        let coloured = format_summary(&summary, TableStyle { is_coloured: true, ..EIGHTY });
        // Colours change no text.
        let mut without = String::new();
        let mut letters = coloured.chars();
        while let Some(letter) = letters.next() {
            if letter == '\x1b' {
                letters.by_ref().find(|letter| *letter == 'm');
            } else {
                without.push(letter);
            }
        }
        assert_eq!(without, plain);
        coloured
    };
    let well = in_colour(|_| {});
    assert!(well.starts_with(GREEN) && well.matches('\x1b').count() == 2, "{well:?}");
    let late = in_colour(|it| (it.buses[0].replies.in_time, it.buses[0].replies.late) = (17_771, 1));
    assert!(late.starts_with(YELLOW) && late.matches('\x1b').count() == 2, "{late:?}");
    let unknown = in_colour(|it| (it.buses[0].replies.in_time, it.buses[0].replies.unknown) = (17_771, 1));
    assert!(unknown.starts_with(RED) && unknown.matches('\x1b').count() > 2, "{unknown:?}");
    let halted = in_colour(|it| it.halted = Some("a halt frame".to_owned()));
    assert!(halted.starts_with(RED), "{halted:?}");
}

#[test]
fn names_cannot_command_a_terminal() {
    let mut summary = demo();
    summary.skin = "a\x1b[2Jb".to_owned();
    summary.buses[0].name = "c\x1b[2Jd".to_owned();
    summary.buses[0].silent_cells = vec![7];
    let text = format_summary(&summary.with_verdict(None), TableStyle { columns: Some(110), ..EIGHTY });
    assert!(!text.contains('\x1b') && text.matches("\\u{1b}[2J").count() >= 3, "{text}");
}

#[test]
fn cells_are_counted_by_their_status_in_words() {
    let cells = [("active", 20), ("dead", 1), ("never heard", 2), ("quiet", 230), ("stale", 3)].into();
    let said = frames::cells_by_status(&cells);
    assert_eq!(
        said,
        "20 in contact, 1 dead, 2 never heard, 230 not in contact, 3 in contact without a reply"
    );
}
