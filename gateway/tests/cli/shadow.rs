//! `skinbus fit` as a process: whole, truncated, empty and foreign recordings, and refusals.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, reason = "a test may stop")]

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use protocol::candump::{self, CandumpLine};
use protocol::wire_time::FrameBits;
use serde_json::Value;

const CORPUS: &[u8] = include_bytes!("../../../protocol/tests/golden/candump_corpus.log");

fn gateway(folder: &Path, arguments: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ')).current_dir(folder).env("SKINBUS_DIR", "/nowhere/skinbus");
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A log of 3000 frames on two buses, a third of a second long.
fn log() -> String {
    (0..3_000_u64).fold(String::new(), |mut log, line| {
        let micros = 1_700_000_000_000_000 + line * 111;
        let (sec, micro, id) = (micros / 1_000_000, micros % 1_000_000, 0x200 + line % 253);
        let bus = if line.is_multiple_of(3) { "can1" } else { "can0" };
        let word = line.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        writeln!(log, "({sec}.{micro:06}) {bus} {id:03X}##5{word:016X}{word:016X}").unwrap();
        log
    })
}

fn objects(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn each_frame_is_an_object_with_the_bits_and_times_of_a_bus() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("run.log"), log()).unwrap();
    let (code, text, said) = gateway(folder.path(), "fit run.log --json --rates can1=500k/2M");
    assert_eq!((code, said.as_str()), (Some(0), ""));
    let objects = objects(&text);
    assert_eq!(objects.len(), 3_000);
    for (object, line) in objects.iter().zip(log().lines()) {
        let CandumpLine::Frame(record) = candump::parse(line).unwrap() else { panic!("{line}") };
        let keys: Vec<_> = object.as_object().unwrap().keys().map(String::as_str).collect();
        assert_eq!(keys.len(), 7, "{keys:?}");
        let bits = FrameBits::from_frame(&record.frame).unwrap();
        assert_eq!(object["nominal_bits"], bits.nominal);
        assert_eq!(object["data_bits"], bits.data);
        assert_eq!(
            (object["bus"].as_str(), object["id"].as_str()),
            (Some(record.interface), Some(&*format!("{:03X}", record.frame.id())))
        );
        let [time, start, end] = ["time", "start_s", "end_s"].map(|key| object[key].as_f64().unwrap());
        let rates = if record.interface == "can1" { "500k/2M" } else { "1M/5M" };
        // For times since 1970, doubles resolve a quarter of a microsecond.
        assert!((end - start - bits.seconds(rates.parse().unwrap())).abs() < 1e-6, "{object}");
        assert!(start >= time && (time - record.time.nanos as f64 / 1e9).abs() < 1e-6);
    }
}

#[test]
fn every_line_that_a_capture_can_have_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("corpus.log"), CORPUS).unwrap();
    let (code, text, _) = gateway(folder.path(), "fit corpus.log --json");
    let frames = CORPUS.split(|&byte| byte == b'\n').filter(|line| {
        std::str::from_utf8(line).is_ok_and(|line| matches!(candump::parse(line), Ok(CandumpLine::Frame(_))))
    });
    assert_eq!((code, objects(&text).len()), (Some(0), frames.count()));
}

#[test]
fn a_recording_that_was_truncated_is_looked_at_as_far_as_it_goes() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("run.log"), log()).unwrap();
    assert_eq!(gateway(folder.path(), "convert run.log run.mcap").0, Some(0));
    let whole = fs::read(folder.path().join("run.mcap")).unwrap();
    fs::write(folder.path().join("cut.mcap"), &whole[..whole.len() - 3_000]).unwrap();
    let (code, text, said) = gateway(folder.path(), "fit cut.mcap");
    assert_eq!((code, said.matches('\n').count()), (Some(0), 1), "{said}");
    assert!(
        said.starts_with("cut.mcap: its end is missing: ") && text.contains("can0 at 1M/5M"),
        "{said}{text}"
    );
    // In the middle of a line.
    let log = log();
    fs::write(folder.path().join("cut.log"), &log[..log.len() - 40]).unwrap();
    let (code, text, said) = gateway(folder.path(), "fit cut.log");
    assert_eq!(code, Some(0));
    assert!(
        said.ends_with("cut.log: 1 of 3000 lines could not be read\n") && text.contains("2999 frames"),
        "{said}{text}"
    );
}

#[test]
fn what_has_no_frame_and_what_is_no_capture_is_said_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in
        [("empty.log", &b""[..]), ("notes.txt", b"hello\n"), ("x.zip", b"PK\x03\x04abcdefgh")]
    {
        fs::write(folder.path().join(name), bytes).unwrap();
    }
    fs::write(folder.path().join("run.log"), log()).unwrap();
    for (arguments, code, begin) in [
        ("fit empty.log", 1, "skinbus: empty.log: the file is empty"),
        ("fit notes.txt", 1, "skinbus: notes.txt: no frame in 1 line; expected the output of candump"),
        ("fit x.zip", 2, "skinbus: x.zip is "),
        ("fit .", 2, "skinbus: . is a directory"),
        ("fit nowhere", 2, "skinbus: there is no file nowhere, and opening it as a bus failed: "),
        (
            "fit run.log notes.txt",
            2,
            "skinbus: notes.txt contains no CAN frames: leave it out, or name a \
                                      candump log or an MCAP recording instead",
        ),
        (
            "fit run.log vcan0",
            2,
            "skinbus: run.log, vcan0: files and buses cannot be mixed: name one file, the parts of one recording",
        ),
        ("fit run.log --duration 3", 2, "skinbus: --duration is only for live buses"),
        ("fit run.log --nominal 2M", 2, "skinbus: nominal bit rate 2000000 bit/s: CAN allows"),
        ("fit run.log --data 9M", 2, "skinbus: data bit rate 9000000 bit/s: CAN FD allows"),
        ("fit run.log --rates can0=1M/9M", 2, "skinbus: invalid value 'can0=1M/9M'"),
        ("fit run.log --ber 2", 2, "skinbus: --ber: the bit error rate 2 is out of range: use 0 to 0.01"),
    ] {
        let (got, text, said) = gateway(folder.path(), arguments);
        assert_eq!(
            (got, text.as_str(), said.matches('\n').count()),
            (Some(code), "", 1),
            "{arguments}: {said}"
        );
        assert!(said.starts_with(begin), "{arguments}: {said}");
    }
}

#[test]
fn a_time_at_the_end_of_all_clocks_is_a_time_like_others() {
    let folder = tempfile::tempdir().unwrap();
    let log = "(18446744073.709551) vcan0 001##500000000000000000000000000000006\n";
    fs::write(folder.path().join("late.log"), log.repeat(3)).unwrap();
    for line in ["fit late.log", "fit late.log --json", "fit late.log --ber 0.01"] {
        let (code, out, said) = gateway(folder.path(), line);
        let one = "late.log: all 3 frames of vcan0 have the same time, 18446744073.709551000: rates, gaps \
                   and bus loads are meaningless\n";
        assert_eq!((code, said.as_str()), (Some(0), one), "{line}");
        assert!(!out.is_empty());
    }
}
