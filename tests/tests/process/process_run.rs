//! Benches of real processes without faults.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;

use process::log::{Log, same_torques};
use process::replay::{by_hand, cell};
use process::{PRESSED, Summary, TestDir, example, skin_of, until};
use protocol::can::Format;
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, Request, State};
use protocol::packet::WORDS;
use protocol::parameters::Parameter;
use rustix::process::{Pid, Signal};

/// Checks that every frame on the buses is in the log: packets by their kinds, as both sides counted them, and other
/// frames. If a packet is two frames, the first packet of a cell may have begun before the log.
fn log_is_whole(place: &TestDir, summary: &Summary, frames_a_packet: u64) {
    let buses = summary.0["buses"].as_array().unwrap().len();
    let packets = |bus| {
        ["received", "sent"].map(|route| summary.total(&format!("/buses/{bus}/{route}"))).iter().sum::<u64>()
    };
    let counted: u64 = (0..buses).map(packets).sum::<u64>() * frames_a_packet;
    let lines = place.read("run.log").lines().count();
    assert_eq!(summary.number("/recording/frames"), u64::try_from(lines).unwrap());
    let halves = if frames_a_packet == 1 { 0 } else { summary.cells().len() as u64 };
    assert!((counted..=counted + halves).contains(&(lines as u64)), "{lines} of {counted}: {:#}", summary.0);
    assert_eq!(summary.number("/recording/lost"), 0, "{:#}", summary.0);
    assert_eq!(summary.0["recording"]["files"][0]["path"], "run.log");
}

#[test]
fn two_hundred_and_fifty_three_cells_answer_and_every_reply_is_accounted_for() {
    let place = TestDir::new();
    fs::copy(example("ur5-253.toml"), place.path("skin.toml")).unwrap();
    fs::copy(example("all-active.toml"), place.path("scenario.toml")).unwrap();
    let ended = place.bench(3.0, "").end().succeeded();
    place.is_left_clean();
    assert!(ended.stdout.contains("253 cells"), "{}", ended.stdout);
    assert_eq!(place.files(), ["run.json", "run.log", "scenario.toml", "skin.toml"]);

    let summary = place.summary();
    summary.adds_up();
    assert_eq!((summary.cells().len(), summary.silent().len()), (253, 0));
    assert!(summary.0["halted"].is_null() && summary.0["interrupted"] == false, "{:#}", summary.0);
    // Every cell is in contact from the first epoch on; on a busy machine its last reply may be stale.
    let status = ["active", "stale"].map(|status| summary.count("/buses/0/cells", status));
    assert_eq!(status.iter().sum::<u64>(), 253, "{:#}", summary.0);
    summary.all_were_due(253, &ended.stderr);
    let answered = summary.of_bus("/replies/in_time") + summary.of_bus("/replies/late");
    assert!(answered > 253, "{:#}", summary.0);
    let stale = summary.count("/buses/0/events", "stale torque");
    let torques = answered + summary.of_bus("/replies/unasked") + stale;
    assert_eq!(summary.count("/buses/0/received", "torque"), torques, "{:#}", summary.0);
    assert!(summary.figure("/accuracy/single/mean_nm") <= 1.2e-4, "{:#}", summary.0);
    assert!(summary.figure("/accuracy/unquantised/mean_nm") <= 1.2e-4, "{:#}", summary.0);
    assert_eq!(summary.odd(0), 0, "{:#}", summary.0);

    log_is_whole(&place, &summary, 1);
    let log = Log::read(&place.read("run.log"), Format::Fd);
    assert_eq!(log.messages.len(), log.frames.len(), "every frame has a meaning");
    assert_eq!(log.joints().len() as u64, summary.number("/loop/broadcasts"));
    assert_eq!(log.torques().len() as u64, torques);
}

#[test]
fn buses_of_classic_frames_carry_the_same_bench() {
    let place = TestDir::new();
    place.write("skin.toml", &skin_of(9, 2, Format::Classic));
    place.scenario(PRESSED);
    place.bench(1.5, "").end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.0["buses"].as_array().unwrap().len(), 2);
    for bus in 0..2 {
        let due = summary.number(&format!("/buses/{bus}/replies/due"));
        assert!(due > 0 && summary.odd(bus) == 0, "{:#}", summary.0);
    }
    assert!(summary.figure("/accuracy/single/mean_nm") <= 1.2e-4, "{:#}", summary.0);
    log_is_whole(&place, &summary, 2);
}

/// Runs this scenario twice, the second time with more options.
fn twice(scenario: &str, more: &str) {
    let place = TestDir::new();
    place.skin(8);
    place.scenario(scenario);
    let logs = ["", more].map(|more| {
        place.bench(2.0, more).end().succeeded();
        place.summary().adds_up();
        Log::read(&place.read("run.log"), Format::Fd)
    });
    place.is_left_clean();
    let (shared, all) = same_torques(&logs[0], &logs[1]);
    // Two runs on a machine that skips four of five broadcasts share a thirtieth.
    assert!(shared > 20, "the two runs share only {shared} of {all} causes");
}

/// While the arm stands, each epoch's touch differs from the one before.
const WAVES: &str = r#"version = 1
duration_s = 2.0

[motion]
kind = "hold"
start_rad = [0.3, -1.2, 1.0, -1.4, -1.57, 0.0]

[[touch]]
at_s = 0.1
for_s = 1.5
bus = "vcan0"
cells = [1, 2, 3, 4, 5, 6, 7, 8]
force_n = 6.0
profile = "half-sine"

[[fault]]
at_s = 0.2
for_s = 1.6
kind = "drift"
n_per_s = 2.0
all = true
"#;

/// While the touch stays, each epoch's joints differ from those before.
const SWINGING: &str = r#"version = 1
duration_s = 2.0

[motion]
kind = "sine"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]
amplitude_rad = [0.5, 0.3, 0.4, 0.3, 0.2, 0.2]
period_s = 10.0

[[touch]]
at_s = 0.0
for_s = 2.0
all = true
force_n = 2.5
profile = "step"
"#;

#[test]
fn a_touch_on_a_standing_arm_makes_the_same_torques_twice() {
    twice(WAVES, "");
}

#[test]
fn a_swinging_arm_makes_the_same_torques_twice() {
    twice(SWINGING, "");
}

#[test]
fn eight_cells_in_one_process_answer_as_eight_processes_do() {
    twice(WAVES, "--cells-per-process 8");
    twice(SWINGING, "--cells-per-process 3");
}

#[test]
fn cells_share_processes_as_requested() {
    let place = TestDir::new();
    place.pressed();
    for (more, expected) in
        [("", vec!["1", "2", "3", "4", "5", "6", "7", "8"]), ("--cells-per-process 5", vec!["1-5", "6-8"])]
    {
        let bench = place.running_bench(600.0, more);
        let mut nodes: Vec<_> = bench.cells().into_iter().map(|(_, nodes)| nodes).collect();
        nodes.sort();
        assert_eq!(nodes, expected);
        bench.signal(Signal::TERM);
        bench.end().succeeded();
        place.is_left_clean();
    }
}

#[test]
fn cells_started_by_hand_serve_one_gateway_after_the_other() {
    let place = TestDir::new();
    place.pressed();
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let cells = ["--nodes 1-5", "--nodes 6-7", "--node 8"].map(|nodes| {
        place.start("cell-node", &format!("--bus vcan0 --bus-kind embedded {nodes} --skin skin.toml"))
    });
    // One is interrupted, and leaves the cells halted.
    for interrupt in [false, true, false] {
        let bench = place.running_bench(if interrupt { 600.0 } else { 1.5 }, "--no-spawn");
        if interrupt {
            place.test_client().waits_for_epoch(10);
            bench.signal(Signal::INT);
        }
        let ended = bench.end().succeeded();
        assert!(ended.stdout.contains("8 cells"), "{}", ended.stdout);
        let summary = place.summary();
        summary.adds_up();
        assert_eq!(summary.0["interrupted"], interrupt);
        assert_eq!(summary.silent().len(), 0);
        if !interrupt {
            summary.all_were_due(8, &ended.stderr);
            assert!(summary.of_bus("/replies/in_time") > 0, "{:#}", summary.0);
        }
    }
    // They are not the gateway's children, and still run.
    assert_eq!(place.processes().len(), 4);

    server.signal(Signal::TERM);
    server.end().succeeded();
    for cell in cells {
        let ended = cell.end();
        let said = "cell-node: the embedded bus vcan0 was closed: its server ended";
        assert_eq!(ended.refusal(1), said);
    }
    place.is_left_clean();
}

#[test]
fn cells_that_measure_are_named_and_only_the_others_are_pressed() {
    let place = TestDir::new();
    place.pressed();
    let bench = by_hand(&place, "1-8");
    let test_client = place.test_client();
    let third = cell(3);
    test_client.waits_for("cell 3", |message| {
        matches!(*message, Message::Network { from, page: NetworkPage::Heartbeat(beat), .. }
            if from == Node::Cell(third) && !beat.state.has(State::CLAIMING_NODE_ID))
    });
    let request = Request::Write { number: Parameter::Mode.number(), words: [0; WORDS] };
    test_client.send(&Message::Configure { to: Node::Cell(third), tag: 9, request });
    test_client.waits_for("its answer", |message| matches!(message, Message::Configured { tag: 9, .. }));

    let ended = place.bench(1.5, "--no-spawn").end().succeeded();
    let said = "these cells use their own sensors, so the scenario does not press them (`skinbus frame configure \
                --cell N --write mode 1` puts one into test mode): 3 on vcan0\n";
    assert!(ended.stderr.contains(said), "{ended:#?}");
    assert!(ended.stdout.contains("cells in mode measure"), "{}", ended.stdout);
    let summary = place.summary();
    summary.adds_up().all_were_due(7, &ended.stderr);
    for (at, cell) in summary.cells().iter().enumerate() {
        let measures = at == 2;
        assert_eq!(cell["node"], at + 1);
        assert_eq!(cell["mode"], if measures { "measure" } else { "test" }, "{cell:#}");
        let compared = cell["error"]["count"].as_u64().unwrap();
        assert_eq!((cell["due"] == 0, compared == 0), (measures, measures), "{cell:#}");
    }
    drop((bench, test_client));
    until("the server's end", || place.processes().is_empty().then_some(()));
}

#[test]
fn a_gateway_without_cells_names_the_missing_ones() {
    let place = TestDir::new();
    place.pressed();
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let ended = place.bench(1.0, "--no-spawn --quiet").end();
    let said = "skinbus: these cells are not ready: 1, 2, 3, 4, 5, 6, 7, 8 on vcan0; start them with cell-node, \
                or omit --no-spawn";
    assert_eq!(ended.refusal(1), said);
    assert_eq!(place.files(), ["buses", "run.json", "scenario.toml", "skin.toml"]);

    // The running cells are enough.
    let cells = place.start("cell-node", "--bus vcan0 --bus-kind embedded --nodes 1-6 --skin skin.toml");
    let ended = place.bench(1.0, "--no-spawn").end().succeeded();
    assert!(ended.stderr.contains("run continues without them: 7, 8 on vcan0"), "{}", ended.stderr);
    let summary = place.summary();
    assert_eq!(summary.adds_up().silent(), [7, 8]);
    summary.all_were_due(6, &ended.stderr);
    drop((cells, server));
    until("the server's end", || place.processes().is_empty().then_some(()));
}

/// Returns how many times a process was woken from a wait.
fn wakes(pid: Pid) -> u64 {
    let status = fs::read_to_string(format!("/proc/{}/status", pid.as_raw_nonzero())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"));
    line.unwrap().trim().parse().unwrap()
}

#[test]
fn joints_wake_the_cells_that_are_touched() {
    let place = TestDir::new();
    place.skin(3);
    let held = PRESSED.replace("all = true", "cells = [1]");
    let often: String = (0..8)
        .map(|number| {
            let at_s = 1.0 + 0.5 * f64::from(number);
            format!(
                "[[touch]]\nat_s = {at_s:.1}\nfor_s = 0.1\ncells = [3]\nforce_n = 2.0\nprofile = \"step\"\n\n"
            )
        })
        .collect();
    place.scenario(&format!("{held}\n{often}"));
    let bench = place.running_bench(600.0, "");
    let client = place.test_client();
    client.waits_for_joints(60);
    let [touched, untouched] = [1, 2].map(|node| bench.cell(node));
    let before = [touched, untouched].map(wakes);
    client.waits_for_joints(200);
    let [of_touched, of_untouched] = [wakes(touched) - before[0], wakes(untouched) - before[1]];
    // The cell sends heartbeats.
    assert!(of_untouched >= 4 && of_untouched * 3 < of_touched * 2, "{of_untouched} beside {of_touched}");
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    let summary = place.summary();
    summary.adds_up();
    // A touch makes joints wake the cell again: no reply of any of the eight is missing.
    let of = |key: &str| summary.of_bus(&format!("/replies/{key}"));
    assert_eq!(of("due"), of("in_time") + of("late") + of("skipped") + of("too_late"), "{:#}", summary.0);
    assert!(of("due") > summary.number("/loop/broadcasts"), "{:#}", summary.0);
    assert_eq!((&summary.cells()[1]["due"], summary.odd(0)), (&0.into(), 0), "{:#}", summary.0);
}
