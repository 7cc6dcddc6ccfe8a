//! Replays on a real kernel's vcan: to new cells, beside `canplayer`, across an outage, and against a full queue.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fmt::Write as _;
use std::fs;
use std::time::Duration;

use model::generate::{SkinRequest, generate};
use process::replay::{Replayed, send_every_message};
use process::vcan::{Candump, Vcan0, refused, tool};
use process::{TestDir, until};
use protocol::candump::{CandumpLine, parse};

/// The options for new cells with the recording's skin.
const FRESH: &str = "--expect --spawn --skin skin.toml";

/// Writes a skin with a rate that an emulated machine can follow, and touches on some of its cells.
fn prepare(place: &TestDir, cells: usize) {
    let expected = SkinRequest { cells, broadcast_hz: 20.0, ..SkinRequest::default() };
    place.write("skin.toml", &generate(&expected).unwrap());
    place.scenario(process::replay::TOUCHED);
}

#[test]
#[ignore = "needs vcan"]
fn a_run_on_vcan_comes_back_bit_for_bit() {
    let place = TestDir::on_vcan();
    prepare(&place, 8);
    let bench = place.running_bench(12.0, "");
    send_every_message(&place.test_client(), &place.path("skin.toml"));
    bench.end().succeeded();
    let mut counts = Vec::new();
    for route in ["--lockstep", "--speed max", "--speed max", ""] {
        let (ended, replayed) = place.replayed("run.log", &format!("{FRESH} {route}"));
        eprintln!("{}", ended.stdout);
        counts.push(match route {
            "" => replayed.all_came_back_in_time(&ended),
            _ => replayed.all_came_back(&ended),
        });
        assert_eq!(replayed.text("/buses/0/kind"), "socketcan");
    }
    assert!(counts[0] > 24 && counts.iter().all(|count| *count == counts[0]), "{counts:?}");
}

#[test]
#[ignore = "needs vcan"]
fn two_hundred_and_fifty_three_fresh_cells_on_vcan_answer_as_the_others_did_twice() {
    let place = TestDir::on_vcan();
    prepare(&place, 253);
    // Sixteen in a process: an emulated machine would need more than a period to wake 253 processes.
    place.bench(4.0, "--cells-per-process 16").end_after(Duration::from_secs(60)).succeeded();
    let mut counts = Vec::new();
    for _ in 0..2 {
        let replay = place.replay("run.log", &format!("{FRESH} --speed max SKINBUS_CELLS_PER_PROCESS=16"));
        let ended = replay.end_after(Duration::from_secs(120));
        eprintln!("{}{}", ended.stdout, ended.stderr);
        let replayed = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap());
        counts.push(replayed.all_came_back(&ended));
    }
    assert!(counts[0] > 24 && counts[0] == counts[1], "{counts:?}");
}

#[test]
#[ignore = "needs vcan"]
fn an_outage_costs_what_was_due_and_is_said_once() {
    let place = TestDir::on_vcan();
    let frames: String = (0..3_000_u32).fold(String::new(), |mut text, at| {
        writeln!(text, "(1.{:06}) vcan0 123##1{at:032X}", at * 300).unwrap();
        text
    });
    place.write("steady.log", &frames);
    let vcan0 = Vcan0;
    let mut candump = Candump::start("vcan0", &place.path("candump.log"));
    let replay = place.replay("steady.log", "--loop 5");
    replay.wait_for_stderr("vcan0 is socketcan");
    candump.catch_up();
    vcan0.down();
    replay.wait_for_stderr("vcan0 is down: ");
    vcan0.up();
    replay.wait_for_stderr("vcan0 works again");
    let ended = replay.end();
    let replayed = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap());
    let [sent, refused, lost] = ["/sent", "/refused", "/lost"].map(|what| replayed.number(what));
    assert!(lost > 0 && refused == 0 && sent + lost == 15_000, "{:#}", replayed.0);
    assert_eq!((ended.code(), replayed.number("/buses/0/outages")), (Some(1), 1), "{ended:#?}");
    assert!(ended.stderr.contains(&format!("{lost} frames were lost while a bus was down")), "{ended:#?}");
    assert_eq!(ended.stderr.matches("is down").count(), 1, "{ended:#?}");
}

#[test]
#[ignore = "needs vcan"]
fn a_transmit_queue_without_room_refuses_and_is_waited_for() {
    let place = TestDir::on_vcan();
    // For five seconds.
    let frames: String = (0..500).fold(String::new(), |mut text, at| {
        writeln!(text, "({}.{:02}0000) vcan0 123#{:02X}", 1 + at / 100, at % 100, at % 256).unwrap();
        text
    });
    place.write("some.log", &frames);
    let vcan0 = Vcan0;
    vcan0.fill();
    let replay = place.replay("some.log", "SKINBUS_SEND_TIMEOUT_MS=50");
    // A frame is retried every half millisecond: after this number of attempts at least the first one has timed out.
    until("a frame that is refused", || (refused("vcan0") > 110).then_some(()));
    vcan0.empty();
    let ended = replay.end();
    let replayed = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap());
    let [sent, refused] = ["/sent", "/refused"].map(|what| replayed.number(what));
    assert!(refused >= 1 && sent >= 1 && sent + refused == 500, "{:#} {ended:#?}", replayed.0);
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
}

/// Returns the lateness of the frames relative to the first one, in µs: median, 90 %, maximum.
fn lateness(log: &str, period_us: i64) -> [i64; 3] {
    let mut late = Vec::new();
    for line in fs::read_to_string(log).unwrap().lines() {
        let Ok(CandumpLine::Frame(record)) = parse(line) else { continue };
        if record.frame.id() != 0x123 {
            continue;
        }
        let number = i64::from(u16::from_le_bytes([record.frame.data()[0], record.frame.data()[1]]));
        late.push(i64::try_from(record.time.nanos / 1_000).unwrap() - number * period_us);
    }
    assert_eq!(late.len(), 1_000, "{log}");
    late.sort_unstable();
    let min = late[0];
    [500, 900, 999].map(|at: usize| late[at] - min)
}

#[test]
#[ignore = "needs vcan"]
fn lateness_at_two_milliseconds_is_printed_beside_canplayers() {
    let place = TestDir::on_vcan();
    let grid: String = (0..1_000_u32).fold(String::new(), |mut text, at| {
        let (us, [low, high]) = (at * 2_000, u16::try_from(at).unwrap().to_le_bytes());
        writeln!(text, "({}.{:06}) vcan0 123#{low:02X}{high:02X}", 1 + us / 1_000_000, us % 1_000_000)
            .unwrap();
        text
    });
    let grid = place.write("grid.log", &grid);
    let run = |name: &str, send: &dyn Fn()| {
        let log = place.path(name);
        let mut candump = Candump::start("vcan0", &log);
        send();
        candump.catch_up();
        drop(candump);
        lateness(log.to_str().unwrap(), 2_000)
    };
    let theirs = run("theirs.log", &|| {
        tool(&format!("canplayer -I {}", grid.display()));
    });
    let ours = run("ours.log", &|| {
        let (ended, replayed) = place.replayed("grid.log", "");
        ended.succeeded();
        assert_eq!(replayed.number("/late_us/count"), 1_000);
        eprintln!("by its own count {}, idle {}", replayed.0["late_us"], replayed.0["idle_late_us"]);
    });
    eprintln!("lateness at 2 ms, by candump's times, after the quickest, us (50 %, 90 %, max):");
    eprintln!("  skinbus replay {ours:?}, canplayer {theirs:?}");
}
