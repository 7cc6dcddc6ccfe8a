//! The whole skin on the lab machine's own clock, at a rate that it sustains.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use model::generate::{SkinRequest, generate};
use process::log::Log;
use process::vcan::tool;
use process::{PRESSED, TestDir, whole};
use protocol::can::Format;
use protocol::message::Message;
use rustix::process::Signal;

/// The loop runs at 100 Hz, because a tick costs a quarter of a millisecond here.
///
/// On an idle host the last reply comes 27 ms after a broadcast. Other users of the host make the machine slower, for
/// moments or all the time; cells then skip joints that are older than a period, and count them. Missing replies must
/// therefore match the skipped joints here; completeness is checked where time is counted in instructions
/// (`lab_icount`).
#[test]
#[ignore = "needs the lab machine"]
fn what_253_processes_do_not_answer_at_20_hz_they_were_too_late_for_and_nothing_is_lost() {
    let summary = whole::runs_for_half_a_minute(20 * 30, 100.0);
    let busy = summary.figure("/processor/gateway") + summary.figure("/processor/cells");
    let complete = summary.of_bus("/epochs_complete");
    eprintln!("{complete} of 600 broadcasts answered by all, {busy:.2} of the processor");
    if complete == 600 {
        whole::all_is_answered(&summary);
    }
    let of = |reason: &str| summary.of_bus(&format!("/replies/{reason}"));
    if busy < SATURATED {
        let missing = of("due") - of("in_time") - of("late");
        assert_eq!(missing, of("skipped") + of("too_late"), "{:#}", summary.0);
        assert!(complete > 60, "{complete} of 600 with {busy:.2} of the processor: {:#}", summary.0);
    }
}

/// With `candump` and the kernel's own share, that is all of its time.
const SATURATED: f64 = 0.7;

/// Frames have the wall clock's time, which may be set by hand or by NTP.
#[test]
#[ignore = "needs the lab machine"]
fn cells_and_gateway_live_through_steps_of_the_walls_clock() {
    let place = TestDir::on_vcan();
    let expected = SkinRequest { cells: 4, broadcast_hz: 20.0, ..SkinRequest::default() };
    place.write("skin.toml", &generate(&expected).unwrap());
    place.scenario(PRESSED);
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    test_client.waits_for_epoch(20);
    let back = tool("date +%s").stdout;
    let back: u64 = String::from_utf8(back).unwrap().trim().parse().unwrap();
    tool(&format!("date --set @{}", back - 100));
    test_client.waits_for_epoch(60);
    tool(&format!("date --set @{back}"));
    test_client.waits_for_epoch(120);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.summary().adds_up();
    let log = Log::read(&place.read("run.log"), Format::Fd);
    let joints = |message: &Message| matches!(message, Message::Joints { .. });
    let places: Vec<_> =
        log.messages.iter().enumerate().filter(|(_, (message, _))| joints(message)).collect();
    // Both steps may cost some epochs, until a cell has compared its clock again.
    for (what, from, to) in [("before", 5, 18), ("between", 35, 55), ("after", 80, 110)] {
        let (from, to) = (places[from].0, places[to].0);
        for cell in 1..=4 {
            let count = log.torques_after(from, cell) - log.torques_after(to, cell);
            assert!(count > 0, "{what}, cell {cell}: {count} torques");
        }
    }
}
