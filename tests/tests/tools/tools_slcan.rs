//! `vcan-setup slcan` beside python-can's slcan: frames in both directions over a pseudoterminal, complete and equal.
//!
//! `tests/tools/install` installs the tools; `tests/run --all` does that, and then runs this test.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::slcan;

use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use process::{TIMEOUT, TestDir};
use protocol::bus::{Bus, BusOptions, Inbox};
use protocol::can::{BIT_RATE_SWITCH, EXTENDED, Format, Frame};
use rustix::process::Signal;
use serde_json::Value;
use slcan::{Pty, carry};

/// The number of frames in each direction.
const FRAMES: usize = 10_000;
/// The maximum number of frames on their way, which any queue holds.
const BURST: usize = 100;

/// Ends with the test.
struct Python(Child);

impl Drop for Python {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns frames of all kinds of a format, of all lengths, with all kinds of identifiers.
fn frames(format: Format, salt: u32) -> Vec<Frame> {
    let lens = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];
    let mut state = 0x9E37_79B9 ^ salt;
    let mut random = move || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state
    };
    let mut frame = || {
        let id = if random() % 3 == 0 { random() & 0x1FFF_FFFF | EXTENDED } else { random() & 0x7FF };
        let data: Vec<u8> = (0..64).map(|_| random().to_le_bytes()[1]).collect();
        match random() % 4 {
            0 | 1 if format == Format::Fd => {
                let flags = if random() % 2 == 0 { BIT_RATE_SWITCH } else { 0 };
                Frame::fd(id, flags, &data[..lens[random() as usize % lens.len()]])
            }
            0 => Frame::remote(id, (random() % 9).try_into().unwrap()),
            _ => Frame::classic(id, &data[..random() as usize % 9]),
        }
    };
    (0..FRAMES).map(|_| frame().unwrap()).collect()
}

/// Formats a frame as `tools/slcan.py` reads and writes it.
fn line(frame: &Frame) -> String {
    let is_fd = frame.format() == Format::Fd;
    let switches = is_fd && frame.flags() & BIT_RATE_SWITCH != 0;
    let kinds = [('x', frame.is_extended()), ('r', frame.is_remote()), ('f', is_fd), ('b', switches)];
    let kind: String = kinds.into_iter().filter(|kind| kind.1).map(|kind| kind.0).collect();
    let data = frame.data().iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").unwrap();
        text
    });
    let or_none = |text: String| if text.is_empty() { "-".to_owned() } else { text };
    format!("{:X} {} {} {}", frame.id(), or_none(kind), frame.len(), or_none(data))
}

fn check(format: Format, options: &str) {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = here.join("../target/tools/bin/python");
    assert!(python.exists(), "{} is missing: tests/tools/install makes it ready", python.display());
    let place = TestDir::new();
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0");
    let [ours, theirs] = [Pty::new(), Pty::new()];
    carry(&ours.peer, &theirs.peer);
    carry(&theirs.peer, &ours.peer);
    let words = format!("slcan vcan0 --bus-kind embedded --json {options} {}", ours.path.display());
    let bridge = place.start("vcan-setup", &words);
    bridge.wait_for_stderr("1 line on vcan0");
    let bus = Bus::open(
        "vcan0",
        "embedded".parse().unwrap(),
        &BusOptions { directory: Some(place.buses()), receive_buffer: 64 << 20, ..BusOptions::default() },
    );
    let bus = bus.unwrap();

    let [to_them, to_us] = [1, 2].map(|salt| frames(format, salt));
    let file = to_us.iter().map(|frame| line(frame) + "\n").collect::<String>();
    let mut command = Command::new(python);
    command.arg(here.join("tools/slcan.py")).arg(&theirs.path).arg(format.name());
    command
        .arg(place.write("frames", &file))
        .arg(FRAMES.to_string())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped());
    let mut child = Python(command.spawn().unwrap());
    let mut credit = child.0.stdin.take().unwrap();
    let mut printed = BufReader::new(child.0.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert_eq!(printed.next().as_deref(), Some("ready"));

    // The same number in both directions at once; an unlimited sender would fill the queue of a slow bus.
    let (mut inbox, mut received) = (Inbox::new(), Vec::new());
    for burst in to_them.chunks(BURST) {
        writeln!(credit, "{}", burst.len()).unwrap();
        bus.send(burst).unwrap();
        for frame in burst {
            let got = printed.next();
            if got != Some(line(frame)) {
                bridge.signal(Signal::TERM);
                panic!("{got:?} came, and not {:?}: {:#?}", line(frame), bridge.end());
            }
        }
        let (expected, give_up) = (received.len() + burst.len(), Instant::now() + TIMEOUT);
        while received.len() < expected {
            if Instant::now() > give_up {
                bridge.signal(Signal::TERM);
                panic!("{} of {expected} frames came from python-can: {:#?}", received.len(), bridge.end());
            }
            if bus.receive(&mut inbox).unwrap() > 0 {
                received.extend(inbox.frames().map(|received| received.frame));
            } else {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    }
    drop(credit);
    assert!(received == to_us, "all of them, in order");
    assert!(child.0.wait().unwrap().success());

    bridge.signal(Signal::TERM);
    let account: Value = serde_json::from_str(&bridge.end().succeeded().stdout).unwrap();
    for way in ["to_line", "to_bus"] {
        assert_eq!(account["lines"][0][way]["received"], FRAMES, "{account}");
        assert_eq!(account["lines"][0][way]["sent"], FRAMES, "{account}");
    }
}

#[test]
#[ignore = "needs tests/tools/install"]
fn python_can_and_we_read_each_others_fd_frames() {
    check(Format::Fd, "--bit-rates 1M/5M");
}

#[test]
#[ignore = "needs tests/tools/install"]
fn python_can_and_we_read_each_others_classic_frames() {
    check(Format::Classic, "--bit-rates 500k --classic");
}
