//! Benches whose robot is halted: their messages, and their exit code.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::os::unix::net::UnixDatagram;
use std::time::{Duration, Instant};

use process::external::{answer, place};
use process::{PRESSED, Running, Summary, TIMEOUT, TestDir, until};
use protocol::message::Message;
use rustix::process::Signal;
use serde_json::Value;

const MISSING: &str = "the external controller's answer is missing";
const NOBODY: &str = "no external controller is connected";
/// The end of the last line of a run that was halted.
const HISTORY: &str = "; --summary FILE saves the ticks before the halt";

/// Answers a number of ticks, then only listens until the robot is halted.
fn control(place: &TestDir, bench: &Running, answers: u32) {
    let gateway = place.path("controller.sock");
    let own = UnixDatagram::bind(place.path("peer.sock")).unwrap();
    own.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
    until("the gateway's socket", || gateway.exists().then_some(()));
    own.send_to(&[b"SKBC".as_slice(), &[1, 0, 3, 0]].concat(), &gateway).unwrap();
    let (mut state, mut answered, give_up) = ([0; 200], 0, Instant::now() + TIMEOUT);
    loop {
        assert!(Instant::now() < give_up, "the robot is not halted: {}", bench.stderr());
        let Ok(184) = own.recv(&mut state) else { continue };
        if state[32] & 2 != 0 {
            return;
        }
        if answered < answers {
            answered += 1;
            let _ = own.send_to(&answer(u64::from_le_bytes(state[8..16].try_into().unwrap()), 0.1), &gateway);
        }
    }
}

/// Checks that a run reported a halt that lasted to its end, in the table and on standard error; returns the halt.
fn ended_halted(ended: &process::Ended, summary: &Summary, reason: &str) -> Value {
    assert_eq!(ended.code(), Some(3), "{ended:#?}");
    let halts = summary.0["halts"].as_array().unwrap();
    let halted = halts.last().unwrap().clone();
    let (at, epoch) = (halted["at_s"].as_f64().unwrap(), halted["epoch"].as_u64().unwrap());
    assert_eq!(
        ended.stderr.lines().last().unwrap(),
        format!(
            "skinbus: the robot was halted at {at:.3} s (epoch {epoch}) and not resumed: {reason}{HISTORY}"
        )
    );
    let head = ended.head();
    assert!(head.contains(&format!("halted at {at:.3} s")) && !head.contains("done"), "{head}");
    // It may be broken into several lines.
    let last = reason.split(' ').next_back().unwrap();
    assert!(ended.stdout.lines().any(|line| line.contains(last)), "{}", ended.stdout);
    assert_eq!((&summary.0["outcome"], &summary.0["halted"]), (&"halted".into(), &reason.into()));
    assert_eq!((&halted["reason"], &halted["until_s"]), (&reason.into(), &Value::Null));
    summary.adds_up();
    halted
}

/// Returns the ticks up to the last halt; the last one is that of the halt.
fn before<'a>(summary: &'a Summary, halted: &Value) -> &'a [Value] {
    let before = summary.0["before_halt"].as_array().unwrap();
    let ticks: Vec<_> = before.iter().map(|tick| tick["tick"].as_u64().unwrap()).collect();
    assert!(ticks.is_sorted() && before.len() <= 200, "{ticks:?}");
    assert_eq!(before.last().unwrap()["tick"], halted["tick"]);
    let (last, others) = before.split_last().unwrap();
    assert!(last["halted"] == true && others.iter().all(|tick| tick["halted"] == false));
    before
}

#[test]
fn a_controller_that_stops_answering_ends_a_run_with_3_and_its_last_ticks_are_told() {
    const BAD: usize = 100;
    let place = place(100);
    let bench = place.bench(600.0, "--quiet");
    control(&place, &bench, 300);
    bench.signal(Signal::TERM);
    let ended = bench.end();
    place.is_left_clean();
    let summary = place.summary();
    let reason = format!("too many bad cycles in a row: {MISSING}");
    let halted = ended_halted(&ended, &summary, &reason);
    assert_eq!(ended.stderr.lines().count(), 1, "quiet, but for the end: {ended:#?}");
    assert_eq!(summary.0["interrupted"], true, "a signal ended it, after the halt");

    let before = before(&summary, &halted);
    let (good, bad) = before.split_at(before.len() - BAD);
    assert!(bad.iter().all(|tick| tick["bad_cycle"].is_string()), "{bad:#?}");
    assert_eq!(bad.last().unwrap()["bad_cycle"], MISSING);
    let last_good = good.last().unwrap();
    assert_eq!((&last_good["bad_cycle"], &last_good["valid"]), (&Value::Null, &true.into()));
    let moves = |tick: &Value, speed: f64| {
        let command: Vec<_> = tick["command_rad_s"].as_array().unwrap().iter().map(Value::as_f64).collect();
        command == [Some(speed); 6]
    };
    assert!(moves(last_good, 0.1) && moves(&bad[0], 0.1) && moves(&bad[BAD - 1], 0.0), "{bad:#?}");
    for key in ["q_rad", "qdot_rad_s", "torque_nm"] {
        assert_eq!(last_good[key].as_array().unwrap().len(), 6);
    }
}

#[test]
fn without_any_controller_a_run_that_comes_to_its_end_was_halted() {
    let place = place(25);
    let ended = place.bench(2.0, "").end();
    place.is_left_clean();
    let summary = place.summary();
    let halted = ended_halted(&ended, &summary, &format!("too many bad cycles in a row: {NOBODY}"));
    assert_eq!(summary.0["interrupted"], false);
    let before = before(&summary, &halted);
    assert_eq!(before.len(), 25, "from the first tick on: {before:#?}");
    assert!(before.iter().all(|tick| tick["bad_cycle"] == NOBODY));
}

#[test]
fn a_lost_bus_that_halts_is_named_and_the_exit_code_is_that_of_the_halt() {
    let place = TestDir::new();
    let skin = process::skin_of(8, 2, model::generate::Format::Fd);
    // A bus for which only this machine is late is not lost.
    let safety = "[safety]\nlost_bus = \"halt\"\nhold_epochs = 100\nbad_cycles = 100\n\n[controller]";
    place.write("skin.toml", &skin.replacen("[controller]", safety, 1));
    place.scenario(PRESSED.replace("hold", "kinesthetic").as_str());
    let server = place.start("vcan-setup", "serve vcan1");
    server.wait_for_stdout("serving vcan1 at ");
    let bench = place.running_bench(600.0, "");
    process::test_client::TestClient::on(&place, "vcan1", protocol::can::Format::Fd).waits_for_epoch(20);
    server.signal(Signal::TERM);
    server.end().succeeded();
    bench.wait_for_stderr("the robot is halted: too many bad cycles in a row: the torque is not valid");
    bench.signal(Signal::TERM);
    let ended = bench.end();
    place.is_left_clean();
    let summary = place.summary();
    let halted = ended_halted(&ended, &summary, "too many bad cycles in a row: the torque is not valid");
    assert!(
        ended.stderr.contains("\nskinbus: these buses did not work when the run ended: vcan1\n"),
        "{ended:#?}"
    );
    let before = before(&summary, &halted);
    let last = before.last().unwrap();
    assert_eq!((&last["valid"], &last["lost_buses"]), (&false.into(), &serde_json::json!(["vcan1"])));
    let whole = &before[before.len() - 101];
    assert_eq!((&whole["valid"], &whole["lost_buses"]), (&true.into(), &serde_json::json!([])));
}

#[test]
fn a_resumed_halt_is_reported_and_the_run_succeeds() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    test_client.waits_for_epoch(10);
    place.start("skinbus", "frame halt --bus vcan0 --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot is halted: a halt frame was received");
    place.start("skinbus", "frame resume --skin skin.toml --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!((&summary.0["outcome"], &summary.0["halted"]), (&"interrupted".into(), &Value::Null));
    let [halted] = summary.0["halts"].as_array().unwrap().as_slice() else { panic!("{:#}", summary.0) };
    let [at, until] = ["at_s", "until_s"].map(|key| halted[key].as_f64().unwrap());
    assert!(until > at && at > 0.0, "{halted}");
    assert!(ended.stdout.contains(&format!("{at:.3} s to {until:.3} s")), "{}", ended.stdout);
    assert_eq!(before(&summary, halted).last().unwrap()["bad_cycle"], Value::Null);
}

#[test]
fn an_incomplete_recording_takes_precedence_over_a_halt() {
    let place = place(25);
    let words = "run skin.toml --bus-kind embedded --scenario scenario.toml --duration 1 --candump /dev/full \
                 --summary run.json --quiet";
    let ended = place.start("skinbus", words).end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let said: Vec<_> = ended.stderr.lines().collect();
    let halted = format!(" and not resumed: too many bad cycles in a row: {NOBODY}{HISTORY}");
    assert!(said.iter().any(|line| line.ends_with(&halted)), "{ended:#?}");
    assert!(said.last().unwrap().starts_with("skinbus: the recording is incomplete: "), "{ended:#?}");
    let summary = place.summary();
    assert_eq!(summary.0["outcome"], "failed");
    assert!(summary.0["halted"].is_string() && !before(&summary, &summary.0["halts"][0]).is_empty());
}

#[test]
fn cells_that_are_halted_at_the_end_of_a_run_are_no_halt_of_the_robot() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    place.test_client().waits_for_epoch(5);
    bench.signal(Signal::INT);
    let ended = bench.end().succeeded();
    let log = process::log::Log::read(&place.read("run.log"), protocol::can::Format::Fd);
    assert!(log.messages.iter().any(|(message, _)| *message == Message::Halt), "the cells are halted");
    let summary = place.summary();
    assert_eq!((&summary.0["outcome"], &summary.0["halts"]), (&"interrupted".into(), &serde_json::json!([])));
    assert_eq!(summary.0["before_halt"], serde_json::json!([]));
    assert!(ended.head().contains("interrupted"), "{}", ended.stdout);
}
