//! Speed and memory use of the model of a real bus on a capture.
//!
//! ```text
//!   cargo build --release -p gateway && cargo run --release -p gateway --example shadow_speed [MINUTES [FOLDER]]
//! ```
//!
//! The capture (default: 60 minutes, 4 GB in FOLDER, removed afterwards) is that of a skin: joints at 62.5 Hz, answered
//! by each of 253 cells, 16 thousand frames per second in all, with every fourth cell's heartbeat. Replies are spread
//! over 6 ms, as processes spread them.
#![expect(clippy::unwrap_used, reason = "a measurement may stop")]
#![expect(clippy::print_stdout, reason = "the figures are its output")]
#![expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use protocol::can::Format;
use protocol::candump::{Record, Timestamp, write_record};
use protocol::id::{self, CellId, Id};
use protocol::packet::{Epoch, Packet, WORDS};

mod watched;

/// Time between joints in µs.
const JOINTS_INTERVAL_US: u64 = 16_000;
const CELLS: i64 = 253;

/// Writes the frames of one epoch as candump does.
fn write_epoch(log: &mut impl std::io::Write, line: &mut String, number: u64) -> u64 {
    let mut frames = 0;
    let mut write_packet = |micros: u64, id: Id, word: i16| {
        let epoch = Epoch(number.to_le_bytes()[0]);
        // Page 0 of the network is a heartbeat.
        let count = u8::from(id.kind != id::Kind::Network);
        let packet = Packet { id, words: [word; WORDS].into(), epoch, count };
        for frame in packet.frames(Format::Fd) {
            let nanos = (1_700_000_000_000_000 + number * JOINTS_INTERVAL_US + micros) * 1_000;
            let time = Timestamp::with_six_digits(nanos);
            line.clear();
            write_record(line, &Record { time, interface: "vcan0", frame, direction: None }).unwrap();
            line.push('\n');
            log.write_all(line.as_bytes()).unwrap();
            frames += 1;
        }
    };
    write_packet(0, Id::command(id::Command::Joints), 0);
    for (cell, place) in (1..=CELLS).zip(0_u64..) {
        let node = id::Node::Cell(CellId::new(cell).unwrap());
        let word = (number * 31 + place * 977).to_le_bytes();
        write_packet(
            100 + place * 23,
            Id::new(id::Kind::Torque, node),
            i16::from_le_bytes([word[0], word[1]]),
        );
    }
    // Two heartbeats per epoch make 16 thousand frames per second.
    for beat in 0..2 {
        let cell = i64::try_from((number * 2 + beat) % 253).unwrap() + 1;
        let node = id::Node::Cell(CellId::new(cell).unwrap());
        write_packet(9_000 + beat * 500, Id::new(id::Kind::Network, node), 0);
    }
    frames
}

fn main() {
    let mut arguments = protocol::usage::command_line().into_iter().skip(1);
    let minutes: u64 = arguments.next().map_or(60, |minutes| minutes.parse().expect("MINUTES is a number"));
    let folder = arguments.next().map_or_else(std::env::temp_dir, PathBuf::from);
    let gateway = watched::gateway_program();
    let place = tempfile::tempdir_in(folder).unwrap();
    let log = place.path().join("run.log");
    let mut out = BufWriter::with_capacity(1 << 20, File::create(&log).unwrap());
    let mut line = String::new();
    let epochs = minutes * 60_000_000 / JOINTS_INTERVAL_US;
    let frames: u64 = (0..epochs).map(|number| write_epoch(&mut out, &mut line, number)).sum();
    out.flush().unwrap();
    drop(out);
    let lasts = (epochs * JOINTS_INTERVAL_US) as f64 / 1e6;
    println!(
        "capture                  {frames} frames in {lasts:.0} s, {:.0} a second",
        frames as f64 / lasts
    );
    for (name, arguments) in [
        ("tables, 1M/8M", &["--data", "8M"][..]),
        ("tables, 1M/5M", &[]),
        ("--json, 1M/8M", &["--data", "8M", "--json"]),
    ] {
        let mut command = Command::new(&gateway);
        command.arg("fit").arg(&log).args(arguments).stdout(Stdio::null());
        let (seconds, memory) = watched::run_measured(&mut command);
        let (rate, times) = (frames as f64 / seconds / 1e6, lasts / seconds);
        println!("{name:25}{rate:.2} million frames/s, {times:.0} times real time, {memory:.0} MB");
    }
}
