//! Emulated cells in benches of processes: they count like any other cell.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;

use model::generate::Format as SkinFormat;
use process::log::Log;
use process::{Ended, PRESSED, Running, TestDir, skin_of};
use protocol::can::Format;
use protocol::id::CellId;
use protocol::message::Message;
use rustix::process::Signal;

/// Returns the firmware's file.
fn firmware() -> String {
    std::env::var("SKINBUS_FIRMWARE").expect("tests/firmware/run names it")
}

/// Starts a bench in which the cells of these node ids are emulated.
fn bench(place: &TestDir, seconds: f64, emulate: &str, more: &str) -> Running {
    place.bench(seconds, &format!("--firmware {} --emulate {emulate} {more}", firmware()))
}

/// Returns faults that kill each of these cells, and start it again later.
fn kills(cells: std::ops::RangeInclusive<u8>) -> String {
    let fault = |at: f64, kind: &str, cell: u8| {
        format!("\n[[fault]]\nat_s = {at}\nkind = \"{kind}\"\nbus = \"vcan0\"\ncells = [{cell}]\n")
    };
    let mut faults = String::new();
    let (mut restarts, mut at) = (Vec::new(), 1.5);
    for cell in cells {
        faults += &fault(at, "kill", cell);
        restarts.push((at + 4.5, cell));
        at += 0.4;
    }
    for (at, cell) in restarts {
        faults += &fault(at, "restart", cell);
    }
    faults
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn four_emulated_and_eight_process_cells_lose_only_what_was_on_its_way_at_a_kill() {
    let place = TestDir::new();
    place.skin(12);
    place.scenario(&format!("{PRESSED}{}", kills(9..=12)));
    fs::create_dir(place.path("flash")).unwrap();
    let bench = bench(&place, 600.0, "9,10,11,12", "--flash flash");
    (9..=12).for_each(|cell| bench.wait_for_stderr(&format!("cell {cell} on vcan0 restarted")));
    place.test_client().waits_for_torques(1..=12);
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.of_bus("/uplink/restarts"), 4, "{:#}", summary.0);
    for nothing in ["/uplink/rejected", "/uplink/unknown", "/replies/unknown", "/replies/lost"] {
        assert_eq!(summary.of_bus(nothing), 0, "{nothing}: {:#}", summary.0);
    }
    // No replies are due from dead cells: they are silent for 3.9 s, until they claim again.
    let broadcasts = summary.number("/loop/broadcasts");
    for cell in summary.cells() {
        let (node, due) = (cell["node"].as_u64().unwrap(), cell["due"].as_u64().unwrap());
        let in_doubt = cell["missing"]["in_doubt"].as_u64().unwrap_or(0);
        if node <= 8 {
            assert!(in_doubt == 0 && due <= broadcasts, "{cell:#}");
        } else {
            let dead = broadcasts - due;
            assert!(
                dead * 8 > broadcasts && due > 0,
                "{node} was dead for a while, of {broadcasts}: {cell:#}"
            );
            // A cell counts as dead after 600 ms of silence.
            assert!((1..=due).contains(&in_doubt), "{node}, on its way and after the kill: {cell:#}");
        }
    }
    for cell in 9..=12 {
        // A run does not commission its cells: their parameters come from flash.
        assert_eq!(fs::read(place.path(&format!("flash/vcan0-{cell}.flash"))).unwrap().len(), 133);
    }
    assert!(ended.stderr.contains("cells 9, 10, 11, 12 emulated by "), "{}", ended.stderr);
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn an_emulated_cell_answers_on_fd_and_on_classic_buses() {
    for format in [SkinFormat::Fd, SkinFormat::Classic] {
        let place = TestDir::new();
        place.write("skin.toml", &skin_of(2, 1, format));
        place.scenario(PRESSED);
        bench(&place, 2.0, "2", "").end().succeeded();
        place.is_left_clean();
        let summary = place.summary();
        // If a busy machine stops the emulator for 15 ms between two segments, the packet is lost.
        if format == SkinFormat::Fd {
            summary.adds_up();
        }
        let answered = ["in_time", "late"].map(|how| summary.cells()[1][how].as_u64().unwrap());
        assert!(answered.iter().sum::<u64>() > 12, "{:#}", summary.0);
        assert_eq!(
            summary.of_bus("/uplink/unknown") + summary.of_bus("/uplink/rejected"),
            0,
            "{:#}",
            summary.0
        );
        assert!(summary.figure("/accuracy/single/max_nm") < 0.001, "{:#}", summary.0);
    }
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn an_emulated_cell_sums_with_processes_as_neighbours() {
    let place = TestDir::new();
    process::sums::grid(&place, Format::Fd);
    place.scenario(PRESSED);
    bench(&place, 4.0, "6", "").end().succeeded();
    place.is_left_clean();
    let log = Log::read(&place.read("run.log"), Format::Fd);
    let sums = |is: &dyn Fn(CellId, u8) -> bool| {
        let is = |message: &Message| matches!(message, Message::Sum { from, count, .. } if is(*from, *count));
        log.messages.iter().filter(|(message, _)| is(message)).count()
    };
    assert!(sums(&|from, _| from.get() == 6) > 8, "of the emulated cell, at 20 Hz");
    // Both roots together have all cells.
    let largest = (1..=12).rev().find(|&size| sums(&|_, count| count == size) > 0);
    assert!(largest >= Some(6), "{largest:?}");
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn emulators_end_with_a_gateway_that_is_killed_or_interrupted() {
    for (signal, code) in [(Signal::KILL, None), (Signal::INT, Some(0))] {
        let place = TestDir::new();
        place.pressed();
        let bench = bench(&place, 600.0, "8", "");
        bench.wait_for_loop();
        bench.signal(signal);
        assert_eq!(bench.end().code(), code);
        place.is_left_clean();
    }
}

/// Returns the message of a run that does not begin.
fn refused(place: &TestDir, words: &str) -> String {
    let ended = place.start("skinbus", &format!("run skin.toml --bus-kind embedded --quiet {words}")).end();
    ended.refusal(ended.code().unwrap()).to_owned()
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn what_cannot_be_emulated_is_refused_in_one_line() {
    let place = TestDir::new();
    place.pressed();
    let elf = firmware();
    let says = |words: &str, expected: &str| {
        let line = refused(&place, words);
        assert!(line.contains(expected), "{expected:?} in {line:?}");
    };
    says("--firmware nowhere.elf --emulate 8", "--firmware nowhere.elf: No such file");
    place.write("text", "no program");
    says("--firmware text --emulate 8", "not an ELF file for a 32-bit Arm microcontroller");
    says(&format!("--firmware {elf} --emulate 77"), "--emulate 77: the skin has no such cell on vcan0");
    says(&format!("--firmware {elf} --emulate 8,3,8"), "--emulate 8 is given twice");
    says(&format!("--firmware {elf}"), "--emulate");
    says("--emulate 8", "--firmware");
    says(&format!("--firmware {elf} --emulate 8 --no-spawn"), "--no-spawn");
    place.is_left_clean();
}

/// Runs a bench whose emulator is this script.
fn with_emulator(place: &TestDir, script: Option<&str>) -> Ended {
    let folder = place.path("programs");
    let _ = fs::create_dir(&folder);
    if let Some(script) = script {
        place.script("programs/qemu-system-arm", script);
    }
    let words = format!("run skin.toml --bus-kind embedded --quiet --firmware {} --emulate 8", firmware());
    let mut command = place.command("skinbus", &words);
    command.env("PATH", &folder);
    Running::start(command).end()
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn an_emulator_that_is_missing_or_ends_is_named_with_its_last_line() {
    let place = TestDir::new();
    place.pressed();
    let line = with_emulator(&place, None);
    let missing = "skinbus: --emulate needs qemu-system-arm, which is not in PATH: run `apt-get install qemu-system-arm`";
    assert_eq!(line.refusal(2), missing);
    let ends = "#!/bin/sh\necho 'qemu-system-arm: unsupported machine type' >&2\nexit 1\n";
    let ended = with_emulator(&place, Some(ends));
    let said = "skinbus: the emulator of cell 8 on vcan0 ended before its cell was commissioned (exit status: 1: \
                qemu-system-arm: unsupported machine type)";
    assert_eq!(ended.refusal(1), said);
    place.is_left_clean();
}
