//! `skinbus conformance` against a cell that is a process: the cell passes and is restored, and each possible failure
//! is reported in one line.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;
use std::os::unix::fs::symlink;
use std::time::Duration;

use process::{Running, TestDir, program, until};
use protocol::can::Format;
use protocol::id::Node;
use protocol::message::{Heartbeat, Message, NetworkPage, State};
use protocol::packet::Epoch;
use rustix::process::Signal;
use serde_json::Value;
use tempfile::TempDir;

/// A cell on a bus, which a script switches off and on.
struct Cell {
    place: TestDir,
    format: Format,
    _bus: Running,
    /// The cell's flash is in memory: a cell that waits for a busy disk answers nothing.
    _flash: TempDir,
}

impl Cell {
    fn new(format: Format) -> Self {
        let place = TestDir::new();
        place.write("skin.toml", &process::skin_of(8, 1, format));
        let flash = TempDir::new_in("/dev/shm").or_else(|_| TempDir::new()).unwrap();
        symlink(flash.path(), place.path("flash")).unwrap();
        let bus = place.start("vcan-setup", "serve vcan0");
        until("the bus", || place.buses().exists().then_some(()));
        let script = format!(
            "#!/bin/sh\ncd {}\nif [ -f pid ]; then\n  kill -KILL $(cat pid) 2>/dev/null\n  while kill -0 $(cat pid) 2>/dev/null; do \
             sleep 0.01; done\nfi\n{} --bus vcan0 --bus-kind embedded --node 5 --skin skin.toml --flash flash \
             >cell.log 2>&1 </dev/null &\necho $! >pid\n",
            place.path("").display(),
            program("cell-node").display()
        );
        place.script("restart", &script);
        let cell = Self { place, format, _bus: bus, _flash: flash };
        cell.restart();
        cell
    }

    fn restart(&self) {
        let status = self.place.command_of(&self.place.path("restart"), "").status().unwrap();
        assert!(status.success());
        self.settles();
    }

    /// Waits until the cell answers.
    fn settles(&self) {
        until("the cell", || {
            let words = format!("frame configure --cell 5 --read identity {}", self.bus());
            self.place.start("skinbus", &words).end().code().filter(|code| *code == 0)
        });
    }

    fn conformance(&self, more: &str) -> Running {
        let words = format!("conformance --bus vcan0 --bus-kind embedded --cell 5 {more}");
        self.place.start("skinbus", &words)
    }

    fn bus(&self) -> String {
        format!("--bus vcan0 --bus-kind embedded --format {}", self.format.name())
    }

    /// Waits until its configuration is saved, and a moment longer.
    fn is_tested(&self) {
        until("the file", || self.place.path("conformance-vcan0-5.json").exists().then_some(()));
        std::thread::sleep(Duration::from_millis(900));
    }

    /// Returns the values in use.
    fn has(&self) -> Vec<String> {
        let read = |parameter: &&str| {
            let words = format!("frame configure --cell 5 --read {parameter} {}", self.bus());
            self.place.start("skinbus", &words).end().succeeded().stdout
        };
        ["mount", "pose", "contact", "timing", "mode", "events", "16", "21"].iter().map(read).collect()
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        let pid = fs::read_to_string(self.place.path("pid")).unwrap_or_default();
        if let Some(pid) = pid.trim().parse().ok().and_then(rustix::process::Pid::from_raw) {
            let _ = rustix::process::kill_process(pid, Signal::KILL);
        }
    }
}

/// Runs a whole test; a late machine does not affect its results here.
fn passes(format: Format) {
    let cell = Cell::new(format);
    let before = cell.has();
    let restart = cell.place.path("restart");
    let words = format!("--restart {} --json --junit cell.xml", restart.display());
    let ended = cell.conformance(&words).end_after(Duration::from_secs(300));
    let whole: Value = serde_json::from_str(&ended.stdout).unwrap_or_else(|_| panic!("{ended:#?}"));
    let requirements = whole["requirements"].as_array().unwrap();
    let timed = |id: &str| id.starts_with("TIME") || id.starts_with("BEAT-1") || id.starts_with("BEAT-2");
    // On a machine that keeps the process waiting the cell skips joints, as it should: requirements that failed are
    // tested again alone.
    let failed = |whole: &Value| -> Vec<Value> {
        let all = whole["requirements"].as_array().unwrap().iter();
        all.filter(|it| it["verdict"] == "failed" && !timed(it["id"].as_str().unwrap())).cloned().collect()
    };
    for requirement in failed(&whole) {
        let alone = format!(
            "--restart {} --json --requirement {}",
            restart.display(),
            requirement["id"].as_str().unwrap()
        );
        let meets = || {
            let ended = cell.conformance(&alone).end_after(Duration::from_secs(300));
            serde_json::from_str(&ended.stdout).is_ok_and(|whole: Value| failed(&whole).is_empty())
        };
        assert!((0..5).any(|_| meets()), "six times: {requirement:#}");
    }
    assert_eq!(whole["stopped"], Value::Null);
    let [passed, failed] = ["passed", "failed"].map(|verdict| whole[verdict].as_u64().unwrap());
    assert!(passed > 0 && passed + failed > 65, "{whole:#}");
    assert_eq!(whole["format"], format.name());
    assert!(whole["seconds"].as_f64().unwrap() > 0.0);
    cell.settles();
    assert_eq!(cell.has(), before, "it is left as it was");
    assert!(!cell.place.path("conformance-vcan0-5.json").exists());
    let junit = cell.place.read("cell.xml");
    let case = "<testcase classname=\"cell.md\" name=\"CONF-7 a commit with the right hash puts the writes into effect\"/>";
    assert!(junit.contains(case), "{junit}");
    assert_eq!(junit.matches("<testcase").count(), requirements.len());
}

#[test]
fn a_cell_of_this_project_passes_on_an_fd_bus_and_is_left_as_it_was() {
    passes(Format::Fd);
}

#[test]
fn a_cell_of_this_project_passes_on_a_classic_bus_and_is_left_as_it_was() {
    passes(Format::Classic);
}

#[test]
fn a_test_that_is_interrupted_puts_the_cell_back() {
    for signal in [Signal::INT, Signal::TERM] {
        let cell = Cell::new(Format::Fd);
        let before = cell.has();
        let test = cell.conformance("");
        cell.is_tested();
        test.signal(signal);
        let ended = test.end();
        assert_eq!(ended.code(), Some(1), "{ended:#?}");
        assert_eq!(ended.stderr, "skinbus: interrupted; the cell has been restored\n");
        assert!(ended.stdout.contains("not tested"), "{ended:#?}");
        assert_eq!(cell.has(), before);
        assert!(!cell.place.path("conformance-vcan0-5.json").exists());
    }
}

#[test]
fn after_a_kill_the_file_puts_the_cell_back() {
    let cell = Cell::new(Format::Fd);
    let before = cell.has();
    let test = cell.conformance("");
    cell.is_tested();
    test.signal(Signal::KILL);
    test.end();
    assert!(cell.place.path("conformance-vcan0-5.json").exists());
    let refused = cell.conformance("").end();
    assert_eq!(
        refused.refusal(2),
        "skinbus: an earlier test left conformance-vcan0-5.json and did not restore the cell: restore the cell with \
         --restore conformance-vcan0-5.json, or delete the file"
    );
    cell.conformance("--restore conformance-vcan0-5.json").end().succeeded();
    assert_eq!(cell.has(), before);
    assert!(!cell.place.path("conformance-vcan0-5.json").exists());
}

#[test]
fn a_cell_that_dies_is_said_and_its_file_is_kept() {
    let cell = Cell::new(Format::Fd);
    let before = cell.has();
    let test = cell.conformance("");
    cell.is_tested();
    let pid = cell.place.read("pid").trim().parse().ok().and_then(rustix::process::Pid::from_raw).unwrap();
    process::signal(pid, Signal::KILL);
    let ended = test.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert!(ended.stderr.contains("the cell was not restored: the cell stopped sending"), "{ended:#?}");
    assert!(ended.stderr.lines().count() == 1, "{ended:#?}");
    cell.restart();
    cell.conformance("--restore conformance-vcan0-5.json").end().succeeded();
    assert_eq!(cell.has(), before);
}

#[test]
fn what_cannot_be_tested_is_refused_in_a_line() {
    let cell = Cell::new(Format::Fd);
    let refusals = [
        (
            "--requirement CONFI",
            2,
            "--requirement CONFI: no requirement has this id; give an id such as CONF-7, or a group such as CONF",
        ),
        ("--format classic", 1, "cell 5 sends fd frames on vcan0, not classic: use --format fd"),
        ("--restart false --requirement CLAIM", 1, "the command of --restart failed: exit status: 1"),
    ];
    for (words, code, line) in refusals {
        let ended = cell.conformance(words).end();
        assert_eq!(ended.code(), Some(code), "{ended:#?}");
        assert_eq!(ended.stderr, format!("skinbus: {line}\n"));
    }
    let of = |node: u8| {
        let words = format!("conformance --bus vcan0 --bus-kind embedded --cell {node} --requirement J");
        cell.place.start("skinbus", &words).end()
    };
    assert_eq!(
        of(6).refusal(1),
        "skinbus: cell 6 sends nothing on vcan0, but these cells do: 5; switch the cell on, or give its actual \
         node id"
    );
    let words = "--bus vcan0 --bus-kind embedded --node 3 --skin skin.toml";
    let other = cell.place.start("cell-node", words);
    cell.settles();
    until("the other cell", || {
        let listed = cell.place.start("skinbus", "cells vcan0 --bus-kind embedded --json").end();
        listed.stdout.contains("\"node\": 3").then_some(())
    });
    assert_eq!(
        of(5).refusal(1),
        "skinbus: other cells are on vcan0: 3; the test would send joints and halt messages to them too: disconnect \
         them, or use --others-will-stop"
    );
    // A busy machine may keep the cell waiting for longer than its time to answer.
    until("a test beside a cell that is tolerated", || {
        let tolerated = cell.conformance("--others-will-stop --requirement CMD").end();
        (tolerated.code() == Some(0) && tolerated.stdout.contains("4 passed, 0 failed")).then_some(())
    });
    drop(other);
}

/// Returns a heartbeat of another cell with the cell's node id.
fn twin() -> Message {
    let beat = Heartbeat { serial: 77, state: State::default().with_joint(0), ..Heartbeat::default() };
    let from = Node::from_byte(5);
    Message::Network { from, epoch: Epoch(0), page: NetworkPage::Heartbeat(beat) }
}

#[test]
fn a_second_cell_with_its_node_id_and_a_second_gateway_are_named() {
    let cell = Cell::new(Format::Fd);
    let before = cell.has();
    let client = cell.place.test_client();
    let test = cell.conformance("--requirement CMD");
    until("a refusal", || {
        client.send(&twin());
        (!test.stderr().is_empty()).then_some(())
    });
    assert_eq!(
        test.end().refusal(1),
        "skinbus: 2 cells send as node 5 on vcan0, with the serial numbers 77 and 100005: remove all but one"
    );
    // A gateway that begins to command in the middle of a test.
    let test = cell.conformance("");
    cell.is_tested();
    client.send(&Message::Resume);
    let ended = test.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert_eq!(
        ended.stderr,
        "skinbus: another program sent frame 003##500000000000000000000000000004782 to the cells: stop the gateway on \
         this bus\n"
    );
    assert_eq!(cell.has(), before);
    let test = cell.conformance("--requirement CMD");
    until("a refusal", || {
        client.send(&Message::Resume);
        (!test.stderr().is_empty()).then_some(())
    });
    let said = test.end();
    assert!(said.refusal(1).starts_with("skinbus: a gateway sends on vcan0 (frame 003##5"), "{said:#?}");
}

#[test]
fn other_cells_that_send_much_do_not_matter_if_they_are_tolerated() {
    let cell = Cell::new(Format::Fd);
    let client = cell.place.test_client();
    let from = protocol::id::CellId::new(9).unwrap();
    let torque = protocol::packet::Words::zeros(protocol::packet::Length::Six);
    let flood = Message::Torque { from, epoch: Epoch(1), torque };
    // A busy machine may keep the cell waiting for longer than its time to answer.
    until("a test beside a flood that is passed", || {
        let mut test = cell.conformance("--requirement CMD,STIM,CONF --others-will-stop");
        let file = cell.place.path("conformance-vcan0-5.json");
        while test.is_running() {
            client.send(&flood);
            std::thread::sleep(Duration::from_micros(300));
        }
        let passed = test.end().stdout.contains(" 0 failed");
        if file.exists() {
            cell.conformance("--restore conformance-vcan0-5.json").end();
        }
        passed.then_some(())
    });
}
