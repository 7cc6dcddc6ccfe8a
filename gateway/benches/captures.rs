//! Speed of reading candump text, beside the reader of the crate socketcan: `cargo bench -p gateway --bench captures`
//!
//! Half of the lines are classic frames of 8 bytes, half FD frames of 16; the text is in memory. The example
//! `capture_speed` measures the conversion of files and its memory.

use std::fmt::Write;
use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, Throughput};
use protocol::candump::write_record;
use trace::capture::{CaptureEntry, Reader};

const LOG_LINES: u64 = 20_000;

/// A log as `candump -L` writes it.
fn candump_log() -> &'static [u8] {
    let mut log = String::new();
    for line in 0..LOG_LINES {
        let micros = 1_700_000_000_000_000 + line * 63;
        let (sec, micro, id) = (micros / 1_000_000, micros % 1_000_000, 0x200 + line % 253);
        let word = line.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        write!(log, "({sec}.{micro:06}) vcan0 {id:03X}").expect("a String takes everything");
        if line.is_multiple_of(2) {
            writeln!(log, "#{word:016X}").expect("a String takes everything");
        } else {
            writeln!(log, "##5{word:016X}{:016X}", word ^ line).expect("a String takes everything");
        }
    }
    log.leak().as_bytes()
}

fn read_with_socketcan(log: &'static [u8]) -> u64 {
    let mut reader = socketcan::dump::Reader::from_reader(log);
    let mut frames = 0;
    while let Some(record) = reader.next_record().expect("a sound log") {
        black_box(&record);
        frames += 1;
    }
    frames
}

fn read_with_skinbus(log: &'static [u8]) -> u64 {
    let mut reader = Reader::from_read("memory", log).expect("a sound log");
    let mut frames = 0;
    while let Some(entry) = reader.next().expect("a sound log") {
        frames += u64::from(matches!(black_box(&entry), CaptureEntry::Frame(_)));
    }
    frames
}

fn read_and_write(log: &'static [u8]) -> usize {
    let mut reader = Reader::from_read("memory", log).expect("a sound log");
    let (mut line, mut bytes) = (String::new(), 0);
    while let Some(entry) = reader.next().expect("a sound log") {
        if let CaptureEntry::Frame(record) = entry {
            line.clear();
            write_record(&mut line, &record).expect("a String takes everything");
            bytes += black_box(&line).len();
        }
    }
    bytes
}

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(30)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_millis(1_500))
        .configure_from_args();
    let log = candump_log();
    assert_eq!([read_with_skinbus(log), read_with_socketcan(log)], [LOG_LINES; 2]);
    assert_eq!(
        read_and_write(log),
        log.iter().filter(|&&byte| byte != b'\n').count(),
        "what is written is what was read"
    );
    let mut group = criterion.benchmark_group("candump");
    group.throughput(Throughput::Elements(LOG_LINES));
    group.bench_function("this reader", |bencher| bencher.iter(|| read_with_skinbus(black_box(log))));
    group.bench_function("socketcan", |bencher| bencher.iter(|| read_with_socketcan(black_box(log))));
    group.bench_function("read and written", |bencher| bencher.iter(|| read_and_write(black_box(log))));
    group.finish();
    criterion.final_summary();
}
