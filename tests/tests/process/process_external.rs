//! Another program closes the loop of a bench of real processes, correctly or with faults.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::time::{Duration, Instant};

use process::external::{answer, place};
use process::{Running, TIMEOUT, TestDir, example, until};
use protocol::message::Message;
use rustix::process::Signal;

const MISSING: &str = "the external controller's answer is missing";
const NOBODY: &str = "no external controller is connected";
const NONSENSE: &str = "the external controller sent nonsense";

/// Starts the example in Python.
fn python(place: &TestDir) -> Running {
    let mut command = Command::new("python3");
    command.arg(example("external_controller.py")).arg(place.path("controller.sock"));
    Running::start(command)
}

#[test]
fn the_example_in_python_moves_the_arm() {
    // A busy machine must not halt the robot.
    let place = place(10_000);
    let python = python(&place);
    python.wait_for_stderr("waiting for a gateway at ");
    let bench = place.running_bench(600.0, "");
    place.test_client().waits_for_motion();
    python.wait_for_stdout(" 8 cells ");
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.is_left_clean();
    assert_eq!(place.files(), ["run.json", "run.log", "scenario.toml", "skin.toml"], "no socket is left");
    let summary = place.summary();
    summary.adds_up();
    assert!(summary.0["halted"].is_null() && summary.0["outcome"] == "interrupted", "{:#}", summary.0);
    // It is there when the loop begins; later it may be late, depending on the machine.
    assert_eq!(summary.count("/loop/bad_cycles", NONSENSE), 0, "{:#}", summary.0);
    assert!(summary.total("/loop/bad_cycles") < summary.number("/loop/ticks"), "{:#}", summary.0);
}

#[test]
fn a_controller_that_begins_later_is_waited_for() {
    let place = place(250);
    place.write("skin.toml", &place.read("skin.toml").replace("start_s = 0.0", "start_s = 600.0"));
    let bench = place.running_bench(600.0, "");
    // More ticks than it may miss after it has begun: each broadcast is in a tick of its own.
    place.test_client().waits_for_joints(260);
    let python = python(&place);
    place.test_client().waits_for_motion();
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    assert!(!ended.stderr.contains("halted"), "{}", ended.stderr);
    place.is_left_clean();
    let summary = place.summary();
    assert!(summary.count("/loop/bad_cycles", NOBODY) >= 250, "{:#}", summary.0);
    assert_eq!(summary.0["halts"], serde_json::json!([]));
    summary.adds_up();
    drop(python);
}

#[test]
fn a_controller_that_is_killed_halts_the_robot_and_another_one_takes_over_after_ack() {
    let place = place(1_000);
    let first = python(&place);
    first.wait_for_stderr("waiting for a gateway at ");
    let bench = place.running_bench(600.0, "");
    place.test_client().waits_for_motion();
    first.signal(Signal::KILL);
    assert_eq!(first.end().signal(), Some(9));
    bench.wait_for_stderr(&format!(
        "the robot is halted: too many bad cycles in a row: {NOBODY}; `skinbus frame resume --bus vcan0 --bus-kind embedded`"
    ));
    // A hello does not resume the robot; a person has to do that.
    let second = python(&place);
    second.wait_for_stdout("HALTED");
    assert!(!bench.stderr().contains("the robot continues"), "{}", bench.stderr());
    place.start("skinbus", "frame resume --skin skin.toml --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    place.test_client().waits_for_motion();
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    assert!(summary.count("/loop/bad_cycles", NOBODY) >= 1_000 - 1, "{:#}", summary.0);
    summary.adds_up();
}

#[test]
fn a_controllers_nonsense_is_counted_and_ignored() {
    let place = place(25);
    let gateway = place.path("controller.sock");
    let own = UnixDatagram::bind(place.path("peer.sock")).unwrap();
    own.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
    let bench = place.bench(600.0, "");
    until("the gateway's socket", || gateway.exists().then_some(()));
    own.send_to(&[b"SKBC".as_slice(), &[1, 0, 3, 0]].concat(), &gateway).unwrap();

    let mut state = [0; 200];
    let (mut sent, give_up) = (0, Instant::now() + TIMEOUT);
    while sent < 200 {
        assert!(Instant::now() < give_up, "the gateway stopped sending to us: {}", bench.stderr());
        let Ok(184) = own.recv(&mut state) else { continue };
        let tick = u64::from_le_bytes(state[8..16].try_into().unwrap());
        let good = answer(tick, 1.0);
        let mut magic = good.clone();
        magic[0] = b'X';
        let nonsense: [&[u8]; 6] = [
            &answer(tick, f64::NAN),
            &answer(tick, f64::INFINITY),
            &good[..71],
            &[good.as_slice(), b"?"].concat(),
            &magic,
            &answer(tick + 1_000, 1.0),
        ];
        let _ = own.send_to(nonsense[sent % nonsense.len()], &gateway);
        sent += 1;
    }
    bench.wait_for_stderr("the robot is halted: too many bad cycles in a row: ");
    bench.signal(Signal::TERM);
    let ended = bench.end();
    assert_eq!(ended.code(), Some(3), "{ended:#?}");
    place.is_left_clean();
    assert_eq!(ended.stderr.matches("panicked").count(), 0);
    let summary = place.summary();
    summary.adds_up();
    assert!(summary.count("/loop/bad_cycles", NONSENSE) > 0, "{:#}", summary.0);
    let reasons = [NONSENSE, NOBODY, MISSING].map(|reason| summary.count("/loop/bad_cycles", reason));
    assert_eq!(summary.total("/loop/bad_cycles"), reasons.iter().sum::<u64>());
    // Nothing of it was executed: the robot has not moved.
    let log = process::log::Log::read(&place.read("run.log"), protocol::can::Format::Fd);
    let mut positions = log.joints();
    positions.dedup();
    assert_eq!(positions.len(), 1);
    assert!(log.messages.iter().any(|(message, _)| *message == Message::Halt), "the cells are halted");
}

/// Runs a bench whose controller may take longer to begin than the run lasts; `control` creates the part of it that
/// exists.
fn ends_without_controller(control: impl FnOnce(&TestDir), why: &str) {
    let place = place(25);
    place.write("skin.toml", &place.read("skin.toml").replace("start_s = 0.0", "start_s = 600.0"));
    let bench = place.bench(600.0, "--quiet");
    let gateway = place.path("controller.sock");
    until("the gateway's socket", || gateway.exists().then_some(()));
    control(&place);
    // The loop runs, and this number of ticks is over.
    place.test_client().waits_for_joints(30);
    bench.signal(Signal::TERM);
    let ended = bench.end();
    place.is_left_clean();
    assert_eq!(ended.code(), Some(4), "{ended:#?}");
    let line = ended.stderr.trim_end();
    assert!(line.starts_with("skinbus: ") && !line.contains('\n'), "one line, though quiet: {ended:#?}");
    assert!(line.contains(why) && line.contains("controller.sock"), "{line}");
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.0["outcome"], "no_controller", "{:#}", summary.0);
    assert_eq!(summary.0["no_controller"], line.trim_start_matches("skinbus: "));
    assert_eq!(summary.0["halts"], serde_json::json!([]), "it had time to begin");
    assert!(ended.head().contains("no controller"), "{}", ended.stdout);
}

#[test]
fn a_run_to_which_no_controller_comes_has_an_outcome_of_its_own() {
    let place = place(25);
    place.write("skin.toml", &place.read("skin.toml").replace("start_s = 0.0", "start_s = 600.0"));
    let ended = place.bench(2.0, "--quiet").end();
    assert_eq!((ended.code(), ended.stderr.lines().count()), (Some(4), 1), "{ended:#?}");
    assert!(ended.stderr.contains("no external controller sent a hello on "), "{ended:#?}");
    let summary = place.summary();
    let bad = summary.count("/loop/bad_cycles", NOBODY);
    assert_eq!((&summary.0["outcome"], bad), (&"no_controller".into(), summary.number("/loop/ticks")));
    ends_without_controller(|_| {}, "no external controller sent a hello on ");
}

#[test]
fn a_program_that_says_hello_in_another_version_is_no_controller() {
    let control = |place: &TestDir| {
        let own = UnixDatagram::bind(place.path("peer.sock")).unwrap();
        let hello = [b"SKBC".as_slice(), &[2, 0, 3, 0]].concat();
        own.send_to(&hello, place.path("controller.sock")).unwrap();
    };
    ends_without_controller(control, "(1 datagram received, but none is a hello of this version)");
}

#[test]
fn a_controller_that_says_hello_and_does_not_answer_is_none() {
    let mut peer = None;
    let control = |place: &TestDir| {
        let own = UnixDatagram::bind(place.path("peer.sock")).unwrap();
        own.send_to(&[b"SKBC".as_slice(), &[1, 0, 3, 0]].concat(), place.path("controller.sock")).unwrap();
        // It stays connected, and reads nothing.
        peer = Some(own);
    };
    ends_without_controller(control, " sent a hello but answered no tick in time (");
    drop(peer);
}
