//! The packet commands on an embedded bus.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bench::bus::listen::{Listener, send_message};
use model::decode::Decoded;
use protocol::bus::{Bus, BusKind, BusOptions, Inbox, KindChoice};
use protocol::can::{Format, Frame};
use protocol::candump;
use protocol::candump::CandumpLine;
use protocol::id::{CellId, Node};
use protocol::message::{Answer, Heartbeat, Message, NetworkPage, Request, State};
use protocol::packet::Epoch;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;
use vcan_setup::embedded::ServerThread;

use super::*;
use crate::convert::{catches_interrupts, until};

/// A bus for one test.
struct Bench {
    parent: TempDir,
    _served: ServerThread,
}

impl Bench {
    fn new() -> Self {
        let parent = TempDir::new().unwrap();
        let served = ServerThread::start_in(&parent.path().join("skinbus"), "vcan0").unwrap();
        Self { parent, _served: served }
    }

    fn directory(&self) -> PathBuf {
        self.parent.path().join("skinbus")
    }

    fn gateway(&self, arguments: &str) -> Command {
        let mut command = gateway(&format!("{arguments} --bus-kind embedded"));
        command.env("SKINBUS_DIR", self.directory());
        command
    }

    /// Starts a dump and waits until it receives.
    fn dump(&self, arguments: &str) -> Child {
        let mut command = self.gateway(&format!("dump vcan0 {arguments}"));
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let expected = "listening on vcan0, a bus of kind embedded\n";
        let mut line = vec![0; expected.len()];
        child.stderr.as_mut().unwrap().read_exact(&mut line).unwrap();
        assert_eq!(text(&line), expected);
        child
    }

    fn send(&self, arguments: &str) {
        let Output { status, stdout, stderr } = self.gateway(arguments).output().unwrap();
        let said = (status.code(), text(&stdout), text(&stderr));
        assert_eq!(said, (Some(0), "", "sent on vcan0 (embedded)\n"), "{arguments}");
    }

    /// Runs `work` while cell 12 is on the bus: it sends heartbeats, and answers requests for its identity and its
    /// mount.
    fn beside<T>(&self, format: Format, work: impl FnOnce() -> T) -> T {
        let (mut cell, over) = (Listener::new(self.open(), Some(format)), AtomicBool::new(false));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let from = CellId::new(12).unwrap();
                while !over.load(Ordering::Relaxed) {
                    let page = NetworkPage::Heartbeat(Heartbeat {
                        serial: 1,
                        state: State(0x1000),
                        ..Heartbeat::default()
                    });
                    let mut answers =
                        vec![Message::Network { from: Node::Cell(from), epoch: Epoch(0), page }];
                    cell.receive(Duration::from_millis(20)).unwrap();
                    for (_, decoded) in cell.decoded_frames() {
                        let Decoded::Message(Message::Configure { tag, request, .. }) = decoded else {
                            continue;
                        };
                        let answer = match request {
                            // Without abilities, like the first cells.
                            Request::Read { number: 0 } => {
                                Answer::Value { number: 0, written: false, words: [1, 0, 1, 0, 0x1000, 0] }
                            }
                            Request::Read { number: 1 } => {
                                Answer::Value { number: 1, written: false, words: [2, 6, 0, 0, 0, 0] }
                            }
                            Request::Read { number } | Request::Write { number, .. } => {
                                Answer::Refused { number, reason: 1 }
                            }
                        };
                        answers.push(Message::Configured { from, tag, answer });
                    }
                    answers.iter().for_each(|it| send_message(cell.bus(), it, format).unwrap());
                }
            });
            let _over = Over(&over);
            work()
        })
    }

    fn open(&self) -> Bus {
        let (directory, send_timeout) = (Some(self.directory()), Duration::from_secs(60));
        let options = BusOptions { directory, send_timeout, ..BusOptions::default() };
        Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap()
    }
}

/// Ends the cell beside a test, even if the test fails.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn what_is_sent_on_an_embedded_bus_is_shown() {
    let bench = Bench::new();
    let dump = bench.dump("-n 4 --kind stimulus,command");
    bench.beside(Format::Fd, || bench.send("frame stimulus --cell 12 --force 3.0 --bus vcan0"));
    bench.send("frame sync --bus vcan0 --format classic");
    bench.send("frame resume --bus vcan0");
    let Output { status, stdout, stderr } = dump.wait_with_output().unwrap();
    let skin = "force 3.000 N (1.000 1.000 1.000), proximity 0.0000, temperature 0.00 0.00 °C";
    let expected = [
        &format!("ok      stimulus 12 from the next joints on: {skin}"),
        "segment sync",
        "ok      sync",
        "ok      resume",
    ];
    assert_eq!(decoded(text(&stdout)), expected);
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
    for line in text(&stdout).lines() {
        let raw = line.split_once('\t').unwrap().0;
        let Ok(CandumpLine::Frame(record)) = candump::parse(raw) else { panic!("{line}") };
        assert!(record.interface == "vcan0" && record.time.nanos > 0, "{line}");
    }
}

#[test]
fn a_cell_that_is_requested_answers_and_one_that_is_not_there_is_missed() {
    let bench = Bench::new();
    let says = |arguments: &str| {
        let Output { status, stdout, stderr } = bench.gateway(arguments).output().unwrap();
        let said = text(&stderr).strip_prefix("sent on vcan0 (embedded)\n").unwrap().to_owned();
        (status.code(), text(&stdout).to_owned(), said)
    };
    for format in [Format::Fd, Format::Classic] {
        let with = format!("--bus vcan0 --format {}", format.name());
        bench.beside(format, || {
            let read = says(&format!("frame configure --cell 12 --read mount --tag 7 {with}"));
            assert_eq!((read.0, read.2.as_str()), (Some(0), ""));
            assert!(
                read.1.starts_with("configured 12 tag 7: has mount: joint 2 of 6")
                    && read.1.lines().count() == 1,
                "{read:?}"
            );
            let all = says(&format!("frame configure --cell everyone --read mount {with}"));
            assert_eq!((all.0, all.1.lines().count()), (Some(0), 1), "{all:?}");
            let refused = says(&format!("frame configure --cell 12 --write mode 1 {with}"));
            assert!(
                refused.0 == Some(1) && refused.2.starts_with("skinbus: configured 12 tag 0: "),
                "{refused:?}"
            );
            let nobody = says(&format!("frame stimulus --cell 250 {with}"));
            assert_eq!((nobody.0, nobody.1.as_str()), (Some(1), ""));
            let expected = format!(
                "skinbus: cell 250 sent nothing on vcan0 for 1 s: check the cells with `skinbus cells \
                 vcan0`; if the bus uses the other frame format, add --format {}\n",
                format.other_format().name()
            );
            assert_eq!(nobody.2, expected);
        });
    }
}

#[test]
fn a_cell_that_cannot_compute_its_part_is_named_and_not_written() {
    let bench = Bench::new();
    let skin = bench.parent.path().join("skin.toml");
    let generated = output(gateway("skin generate --cells 1"));
    let plain = generated.replace("node = 1\n", "node = 12\n").replace("serial = 100001", "serial = 1");
    // A seventh joint: the last element of each list once more.
    let longer =
        plain.replacen("},\n]", "},\n  { a = 0.0, alpha = 0.0, d = 0.05, theta_offset = 0.0 },\n]", 1);
    let longer = ["0.5, 0.5, 0.5", "2.0, 2.0, 2.0", "3.0, 3.0, 3.0"]
        .iter()
        .fold(longer, |text, three| text.replace(&format!("{three}]"), &format!("{three}, 1.0]")));
    let wide = plain.replace("format = \"fd\"", "format = \"fd\"\ntorque_format = \"Q7.8\"");
    for (skin_text, expected) in [(wide, "torques in Q7.8"), (longer, "7 joints (it supports 6)")] {
        std::fs::write(&skin, &skin_text).unwrap();
        let mut command = bench.gateway(&format!("commission {}", skin.display()));
        let Output { status, stdout, stderr } = bench.beside(Format::Fd, || command.output().unwrap());
        let said = format!("12             does not support {expected}: install newer firmware");
        assert_eq!(status.code(), Some(1), "{}", text(&stderr));
        let all = format!("{}{}", text(&stdout), text(&stderr));
        assert!(all.contains(&said) && all.contains("requests         1 "), "{all}");
    }
}

#[test]
fn too_few_files_are_refused_before_anything_is_started() {
    let parent = TempDir::new().unwrap();
    let skin = parent.path().join("skin.toml");
    output(gateway(&format!("skin generate --cells 3 -o {}", skin.display())));
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -n 12; exec \"$0\" run \"$1\" --duration 1 --bus-kind embedded"]);
    command.arg(env!("CARGO_BIN_EXE_skinbus")).arg(&skin).env("SKINBUS_DIR", parent.path().join("skinbus"));
    let Output { status, stderr, .. } = command.output().unwrap();
    let said = "skinbus: this bench needs 33 open files, but the limit is 12: run `ulimit -n 33` first\n";
    assert_eq!((status.code(), text(&stderr)), (Some(2), said));
}

#[test]
fn a_foreign_classic_frame_is_shown_though_nothing_comes_after_it() {
    let bench = Bench::new();
    let mut dump = bench.dump("");
    bench.open().send(&[Frame::classic(0x20C, &[7; 8]).unwrap()]).unwrap();
    // The frame may be the first segment of a packet until the reassembly timeout.
    let mut line = String::new();
    BufReader::new(dump.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    assert!(
        line.ends_with("20C#0707070707070707\tforeign no packet: the other segments are missing\n"),
        "{line}"
    );
    kill_process(Pid::from_child(&dump), Signal::INT).unwrap();
    assert_eq!(dump.wait().unwrap().code(), Some(0));
}

#[test]
fn cells_on_a_foreign_bus_reports_that_frames_came_and_none_of_a_cell() {
    let bench = Bench::new();
    let bus = bench.open();
    let mut command = bench.gateway("cells vcan0 --duration 1");
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut sent = 0_u64;
    while child.try_wait().unwrap().is_none() {
        // A frame that is refused because the command has ended does not matter.
        let _ = bus.send(&[Frame::classic(0x20C, &sent.to_le_bytes()).unwrap()]);
        sent += 1;
        std::thread::sleep(Duration::from_millis(5));
    }
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    let said = text(&stderr);
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(
        said.contains(" other frames were received; `skinbus dump` shows them): start the cells"),
        "{said}"
    );
}

#[test]
fn a_signal_ends_a_dump_cleanly() {
    let bench = Bench::new();
    let interrupted = |child: Child| {
        kill_process(Pid::from_child(&child), Signal::INT).unwrap();
        let Output { status, stdout, stderr } = child.wait_with_output().unwrap();
        (status.code(), text(&stdout).to_owned(), text(&stderr).to_owned())
    };
    assert_eq!(interrupted(bench.dump("")), (Some(0), String::new(), String::new()));

    let mut child = gateway("dump -").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    input.write_all(b"(1.000000) vcan0 003##500000000000000000000000000004782\n").unwrap();
    // The frame is shown at once, although more may come.
    let mut line = String::new();
    let mut shown = BufReader::new(child.stdout.as_mut().unwrap());
    shown.read_line(&mut line).unwrap();
    assert!(line.ends_with("\tok      resume\n"), "{line}");
    assert_eq!(interrupted(child), (Some(0), String::new(), String::new()));
}

#[test]
fn what_shows_a_live_bus_ends_when_its_reader_has_enough() {
    let bench = Bench::new();
    for command in ["dump vcan0", "dump vcan0 --json", "dump vcan0 --brief", "cells vcan0 --watch"] {
        let mut child = bench.gateway(command).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut said = [0; 1];
        if command.starts_with("dump") {
            child.stderr.as_mut().unwrap().read_exact(&mut said).unwrap();
        }
        drop(child.stdout.take());
        let (bus, resume) = (bench.open(), Message::Resume);
        let began = Instant::now();
        let status = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break status;
            }
            assert!(began.elapsed() < Duration::from_secs(60), "{command} goes on");
            send_message(&bus, &resume, Format::Fd).unwrap();
            std::thread::sleep(Duration::from_millis(5));
        };
        assert_eq!(status.code(), Some(0), "{command}");
    }
}

#[test]
fn a_bus_that_comes_later_is_waited_for() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let dump = |arguments: &str| {
        let mut command = gateway(&format!("dump vcan0 {arguments} --bus-kind embedded"));
        command.env("SKINBUS_DIR", &directory).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    };
    assert_eq!(dump("").wait().unwrap().code(), Some(2));
    for missing in ["missing.log", "folder/run"] {
        let Output { status, stderr, .. } = gateway(&format!("dump {missing} --wait")).output().unwrap();
        let expected = format!("skinbus: --wait is only for buses, and the file {missing} does not exist\n");
        assert_eq!((status.code(), text(&stderr)), (Some(2), expected.as_str()));
    }
    let mut waits = dump("--wait -n 1");
    let gives_up = dump("--wait");
    until("the handler", || catches_interrupts(gives_up.id()));
    kill_process(Pid::from_child(&gives_up), Signal::INT).unwrap();
    assert_eq!(gives_up.wait_with_output().unwrap().status.code(), Some(0));
    assert!(waits.try_wait().unwrap().is_none());
    let bench = Bench { _served: ServerThread::start_in(&directory, "vcan0").unwrap(), parent };
    let mut line = [0; 18];
    waits.stderr.as_mut().unwrap().read_exact(&mut line).unwrap();
    bench.send("frame sync --bus vcan0");
    let Output { status, stdout, .. } = waits.wait_with_output().unwrap();
    assert!(status.success() && text(&stdout).contains("sync"), "{}", text(&stdout));
}

#[test]
fn the_bus_of_a_cell_is_where_a_frame_is_sent() {
    let bench = Bench::new();
    bench.beside(Format::Fd, || bench.send("frame stimulus --cell vcan0:12 --force 3"));
    let skin = bench.parent.path().join("skin.toml");
    output(gateway(&format!("skin generate --cells 6 --buses 2 -o {}", skin.display())));
    let skin = skin.display().to_string();
    let node = output(gateway(&format!("check {skin} --list --json")));
    let both: serde_json::Value = serde_json::from_str(&node).unwrap();
    assert!(both.to_string().contains("vcan1"), "{both}");
    for (arguments, expected) in [
        ("--cell vcan1:5 --bus vcan0", "--cell vcan1:5 is not on --bus vcan0: correct --cell or --bus"),
        (
            &format!("--cell 1 --skin {skin}"),
            "--cell 1: several buses have a cell with this node id; choose \
                                              one of vcan0:1, vcan1:1",
        ),
        (&format!("--cell 99 --skin {skin}"), "--cell 99: the skin has no such cell on vcan0, vcan1"),
        (&format!("--cell vcan7:1 --skin {skin}"), "the skin file "),
    ] {
        let Output { status, stderr, .. } =
            bench.gateway(&format!("frame stimulus {arguments}")).output().unwrap();
        let said = text(&stderr);
        assert!(status.code() == Some(2) && said.starts_with(&format!("skinbus: {expected}")), "{said}");
    }
}

#[test]
fn what_the_options_of_a_dump_leave_out_is_said() {
    let bench = Bench::new();
    for (arguments, expected) in [
        ("vcan0 --bus vcan1", "skinbus: bus vcan1 is not one of the buses to dump (vcan0): name it too\n"),
        ("vcan0 --cell vcan1:3", "skinbus: bus vcan1 is not one of the buses to dump (vcan0): name it too\n"),
        (
            "vcan0 --bus vcan0 --cell vcan1:3",
            "skinbus: vcan1:3 is not on a selected bus (vcan0): omit one of the two filters\n",
        ),
    ] {
        let Output { status, stderr, .. } = bench.gateway(&format!("dump {arguments}")).output().unwrap();
        assert_eq!((status.code(), text(&stderr)), (Some(2), expected));
    }
    let skin = bench.parent.path().join("two.toml").display().to_string();
    output(gateway(&format!("skin generate --cells 6 --buses 2 -o {skin}")));
    let Output { status, stderr, .. } = gateway(&format!("dump {skin}")).output().unwrap();
    let expected = format!(
        "skinbus: {skin} is a skin, which contains no frames; to follow its buses, run `skinbus dump vcan0 vcan1 --skin {skin}`\n"
    );
    assert_eq!((status.code(), text(&stderr)), (Some(2), expected.as_str()));
    let log = bench.parent.path().join("run.log");
    std::fs::write(&log, "(1.000000) vcan0 003##500000000000000000000000000004782\n").unwrap();
    let log = log.display().to_string();
    for (arguments, expected) in [
        ("--bus vcan3", "contains no frame of vcan3"),
        ("--cell vcan3:1", "contains no frame of vcan3"),
        ("--cell vcan0:99,98", "contains no frame from or to vcan0:99, 98"),
    ] {
        let Output { status, stdout, stderr } = gateway(&format!("dump {log} {arguments}")).output().unwrap();
        let expected = format!("{log} {expected}\n");
        assert_eq!((status.code(), text(&stdout), text(&stderr)), (Some(0), "", expected.as_str()));
    }
}

#[test]
fn a_live_bus_is_counted_until_the_end_that_was_requested_or_a_signal() {
    let bench = Bench::new();
    let counted = |child: Child| {
        let Output { status, stdout, stderr } = child.wait_with_output().unwrap();
        assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
        let report: serde_json::Value = serde_json::from_slice(&stdout).unwrap();
        (report["format"].clone(), report["frames"].clone())
    };
    let child = bench.dump("--stats --json -n 2");
    (0..2).for_each(|_| bench.send("frame sync --bus vcan0"));
    assert_eq!(counted(child), ("live".into(), 2.into()));

    let child = bench.dump("--stats --json");
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    assert_eq!(counted(child), ("live".into(), 0.into()));
}

#[test]
fn a_bus_that_ends_ends_its_dump_with_an_error() {
    let bench = Bench::new();
    let dump = bench.dump("");
    drop(bench);
    let Output { status, stderr, .. } = dump.wait_with_output().unwrap();
    let said = "skinbus: the embedded bus vcan0 was closed: its server ended\n";
    assert_eq!((status.code(), text(&stderr)), (Some(1), said));
}

#[test]
fn a_dump_reports_lost_frames_though_its_bus_has_ended() {
    const FLOOD: u32 = 10_000;
    let bench = Bench::new();
    let mut dump = bench.dump("");
    let bus = bench.open();
    // The output is not read: the pipe fills, then the socket, then the queue, and the rest is dropped.
    let flood = [Frame::classic(0x123, &[0; 8]).unwrap(); 50];
    (0..FLOOD / 50).for_each(|_| bus.send(&flood).unwrap());
    let mut shown = BufReader::new(dump.stdout.take().unwrap()).lines().map(Result::unwrap);
    // A frame shown after all of them brings the number of missing ones; it may be dropped too.
    let (after, enough) = (Frame::classic(0x7FF, &[]).unwrap(), AtomicBool::new(false));
    let (heard, sent) = std::thread::scope(|scope| {
        let sender = scope.spawn(|| {
            let mut sent = 0;
            while !enough.load(Ordering::Relaxed) {
                bus.send(&[after]).unwrap();
                sent += 1;
                std::thread::sleep(Duration::from_millis(10));
            }
            sent
        });
        let heard = shown.by_ref().take_while(|line| !line.contains(" 7FF#")).count();
        enough.store(true, Ordering::Relaxed);
        (u32::try_from(heard).unwrap(), sender.join().unwrap())
    });
    drop(bench);
    let Output { status, stderr, .. } = dump.wait_with_output().unwrap();
    let said = text(&stderr);
    let missing = said.strip_prefix("vcan0: ").and_then(|said| {
        said.strip_suffix(
            " frames are missing, because they arrived faster than they were shown\nskinbus: the embedded \
             bus vcan0 was closed: its server ended\n",
        )
    });
    let missing: u32 = missing.unwrap_or_else(|| panic!("{said}")).parse().unwrap();
    assert!(heard < FLOOD && (FLOOD - heard..=FLOOD - heard + sent).contains(&missing), "{heard}, {missing}");
    assert_eq!(status.code(), Some(1));
}

#[test]
fn a_skin_tells_ack_its_buses_and_formats() {
    let bench = Bench::new();
    let skin = bench.parent.path().join("skin.toml");
    output(gateway(&format!("skin generate --cells 3 --format classic -o {}", skin.display())));
    let bus = bench.open();
    bench.send(&format!("frame resume --skin {}", skin.display()));
    let mut inbox = Inbox::new();
    let mut frames = Vec::new();
    while frames.len() < 2 {
        assert!(bus.wait(Some(Duration::from_secs(60))).unwrap(), "{frames:?}");
        bus.receive(&mut inbox).unwrap();
        frames.extend(inbox.frames().map(|received| received.frame));
    }
    assert_eq!(Message::decode(&packet(&frames, Format::Classic)), Ok(Message::Resume));
}

#[test]
fn a_live_dump_of_a_silent_bus_ends_at_its_time() {
    let bench = Bench::new();
    for arguments in ["--to 200ms", "--to 200ms --stats"] {
        let begun = Instant::now();
        let Output { status, stderr, .. } =
            bench.gateway(&format!("dump vcan0 {arguments}")).output().unwrap();
        let took = begun.elapsed();
        assert_eq!(status.code(), Some(0), "{arguments}: {}", text(&stderr));
        assert!(took >= Duration::from_millis(200), "{arguments}: {took:?}");
    }
}
