//! Tests that captures survive the conversion to the other format and back, and that damaged ones are read up to the
//! damage.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Cursor;

use crate::capture::convert::{CaptureWriter, ConversionCounts, convert};
use crate::capture::log::{LogStyle, MAX_LINE_BYTES};
use crate::capture::{CaptureEntry, CaptureError, CaptureFormat, CaptureNote, NoteKind, Reader};
use crate::recording::file::FileWriter;
use proptest::prelude::*;
use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, Frame, STANDARD_MASK};
use protocol::candump::{Direction, Record, Timestamp, write_record};

const CORPUS: &[u8] = include_bytes!("../../../../protocol/tests/golden/candump_corpus.log");
const NANOS: u64 = 1_700_000_000_000_000_000;

fn reader(bytes: &[u8]) -> Reader {
    Reader::from_read("the capture", Cursor::new(bytes.to_vec())).unwrap()
}

fn converted(bytes: &[u8], format: CaptureFormat) -> (Vec<u8>, ConversionCounts) {
    let mut out = Vec::new();
    let mut from = reader(bytes);
    let style = LogStyle { directions: from.is_from_log(), ..LogStyle::default() };
    let mut to = CaptureWriter::new(&mut out, format, style).unwrap();
    let done = convert(&mut from, &mut to, |_, _| Ok(())).unwrap();
    to.finish().unwrap();
    drop(to);
    (out, done)
}

/// Converts a log to a recording and back.
fn there_and_back(log: &[u8]) -> Vec<u8> {
    converted(&converted(log, CaptureFormat::Mcap).0, CaptureFormat::Candump).0
}

/// Returns all entries as text, and the end of the capture.
fn entries(bytes: &[u8]) -> (Vec<String>, End) {
    let mut reader = match Reader::from_read("the capture", Cursor::new(bytes.to_vec())) {
        Ok(reader) => reader,
        Err(error) => return (Vec::new(), Err(error)),
    };
    let mut entries = Vec::new();
    loop {
        match reader.next() {
            Ok(Some(entry)) => entries.push(format!("{entry:?}")),
            Ok(None) => return (entries, Ok(reader.extras().unfinished.clone())),
            Err(error) => return (entries, Err(error)),
        }
    }
}

/// Generates frames of all kinds that a log can hold.
fn frame() -> impl Strategy<Value = Frame> {
    let data = proptest::collection::vec(any::<u8>(), 0..=64);
    (0..8, any::<u32>(), 0_u8..16, 9_u8..16, data).prop_map(|(kind, id, flags, dlc, data)| {
        let short = &data[..data.len().min(8)];
        let full: [u8; 8] = std::array::from_fn(|at| data.get(at).copied().unwrap_or(7));
        match kind {
            0 => Frame::classic(id & STANDARD_MASK, short),
            1 => Frame::classic(id & EXTENDED_MASK | EXTENDED, short),
            2 => Frame::remote(id & STANDARD_MASK, flags % 9),
            3 => Frame::remote(id & EXTENDED_MASK | EXTENDED, flags % 9),
            4 => Frame::classic(id & EXTENDED_MASK | ERROR, short),
            5 => Frame::classic(id & STANDARD_MASK, &full).map(|frame| frame.with_raw_dlc(dlc)),
            6 => Frame::with_data(id & EXTENDED_MASK | EXTENDED, protocol::can::Format::Fd, flags, &data),
            _ => Frame::with_data(id & STANDARD_MASK, protocol::can::Format::Fd, flags, &data),
        }
        .unwrap()
    })
}

fn line() -> impl Strategy<Value = Vec<u8>> {
    let name = prop_oneof![
        "v?can[0-9]",
        "[!-~]{1,20}",
        "\\PC{1,9}".prop_map(|name| name.replace(char::is_whitespace, "-"))
    ];
    let of_frame = (name, frame(), any::<u64>(), any::<bool>(), 0..3_usize, 0..3_usize).prop_map(
        |(name, frame, nanos, nine, way, pad)| {
            let min_digits = [1, 3, 10][pad];
            let nanos = if nine { nanos } else { nanos / 1_000 * 1_000 };
            let time = Timestamp { nine_digits: nine, min_digits, ..Timestamp::with_six_digits(nanos) };
            let mut line = String::new();
            write_record(&mut line, &Record { time, interface: &name, frame, direction: None }).unwrap();
            line + ["", " T", " R"][way]
        },
    );
    prop_oneof![
        6 => of_frame.prop_map(String::into_bytes),
        1 => "#.{0,40}".prop_map(String::into_bytes),
        1 => (0_u32..40).prop_map(|n| format!("DROPCOUNT: dropped {n} CAN frames on 'can1' socket (total drops 99)").into_bytes()),
        1 => "\\([0-9.]{0,20}\\)? ?[a-z0-9 ]{0,8}[0-9A-F#R._]{0,40}".prop_map(String::into_bytes),
        1 => proptest::collection::vec(any::<u8>(), 0..30),
        1 => Just(b"(1.000000) vcan0 45123###81:00:12345678#11223344556677".to_vec()),
        1 => Just(Vec::new()),
    ]
}

/// Generates logs with at least one frame, and without line ends inside a line.
fn log() -> impl Strategy<Value = Vec<u8>> {
    proptest::collection::vec(line(), 0..40).prop_map(|mut lines| {
        lines.push(b"(1.000000) vcan0 123#".to_vec());
        for line in &mut lines {
            line.retain(|byte| !b"\r\n".contains(byte));
        }
        lines.iter().flat_map(|line| line.iter().copied().chain([b'\n'])).collect()
    })
}

proptest! {
    #[test]
    fn any_log_comes_back_with_all_that_it_says(log in log()) {
        let back = there_and_back(&log);
        prop_assert_eq!(entries(&back).0, entries(&log).0);
        prop_assert_eq!(there_and_back(&back), back, "and is what it was from then on");
    }

    #[test]
    fn what_is_in_the_portable_subset_comes_back_byte_for_byte(
        frames in proptest::collection::vec((frame(), 0_u64..4_000_000_000_000_000, "v?can[0-9]", any::<bool>()), 1..50)
    ) {
        let mut log = String::new();
        for (frame, micros, interface, nine_digits) in &frames {
            let time = Timestamp {
                nine_digits: *nine_digits,
                ..Timestamp::with_six_digits(micros * 1_000 + u64::from(*nine_digits))
            };
            write_record(&mut log, &Record { time, interface, frame: *frame, direction: None }).unwrap();
            log.push('\n');
        }
        prop_assert_eq!(String::from_utf8(there_and_back(log.as_bytes())).unwrap(), log);
    }

    #[test]
    fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200), mcap: bool) {
        let head: &[u8] = if mcap { ::mcap::MAGIC } else { b"" };
        let _ = entries(&[head, &bytes].concat());
    }
}

#[test]
fn of_the_odd_lines_nothing_is_lost() {
    let (before, _) = entries(CORPUS);
    let back = there_and_back(CORPUS);
    let (after, _) = entries(&back);
    assert_eq!(before, after);
    let same = CORPUS.split(|&byte| byte == b'\n').zip(back.split(|&byte| byte == b'\n'));
    let other: Vec<_> = same.filter(|(before, after)| before != after).collect();
    // All other lines of the output differ only in padding, dots, case or indentation.
    assert_eq!(
        other.len(),
        17,
        "{:?}",
        other.iter().map(|(line, _)| String::from_utf8_lossy(line)).collect::<Vec<_>>()
    );
}

#[test]
fn ends_of_lines_are_those_of_this_system_and_a_byte_order_mark_is_none() {
    let log = b"\xEF\xBB\xBF(1.000000) can0 123#\r\n# kept\r\n(1.000000) can0 123#";
    assert_eq!(there_and_back(log), b"(1.000000) can0 123#\n# kept\n(1.000000) can0 123#\n");
}

#[test]
fn more_buses_than_a_recording_has_channels_for_keep_their_names() {
    let mut log = String::new();
    for round in 0..2 {
        for bus in 0..100 {
            let digits = if bus % 3 == 0 { "000000" } else { "000000000" };
            writeln!(log, "({round}.{digits}) can{bus} 123#{bus:02X}").unwrap();
        }
    }
    let (mcap, done) = converted(log.as_bytes(), CaptureFormat::Mcap);
    assert_eq!(done, ConversionCounts { frames: 200, ..ConversionCounts::default() });
    assert_eq!(String::from_utf8(there_and_back(log.as_bytes())).unwrap(), log);
    let summary = ::mcap::Summary::read(&mcap).unwrap().unwrap();
    assert!(summary.channels.len() <= 66, "{}", summary.channels.len());
}

#[test]
fn notes_before_the_first_frame_have_its_time_in_a_recording() {
    let log = b"# who, where\n\n(1700000000.000001) can0 123#\n";
    let (mcap, _) = converted(log, CaptureFormat::Mcap);
    let times: Vec<_> =
        ::mcap::MessageStream::new(&mcap).unwrap().map(|message| message.unwrap().log_time).collect();
    assert_eq!(times, [NANOS + 1_000; 3]);
    assert_eq!(entries(&mcap).0, entries(log).0);
}

/// Returns the remarks on the times of a log.
fn backwards(log: &str) -> Vec<String> {
    let mut reader = reader(log.as_bytes());
    while reader.next().unwrap().is_some() {}
    reader.remarks()
}

#[test]
fn times_that_run_backwards_are_counted_and_keep_their_order() {
    let log = "(3.000000) can0 001#\n(2.000000) can0 002#\n(2.500000) can0 003#\n(1.000000) can0 004#\n";
    let (mcap, done) = converted(log.as_bytes(), CaptureFormat::Mcap);
    assert_eq!(done.frames, 4);
    assert_eq!(
        backwards(log),
        ["the time stamps go backwards 2 times, first at frame 2; the order of the frames is kept"]
    );
    assert_eq!(converted(&mcap, CaptureFormat::Candump).0, log.as_bytes());
}

#[test]
fn times_of_each_bus_are_compared_with_its_own() {
    let apart = "(3.000000) can0 001#\n(1.000000) can1 002#\n(4.000000) can0 003#\n(2.000000) can1 004#\n";
    assert_eq!(backwards(apart), [""; 0]);
    let earlier = apart.replace("(2.", "(0.");
    assert_eq!(
        backwards(&earlier),
        ["the time stamps go backwards 1 times, first at frame 4; the order of the frames is kept"]
    );
}

/// Returns a recording of several chunks, and the times and data of its frames.
fn recording() -> (Vec<u8>, Vec<(u64, Vec<u8>)>) {
    let mut log = String::new();
    for line in 0..9_000_u32 {
        let bits = u64::from(line).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let (sec, micro, bus, id) = (line / 1_000, line % 1_000, line % 2, line % 0x7FF);
        writeln!(log, "({sec}.{micro:06}) can{bus} {id:03X}##5{bits:016X}").unwrap();
    }
    (converted(log.as_bytes(), CaptureFormat::Mcap).0, frames(log.as_bytes()).0)
}

/// The end of a capture as its reader reports it: an error, or a description of a missing end.
type End = Result<Option<String>, CaptureError>;

/// Returns the times and data of all frames, and the end of the capture.
fn frames(bytes: &[u8]) -> (Vec<(u64, Vec<u8>)>, End) {
    let mut reader = reader(bytes);
    let mut frames = Vec::new();
    loop {
        match reader.next() {
            Ok(Some(CaptureEntry::Frame(record))) => {
                frames.push((record.time.nanos, record.frame.data().to_vec()))
            }
            Ok(Some(CaptureEntry::Note(note))) => panic!("{note:?}"),
            Ok(None) => return (frames, Ok(reader.extras().unfinished.clone())),
            Err(error) => return (frames, Err(error)),
        }
    }
}

#[test]
fn a_recording_that_is_truncated_is_read_as_far_as_it_goes() {
    let (mcap, all) = recording();
    let mut most = 0;
    for length in (8..mcap.len()).step_by(3_001).chain([mcap.len() - 1]) {
        let (found, end) = frames(&mcap[..length]);
        assert!(all.starts_with(&found), "cut at {length}");
        assert!(found.len() >= most, "cut at {length}");
        most = found.len();
        let why = end.unwrap_or_else(|error| panic!("cut at {length}: {error}"));
        assert!(why.unwrap().contains("its end is missing"), "cut at {length}");
    }
    assert_eq!((most, frames(&mcap).1.unwrap()), (all.len(), None));
}

#[test]
fn a_damaged_recording_is_read_up_to_the_damage() {
    let (mcap, all) = recording();
    let (mut tried, mut silent, mut partly) = (0, 0, 0);
    for at in (8..mcap.len()).step_by(2_003).chain(8..40) {
        let mut damaged = mcap.clone();
        damaged[at] ^= if at % 2 == 0 { 0x01 } else { 0x80 };
        let (found, end) = frames(&damaged);
        assert!(all.starts_with(&found) || end.is_err(), "byte {at}: other frames, and no word of it");
        tried += 1;
        partly += usize::from((1..all.len()).contains(&found.len()));
        match end {
            Ok(None) => {
                // The file stores the damaged byte twice, or it is never read.
                assert_eq!(found, all, "byte {at}");
                silent += 1;
            }
            Ok(Some(_)) => {}
            Err(error) => assert!(error.to_string().starts_with("the capture is damaged: "), "{error}"),
        }
    }
    assert!(silent < tried / 4 && partly > tried / 4, "{silent} and {partly} of {tried}");
}

fn of<'a>(topics: &'a [crate::capture::Topic], name: &str) -> Option<&'a crate::capture::Topic> {
    topics.iter().find(|topic| topic.name == name)
}

#[test]
fn what_else_a_recording_has_is_named_and_counted() {
    let mut bytes = Vec::new();
    let mut file = FileWriter::new(&mut bytes).unwrap();
    file.write_metadata("run", &BTreeMap::from([("git".to_owned(), "abc".to_owned())])).unwrap();
    file.attach("skin.toml", "application/toml", NANOS, b"version = 1").unwrap();
    let time = Timestamp::with_nine_digits(NANOS);
    let frame = Frame::classic(0x123, &[1]).unwrap();
    let record = Record { time, interface: "can0", frame, direction: Some(Direction::Received) };
    let mut state = file.channel::<Record<'_>>("/state/can0", &[]).unwrap();
    let mut can = file.channel::<Record<'_>>("/can/can0", &[("time_digits", "9")]).unwrap();
    let mut notes = file.channel::<CaptureNote<'_>>("/can/notes", &[]).unwrap();
    let note =
        CaptureNote { kind: NoteKind::Dropped(2), nanos: NANOS, interface: "can0", line: 0, text: b"" };
    file.write(&mut state, NANOS, &record).unwrap();
    file.write(&mut can, NANOS, &record).unwrap();
    file.write(&mut notes, NANOS, &note).unwrap();
    for time in 0..3 {
        let diagnostics = crate::ros2::standard::Diagnostics { nanos: time, parts: &[] };
        let mut channel =
            file.channel::<crate::ros2::standard::Diagnostics<'_>>("/diagnostics", &[]).unwrap();
        file.write(&mut channel, time, &diagnostics).unwrap();
    }
    file.finish().unwrap();
    drop(file);
    let mut reader = reader(&bytes);
    let mut seen = 0;
    while reader.next().unwrap().is_some() {
        seen += 1;
    }
    let extras = reader.extras();
    assert_eq!((seen, of(&extras.topics, "/diagnostics").unwrap().messages, extras.topics.len()), (2, 3, 1));
    assert_eq!((extras.latched[0].frame, extras.latched.len()), (frame, 1));
    assert_eq!(extras.attachments, [("skin.toml".to_owned(), b"version = 1".to_vec())]);
    assert_eq!(extras.metadata[0], ("run".to_owned(), vec![("git".to_owned(), "abc".to_owned())]));
    let (log, _) = converted(&bytes, CaptureFormat::Candump);
    let expected = "(1700000000.000000000) can0 123#01\n\
                    DROPCOUNT: dropped 2 CAN frames on 'can0' socket (total drops 2)\n";
    assert_eq!(String::from_utf8(log).unwrap(), expected);
}

#[test]
fn of_a_line_that_is_too_long_the_beginning_is_kept() {
    let log = [&b"(".repeat(3 * MAX_LINE_BYTES), &b"\n(1.000000) can0 123#\n"[..]].concat();
    let back = there_and_back(&log);
    assert_eq!(back, [&b"(".repeat(MAX_LINE_BYTES), &b"\n(1.000000) can0 123#\n"[..]].concat());
}
