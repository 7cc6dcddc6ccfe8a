//! How fast captures are read and converted, and what memory that takes; beside the crate socketcan in the same run.
//!
//! ```text
//!   cargo build --release -p gateway && cargo run --release -p gateway --example capture_speed [LINES [FOLDER]]
//! ```
//!
//! Half of the lines are classic frames of 8 bytes, half FD frames of 16. What is read stands in memory; files of LINES
//! lines (10 million unless told) lie in FOLDER for the conversions, and are gone afterwards. Each figure is the
//! median of several turns taken one after the other, so that a busy machine is as unfair to one as to the other.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::indexing_slicing,
    clippy::cast_precision_loss,
    reason = "a measurement may stop"
)]

use std::fmt::Write as _;
use std::fs::File;
use std::hint::black_box;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use gateway::capture::{Entry, Reader};
use protocol::candump::write_record;

/// Lines that are read from memory.
const IN_MEMORY: u64 = 500_000;

/// A line as `candump -L` writes it.
fn write_line(log: &mut String, line: u64) {
    let micros = 1_700_000_000_000_000 + line * 63;
    let (sec, micro, id) = (micros / 1_000_000, micros % 1_000_000, 0x200 + line % 253);
    let word = line.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    if line.is_multiple_of(2) {
        writeln!(log, "({sec}.{micro:06}) vcan0 {id:03X}#{word:016X}").unwrap();
    } else {
        let other = word ^ line;
        writeln!(log, "({sec}.{micro:06}) vcan0 {id:03X}##5{word:016X}{other:016X}").unwrap();
    }
}

fn with_socketcan(log: &'static [u8]) {
    let mut reader = socketcan::dump::Reader::from_reader(log);
    while let Some(record) = reader.next_record().unwrap() {
        black_box(&record);
    }
}

fn with_ours(log: &'static [u8]) {
    let mut reader = Reader::from_read("memory", log).unwrap();
    while let Some(entry) = reader.next().unwrap() {
        black_box(&entry);
    }
}

fn and_written(log: &'static [u8]) {
    let mut reader = Reader::from_read("memory", log).unwrap();
    let mut line = String::new();
    while let Some(Entry::Frame(record)) = reader.next().unwrap() {
        line.clear();
        write_record(&mut line, &record).unwrap();
        black_box(&line);
    }
}

fn median(mut figures: Vec<f64>) -> f64 {
    figures.sort_by(f64::total_cmp);
    figures[figures.len() / 2]
}

/// Million lines a second, and the greatest memory of the process in MB.
fn convert(gateway: &Path, from: &Path, to: &Path, lines: u64) -> (f64, f64) {
    let begun = Instant::now();
    let mut command = Command::new(gateway);
    command.arg("convert").arg(from).arg(to).arg("--force").stderr(Stdio::null());
    let mut child = command.spawn().expect("the release build's gateway: cargo build --release -p gateway");
    let status = Path::new("/proc").join(child.id().to_string()).join("status");
    let mut kib = 0.0_f64;
    let done = loop {
        let text = std::fs::read_to_string(&status).unwrap_or_default();
        let peak = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let peak = peak.and_then(|peak| peak.trim().trim_end_matches(" kB").parse().ok());
        kib = kib.max(peak.unwrap_or(0.0));
        if let Some(done) = child.try_wait().unwrap() {
            break done;
        }
        std::thread::sleep(Duration::from_millis(10));
    };
    assert!(done.success(), "{command:?}");
    (lines as f64 / begun.elapsed().as_secs_f64() / 1e6, kib / 1024.0)
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let lines: u64 = arguments.next().map_or(10_000_000, |lines| lines.parse().expect("LINES is a number"));
    let folder = arguments.next().map_or_else(std::env::temp_dir, PathBuf::from);

    let mut log = String::new();
    (0..IN_MEMORY).for_each(|line| write_line(&mut log, line));
    let log: &'static [u8] = log.leak().as_bytes();
    let works: [fn(&'static [u8]); 3] = [with_socketcan, with_ours, and_written];
    let mut rates = works.map(|_| Vec::new());
    let mut ratios = Vec::new();
    for _ in 0..15 {
        for (work, rates) in works.iter().zip(&mut rates) {
            let begun = Instant::now();
            work(log);
            rates.push(IN_MEMORY as f64 / begun.elapsed().as_secs_f64() / 1e6);
        }
        ratios.push(rates[1].last().unwrap() / rates[0].last().unwrap());
    }
    let [theirs, ours, written] = rates.map(median);
    println!(
        "read, million lines/s          socketcan {theirs:.2}, this {ours:.2}, ratio {:.2}",
        median(ratios)
    );
    println!("read and written, million/s    {written:.2}");
    if lines == 0 {
        return;
    }

    let program = std::env::current_exe().unwrap();
    let gateway = program.parent().and_then(Path::parent).unwrap().join("gateway");
    let place = tempfile::tempdir_in(folder).unwrap();
    let [log, mcap, back] = ["run.log", "run.mcap", "back.log"].map(|name| place.path().join(name));
    let mut out = BufWriter::new(File::create(&log).unwrap());
    let mut line = String::new();
    for number in 0..lines {
        line.clear();
        write_line(&mut line, number);
        out.write_all(line.as_bytes()).unwrap();
    }
    out.flush().unwrap();
    drop(out);
    for _ in 0..3 {
        let (into, memory) = convert(&gateway, &log, &mcap, lines);
        println!("log to MCAP, million lines/s   {into:.2}, {memory:.0} MB");
        let (out, memory) = convert(&gateway, &mcap, &back, lines);
        println!("MCAP to log, million lines/s   {out:.2}, {memory:.0} MB");
    }
    let size = |path: &Path| std::fs::metadata(path).unwrap().len() as f64 / lines as f64;
    println!(
        "bytes a frame                  {:.1} in the log, {:.1} in the recording",
        size(&log),
        size(&mcap)
    );
    let same = std::fs::read(&log).unwrap() == std::fs::read(&back).unwrap();
    println!("there and back                 {}", if same { "the same bytes" } else { "NOT the same bytes" });
}
