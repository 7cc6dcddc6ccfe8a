//! Unusual lines of candump text with their expected results: `golden/candump_corpus.log`, written by hand.
//!
//! The crate `socketcan` parses the same lines as a second opinion; the corpus notes where it accepts less.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test may stop")]

use std::collections::BTreeMap;

use crate::can::{FD_FORMAT, Format, Frame};
use crate::candump::{self, CandumpLine, Direction, Record};
use socketcan::dump::{self, CanDumpRecord, Reader};
use socketcan::{CanAnyFrame, EmbeddedFrame as _, Frame as _};

const CORPUS: &str = include_str!("../../tests/golden/candump_corpus.log");

/// The expected result of a line: a word such as `frame`, and `key=value` fields.
struct Expected<'a> {
    what: &'a str,
    fields: BTreeMap<&'a str, &'a str>,
}

impl<'a> Expected<'a> {
    /// Parses the expected result of a line. Returns `None` for a comment that explains the corpus.
    fn new(text: &'a str) -> Option<Self> {
        let mut words = text.split_whitespace();
        let what = words.next()?;
        let fields: Option<_> = words.map(|field| field.split_once('=')).collect();
        let known = ["frame", "xl", "other", "error"].contains(&what) || what.starts_with("dropped=");
        fields.filter(|_| known).map(|fields| Self { what, fields })
    }

    fn get(&self, key: &str) -> &'a str {
        self.fields.get(key).copied().unwrap_or_default()
    }
}

/// Returns each line of the corpus with its expected result.
fn corpus() -> Vec<(Expected<'static>, &'static str)> {
    let mut cases = Vec::new();
    let mut expected = None;
    for line in CORPUS.lines() {
        if let Some(text) = line.strip_prefix("#=") {
            expected = Expected::new(text).or(expected);
        } else if let Some(expected) = expected.take() {
            cases.push((expected, line));
        } else {
            assert!(line.is_empty(), "{line}: nothing is said of it");
        }
    }
    assert!(cases.len() > 70, "{}", cases.len());
    cases
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect()
}

/// Describes a frame in the notation of the corpus, from its accessors rather than its text.
fn describe(record: &Record<'_>) -> BTreeMap<&'static str, String> {
    let Record { time, interface, frame, direction } = record;
    let kind = match (frame.is_error(), frame.is_remote(), frame.is_extended()) {
        (true, ..) => "error",
        (_, true, true) => "remote-extended",
        (_, true, false) => "remote",
        (_, false, true) => "extended",
        (_, false, false) => "",
    };
    let id = if frame.is_extended() || frame.is_error() {
        format!("{:08X}", frame.id())
    } else {
        format!("{:03X}", frame.id())
    };
    let when = |expected, text: String| if expected { text } else { String::new() };
    BTreeMap::from([
        ("kind", kind.to_owned()),
        ("id", id),
        ("bus", (*interface).to_owned()),
        ("ns", time.nanos.to_string()),
        ("data", hex(frame.data())),
        ("fd", when(frame.format() == Format::Fd, format!("{:X}", frame.flags()))),
        ("dlc", when(frame.raw_dlc() != 0, format!("{:X}", frame.raw_dlc()))),
        ("len", when(frame.is_remote(), frame.len().to_string())),
        (
            "dir",
            match direction {
                None => String::new(),
                Some(Direction::Sent) => "T".to_owned(),
                Some(Direction::Received) => "R".to_owned(),
            },
        ),
    ])
}

#[test]
fn every_line_is_what_the_corpus_says() {
    for (expected, line) in corpus() {
        match (expected.what, candump::parse(line)) {
            ("frame", Ok(CandumpLine::Frame(record))) => {
                for (key, found) in describe(&record) {
                    assert_eq!(found, expected.get(key), "{key} of {line}");
                }
                let out = match expected.get("out") {
                    "" => line.to_owned(),
                    out => out.replace('|', " "),
                };
                assert_eq!(record.to_string(), out, "written again");
                let again = candump::parse(&out).unwrap();
                assert_eq!(again, CandumpLine::Frame(Record { direction: None, ..record }), "and read again");
            }
            ("xl", Ok(CandumpLine::CanXl)) | ("other", Ok(CandumpLine::Other)) => {}
            (what, Ok(CandumpLine::Dropped { frames })) => {
                assert_eq!(what, format!("dropped={frames}"), "{line}")
            }
            ("error", Err(error)) => {
                assert_eq!(error.column.to_string(), expected.get("column"), "{line}: {error}");
            }
            (what, found) => panic!("{line}: {found:?}, not {what}"),
        }
    }
}

#[test]
fn frames_with_and_without_fdf_differ_in_that_flag_alone() {
    let before = candump::parse_frame("210##1AABB").unwrap();
    let after = candump::parse_frame("210##5AABB").unwrap();
    assert_eq!((before.raw_id(), before.data()), (after.raw_id(), after.data()));
    assert_eq!(before.flags() ^ after.flags(), FD_FORMAT);
}

fn second_opinion(line: &str) -> Result<Option<CanDumpRecord>, dump::ParseError> {
    Reader::from_reader(line.as_bytes()).next_record()
}

/// Returns true if the crate `socketcan` parsed the same frame at the same time on the same bus. FDF is not compared,
/// because the crate sets it in every FD frame.
fn same(record: &Record<'_>, other: &CanDumpRecord) -> bool {
    let Record { time, interface, frame, direction } = record;
    let direction = direction.map(|direction| match direction {
        Direction::Sent => dump::Direction::Transmitted,
        Direction::Received => dump::Direction::Received,
    });
    (other.t_us * 1_000, other.device.as_str(), other.direction) == (time.nanos, *interface, direction)
        && same_frame(frame, &other.frame)
}

fn same_frame(frame: &Frame, other: &CanAnyFrame) -> bool {
    let plain = frame.format() == Format::Classic && !frame.is_error();
    match other {
        CanAnyFrame::Normal(other) => {
            plain
                && !frame.is_remote()
                && (other.is_extended(), other.raw_id(), other.data())
                    == (frame.is_extended(), frame.id(), frame.data())
        }
        CanAnyFrame::Remote(other) => {
            plain
                && frame.is_remote()
                && (other.is_extended(), other.raw_id(), other.dlc())
                    == (frame.is_extended(), frame.id(), usize::from(frame.len()))
        }
        CanAnyFrame::Error(other) => {
            frame.is_error() && (other.raw_id(), other.data()) == (frame.id(), frame.data())
        }
        CanAnyFrame::Fd(other) => {
            frame.format() == Format::Fd
                && (other.is_extended(), other.raw_id(), other.data(), other.flags().bits())
                    == (frame.is_extended(), frame.id(), frame.data(), frame.flags() | FD_FORMAT)
        }
    }
}

#[test]
fn the_crate_socketcan_agrees_where_it_can_read() {
    let mut agreed = 0;
    for (expected, line) in corpus() {
        let Ok(CandumpLine::Frame(record)) = candump::parse(line) else {
            let reads = matches!(second_opinion(line), Ok(Some(_)));
            assert_eq!(reads, expected.get("2nd") == "reads", "socketcan and {line:?}");
            continue;
        };
        let opinion = match second_opinion(line) {
            Ok(Some(other)) if same(&record, &other) => "same",
            Ok(Some(_)) => "differs",
            Ok(None) | Err(_) => "refuses",
        };
        assert_eq!(opinion, expected.get("2nd"), "{line}");
        agreed += usize::from(opinion == "same");
    }
    assert!(agreed > 20, "{agreed}");
}
