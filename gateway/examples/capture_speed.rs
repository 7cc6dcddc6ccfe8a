//! How fast captures are read.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a measurement may stop")]
use std::fmt::Write as _;
use std::hint::black_box;
use std::time::Instant;

use gateway::capture::{Entry, Reader};

fn log(lines: u64) -> String {
    let mut log = String::new();
    for line in 0..lines {
        let micros = 1_700_000_000_000_000 + line * 63;
        let (sec, micro) = (micros / 1_000_000, micros % 1_000_000);
        let word = line.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        if line % 2 == 0 {
            writeln!(log, "({sec}.{micro:06}) vcan0 {:03X}#{word:016X}", 0x200 + line % 253).unwrap();
        } else {
            writeln!(
                log,
                "({sec}.{micro:06}) vcan0 {:03X}##5{word:016X}{:016X}",
                0x200 + line % 253,
                word ^ line
            )
            .unwrap();
        }
    }
    log
}

fn main() {
    let lines: u64 = std::env::args().nth(1).map_or(500_000, |n| n.parse().unwrap());
    let which = std::env::args().nth(2).unwrap_or_default();
    let text = log(lines);
    let text: &'static [u8] = text.leak().as_bytes();
    let theirs = || {
        let mut reader = socketcan::dump::Reader::from_reader(text);
        let mut n = 0_u64;
        while let Some(record) = reader.next_record().unwrap() {
            black_box(&record);
            n += 1;
        }
        assert_eq!(n, lines);
    };
    let ours = || {
        let mut reader = Reader::from_read("memory", text).unwrap();
        let mut n = 0_u64;
        while let Some(entry) = reader.next().unwrap() {
            black_box(&entry);
            n += u64::from(matches!(entry, Entry::Frame(_)));
        }
        assert_eq!(n, lines);
    };
    let write = || {
        let mut reader = Reader::from_read("memory", text).unwrap();
        let mut line = String::new();
        let mut bytes = 0;
        while let Some(entry) = reader.next().unwrap() {
            if let Entry::Frame(record) = entry {
                line.clear();
                protocol::candump::write_record(&mut line, &record).unwrap();
                bytes += line.len() + 1;
            }
        }
        assert_eq!(bytes, text.len());
    };
    match which.as_str() {
        "theirs" => {
            theirs();
            return;
        }
        "ours" => {
            ours();
            return;
        }
        "write" => {
            write();
            return;
        }
        "none" => return,
        _ => {}
    }
    for _ in 0..7 {
        let rate = |work: &dyn Fn()| {
            let begun = Instant::now();
            work();
            lines as f64 / begun.elapsed().as_secs_f64() / 1e6
        };
        let (a, b, c) = (rate(&theirs), rate(&ours), rate(&write));
        println!("socketcan {a:.2} M/s  ours {b:.2} M/s  ratio {:.2}   read+write {c:.2} M/s", b / a);
    }
}
