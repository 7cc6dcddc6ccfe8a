//! The same commands on an embedded bus.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use protocol::bus::{Bus, BusKind, Choice, Inbox, Options};
use protocol::can::{Format, Frame};
use protocol::candump;
use protocol::candump::Line;
use protocol::message::Message;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;
use vcan_setup::embedded::Served;

use super::*;

/// A bus of its own for a test.
struct Bench {
    parent: TempDir,
    _served: Served,
}

impl Bench {
    fn new() -> Self {
        let parent = TempDir::new().unwrap();
        let served = Served::start_in(&parent.path().join("skinbus"), "vcan0").unwrap();
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

    /// A dump that listens already.
    fn dump(&self, arguments: &str) -> Child {
        let mut command = self.gateway(&format!("dump vcan0 {arguments}"));
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut line = [0; 18];
        child.stderr.as_mut().unwrap().read_exact(&mut line).unwrap();
        assert_eq!(text(&line), "vcan0 is embedded\n");
        child
    }

    fn send(&self, arguments: &str) {
        let Output { status, stdout, stderr } = self.gateway(arguments).output().unwrap();
        let said = (status.code(), text(&stdout), text(&stderr));
        assert_eq!(said, (Some(0), "", "sent on vcan0 (embedded)\n"), "{arguments}");
    }

    fn open(&self) -> Bus {
        let (directory, send_timeout) = (Some(self.directory()), Duration::from_secs(10));
        let options = Options { directory, send_timeout, ..Options::default() };
        Bus::open("vcan0", Choice::Only(BusKind::Embedded), &options).unwrap()
    }
}

#[test]
fn what_is_sent_on_an_embedded_bus_is_shown() {
    let bench = Bench::new();
    let dump = bench.dump("--max 4");
    bench.send("frame stimulus --node 12 --force 3.0 --bus vcan0");
    bench.send("frame sync --bus vcan0 --format classic");
    bench.send("ack vcan0");
    let Output { status, stdout, stderr } = dump.wait_with_output().unwrap();
    let skin = "force 3.000 N (1.000 1.000 1.000), proximity 0.0000, temperature 0.00 0.00 °C";
    let expected = [
        &format!("ok      stimulus 12 from the next joints on: {skin}"),
        "half    sync",
        "ok      sync",
        "ok      resume",
    ];
    assert_eq!(decoded(text(&stdout)), expected);
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
    for line in text(&stdout).lines() {
        let raw = line.split_once('\t').unwrap().0;
        let Ok(Line::Frame(record)) = candump::parse(raw) else { panic!("{line}") };
        assert!(record.interface == "vcan0" && record.time.nanos > 0, "{line}");
    }
}

#[test]
fn a_foreign_classic_frame_is_shown_though_nothing_comes_after_it() {
    let bench = Bench::new();
    let mut dump = bench.dump("");
    bench.open().send(&[Frame::classic(0x20C, &[7; 8]).unwrap()]).unwrap();
    // It might be half of a packet, and nobody says so but the time.
    let mut line = String::new();
    BufReader::new(dump.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    assert!(line.ends_with("20C#0707070707070707\tforeign no packet: no other segment\n"), "{line}");
    kill_process(Pid::from_child(&dump), Signal::INT).unwrap();
    assert_eq!(dump.wait().unwrap().code(), Some(0));
}

#[test]
fn cells_on_a_bus_of_other_people_says_that_frames_came_and_none_was_of_a_cell() {
    let bench = Bench::new();
    let bus = bench.open();
    let mut command = bench.gateway("cells vcan0 --for 1");
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut sent = 0_u64;
    while child.try_wait().unwrap().is_none() {
        // A frame that is not taken, because nobody listens any more, is no matter.
        let _ = bus.send(&[Frame::classic(0x20C, &sent.to_le_bytes()).unwrap()]);
        sent += 1;
        std::thread::sleep(Duration::from_millis(5));
    }
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    let said = text(&stderr);
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains(" frames are none of a cell; `gateway dump` shows them): start them"), "{said}");
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
    // It is shown at once, though more may come.
    let mut line = String::new();
    let mut shown = BufReader::new(child.stdout.as_mut().unwrap());
    shown.read_line(&mut line).unwrap();
    assert!(line.ends_with("\tok      resume\n"), "{line}");
    assert_eq!(interrupted(child), (Some(0), String::new(), String::new()));
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
    let child = bench.dump("--stats --json --max 2");
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
    let said = "gateway: the embedded bus vcan0 was closed: its server ended\n";
    assert_eq!((status.code(), text(&stderr)), (Some(1), said));
}

#[test]
fn a_dump_says_what_it_missed_though_its_bus_has_ended() {
    const FLOOD: u32 = 10_000;
    let bench = Bench::new();
    let mut dump = bench.dump("");
    let bus = bench.open();
    // Nobody reads what it shows: the pipe is full, then its socket, then its queue, and the rest is dropped.
    let flood = [Frame::classic(0x123, &[0; 8]).unwrap(); 50];
    (0..FLOOD / 50).for_each(|_| bus.send(&flood).unwrap());
    let mut shown = BufReader::new(dump.stdout.take().unwrap()).lines().map(Result::unwrap);
    // A frame that is shown after all of them brings how many are missing; it may be dropped as well.
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
            " frames are missing: they came faster than they were shown\n\
             gateway: the embedded bus vcan0 was closed: its server ended\n",
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
    bench.send(&format!("ack {}", skin.display()));
    let mut inbox = Inbox::new();
    let mut frames = Vec::new();
    while frames.len() < 2 {
        assert!(bus.wait(Some(Duration::from_secs(5))).unwrap(), "{frames:?}");
        bus.receive(&mut inbox).unwrap();
        frames.extend(inbox.frames().map(|received| received.frame));
    }
    assert_eq!(Message::decode(&packet(&frames, Format::Classic)), Ok(Message::Resume));
}
