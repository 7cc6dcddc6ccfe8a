//! However a bench ends, no process or file of it remains.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

use skinbus_tests::process;

use std::os::unix::process::CommandExt;

use process::log::Log;
use process::{Running, TestDir, is_stopped, until};
use protocol::can::Format;
use protocol::message::Message;
use rustix::process::{Signal, kill_process_group};

#[test]
fn all_processes_end_with_a_killed_gateway() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    assert_eq!(bench.cells().len(), 8);
    // Also a stopped cell, which handles no signal.
    let stopped = bench.cell(5);
    process::signal(stopped, Signal::STOP);
    until("a stopped cell", || is_stopped(stopped).then_some(()));
    bench.signal(Signal::KILL);
    assert_eq!(bench.end().signal(), Some(9));
    place.is_left_clean();
}

#[test]
fn a_signal_ends_a_bench_early_and_well() {
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        let place = TestDir::new();
        place.pressed();
        let bench = place.running_bench(600.0, "");
        place.test_client().waits_for_epoch(10);
        bench.signal(signal);
        let ended = bench.end().succeeded();
        place.is_left_clean();
        assert!(ended.stdout.contains("interrupted") && ended.stdout.contains("8 cells"), "{}", ended.stdout);
        assert_eq!(place.files(), ["run.json", "run.log", "scenario.toml", "skin.toml"]);
        let summary = place.summary();
        summary.adds_up();
        assert_eq!(summary.0["interrupted"], true);
        assert!(summary.figure("/duration_s") < 600.0, "{:#}", summary.0);
        let log = Log::read(&place.read("run.log"), Format::Fd);
        assert_eq!(summary.number("/recording/frames"), log.frames.len() as u64);
        // The cells are halted, and not resumed.
        let last = log.messages.iter().rev().find_map(|(message, _)| match message {
            Message::Halt | Message::Resume | Message::Joints { .. } => Some(*message),
            _ => None,
        });
        assert_eq!(last, Some(Message::Halt));
    }
}

#[test]
fn ctrl_c_on_a_terminal_reaches_the_gateway_alone() {
    let place = TestDir::new();
    place.pressed();
    // A terminal signals the whole process group at once.
    let mut command = place.command(
        "skinbus",
        "run skin.toml --bus-kind embedded --scenario scenario.toml --duration 600 --summary run.json",
    );
    let bench = Running::start({
        command.process_group(0);
        command
    });
    bench.wait_for_loop();
    place.test_client().waits_for_epoch(10);
    kill_process_group(bench.pid(), Signal::INT).unwrap();
    let ended = bench.end().succeeded();
    place.is_left_clean();
    assert!(
        !ended.stderr.contains("ended (signal") && !ended.stderr.contains("cell-node"),
        "{}",
        ended.stderr
    );
    let summary = place.summary();
    assert_eq!(summary.0["interrupted"], true);
    assert_eq!(summary.adds_up().silent().len(), 0);
}

#[test]
fn a_signal_while_starting_is_a_failed_run_with_a_summary_and_a_log() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.bench(600.0, "--quiet --record run.mcap");
    until("the first cells", || (!bench.cells().is_empty()).then_some(()));
    bench.signal(Signal::INT);
    assert_eq!(bench.end().refusal(1), "skinbus: the run was interrupted while it was starting");
    place.is_left_clean();
    assert_eq!(place.summary().0["failure"], "the run was interrupted while it was starting");
    // Frames received before are in the log, if there were any.
    let files: Vec<_> = place.files().into_iter().filter(|name| name != "run.log").collect();
    assert_eq!(files, ["run.json", "scenario.toml", "skin.toml"]);
    assert!(!place.path("run.log").exists() || !place.read("run.log").is_empty());
}

#[test]
fn a_bus_that_goes_away_ends_the_run_with_one_line_and_the_frames_until_then() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    place.test_client().waits_for_epoch(10);
    let (server, _) = place.processes().into_iter().find(|(_, line)| line.contains("vcan-setup")).unwrap();
    process::signal(server, Signal::TERM);
    let ended = bench.end();
    place.is_left_clean();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert!(ended.stdout.contains("8 cells, ") && ended.stdout.contains(" s, failed "), "{}", ended.stdout);
    // The cells notice it too, and may be quicker.
    let usual = |line: &&str| {
        line.contains(" s  ") || *line == "starting" || line.starts_with("the process of cell ")
    };
    let said: Vec<_> = ended.stderr.lines().filter(|line| !usual(line)).collect();
    assert_eq!(said.len(), 3, "which bus, how much is in the log, and why it ended: {said:#?}");
    assert_eq!(said[2], "skinbus: the embedded bus vcan0 was closed: its server ended");
    assert_eq!(place.files(), ["run.json", "run.log", "scenario.toml", "skin.toml"]);
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.0["outcome"], "failed");
    assert_eq!(summary.0["failure"], "the embedded bus vcan0 was closed: its server ended");
    assert_eq!(summary.0["buses"][0]["outages"]["at_end"], true);
    assert!(Log::read(&place.read("run.log"), Format::Fd).joints().len() >= 10);
}

#[test]
fn a_reader_that_ends_loses_the_table_and_not_the_summary() {
    let place = TestDir::new();
    place.pressed();
    let script = "\"$0\" run skin.toml --bus-kind embedded --scenario scenario.toml --duration 0.5 \
                  --summary run.json --quiet | true";
    let mut command = std::process::Command::new("sh");
    command.args(["-c", script]).arg(process::program("skinbus"));
    command.current_dir(place.path("")).env("SKINBUS_DIR", place.buses());
    Running::start(command).end();
    place.is_left_clean();
    place.summary().adds_up();
}
