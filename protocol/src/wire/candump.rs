//! The text format of `candump -L`. The parser accepts many variants; the writer uses the subset that all tools can
//! read.
//!
//! ```text
//!   (1700000000.123456) vcan0 123#DEADBEEF       classic, 3 hex digits: 11-bit identifier
//!   (1700000000.123456) vcan0 1F334455#R4        remote, 8 digits: 29-bit identifier
//!   (1700000000.123456) vcan0 22C##5AABBCC       FD: ## and one digit of flags (1 BRS, 2 ESI, 4 FDF)
//!   (1700000000.123456) vcan0 20000004#0001...   error frame: 8 digits with 0x20000000 set
//! ```
//!
//! The parser also accepts:
//!
//! - lines that are indented, quoted with `>` or `|`, or prefixed, for example by journald
//! - several spaces or tabs between fields
//! - any number of digits after the decimal point (9: `candump -N`)
//! - a direction `T` or `R` after the frame (`-x`), and other words there
//! - dots between bytes
//! - a raw DLC (`_9` to `_F`)
//! - the kernel's flags in an identifier of 8 digits (80000000 extended, 40000000 remote, 20000000 error)
//!
//! Lines without a parenthesis are treated as other text, as can-utils does. CAN XL frames
//! (`00242#81:00:12345678#...`) are recognised but not decoded.

mod portable;
mod read;
mod write;

use core::fmt;

use thiserror::Error;

use crate::can::Frame;
use read::{Cursor, is_blank};
pub use read::{fraction_to_nanos, raw_id_from_eight_digits};
pub use write::{write_frame, write_record};

/// The time of a frame, and the number of digits with which it is written.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub struct Timestamp {
    /// Nanoseconds since 1970.
    pub nanos: u64,
    /// True if the fraction of a second has 9 digits instead of 6.
    pub nine_digits: bool,
    /// Minimum number of digits of the seconds, padded with zeros; candump pads to 10.
    pub min_digits: u8,
}

impl Timestamp {
    /// Creates a time that is written with 6 fractional digits.
    #[must_use]
    pub const fn with_six_digits(nanos: u64) -> Self {
        Self { nanos, nine_digits: false, min_digits: 1 }
    }

    /// Creates a time that is written with 9 fractional digits.
    #[must_use]
    pub const fn with_nine_digits(nanos: u64) -> Self {
        Self { nine_digits: true, ..Self::with_six_digits(nanos) }
    }
}

/// The direction of a frame, seen from the node that took the capture.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Direction {
    /// `T`.
    Sent,
    /// `R`.
    Received,
}

/// One frame of a capture.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Record<'a> {
    /// The time of the frame.
    pub time: Timestamp,
    /// The name of the CAN interface.
    pub interface: &'a str,
    /// The frame.
    pub frame: Frame,
    /// The direction, if the capture contains it.
    pub direction: Option<Direction>,
}

/// The content of one line of a capture.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum CandumpLine<'a> {
    /// A frame.
    Frame(Record<'a>),
    /// The line in which candump reports that it lost frames.
    Dropped {
        /// Number of lost frames.
        frames: u64,
    },
    /// A CAN XL frame, which is not decoded.
    CanXl,
    /// A comment, an empty line, or other text, which can-utils also skip.
    Other,
}

/// The error for a line that begins like a frame but does not contain a valid one.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[error("column {column}: expected {expected}")]
pub struct LineError {
    /// Column of the error, counted from 1.
    pub column: usize,
    /// The text that was expected in that column.
    pub expected: &'static str,
}

/// Parses one line, with or without its line ending. Never panics.
///
/// # Errors
/// Returns an error if the line begins with a parenthesis, possibly after blanks and quotation marks, but is not a
/// valid frame.
pub fn parse(line: &str) -> Result<CandumpLine<'_>, LineError> {
    parse_bytes(line.as_bytes())
}

/// Like [`parse`], for a line that need not be UTF-8; only the interface name must be. Never panics.
///
/// # Errors
/// Returns an error if the line begins with a parenthesis, possibly after blanks and quotation marks, but is not a
/// valid frame.
#[inline]
pub fn parse_bytes(line: &[u8]) -> Result<CandumpLine<'_>, LineError> {
    portable::parse_record(line)
        .map_or_else(|| parse_any_variant(line), |record| Ok(CandumpLine::Frame(record)))
}

/// Parses a line in any of the accepted variants.
fn parse_any_variant(line: &[u8]) -> Result<CandumpLine<'_>, LineError> {
    let text = trim_end(line);
    // Blanks and quotation marks of e-mails and issue trackers.
    let indent = text.iter().take_while(|byte| matches!(byte, b' ' | b'\t' | b'>' | b'|')).count();
    match text.get(indent..).unwrap_or_default() {
        [b'(', next, ..] if indent > 0 && next.is_ascii_digit() => parse_from_parenthesis(text, indent),
        [b'(', ..] if indent == 0 => parse_from_parenthesis(text, 0),
        [b'#' | b';' | b'/', ..] => Ok(classify_line_without_frame(text)),
        _ => Ok(parse_after_prefix(text).unwrap_or_else(|| classify_line_without_frame(text))),
    }
}

/// Parses a line whose opening parenthesis is at index `at`.
fn parse_from_parenthesis(text: &[u8], at: usize) -> Result<CandumpLine<'_>, LineError> {
    let mut cursor = Cursor::new(text, at + 1);
    let time = cursor.parse_time()?;
    cursor.expect(b')', "`)` after the time")?;
    cursor.skip_blanks()?;
    let interface = cursor.parse_interface()?;
    cursor.skip_blanks()?;
    let Some(frame) = cursor.parse_frame()? else {
        return Ok(CandumpLine::CanXl);
    };
    let direction = cursor.parse_direction()?;
    Ok(CandumpLine::Frame(Record { time, interface, frame, direction }))
}

/// Finds a frame after a prefix such as journald's. If the text after a parenthesis is not a valid frame, it counts as
/// part of the prefix.
fn parse_after_prefix(text: &[u8]) -> Option<CandumpLine<'_>> {
    let begins = |pair: &[u8]| matches!(pair, [before, b'('] if is_blank(*before));
    let places = text.windows(2).enumerate().filter(|(_, pair)| begins(pair));
    places.map(|(at, _)| parse_from_parenthesis(text, at + 1)).find_map(Result::ok)
}

/// Parses a frame without time and interface, in the notation of cansend: `123#DEADBEEF`. Never panics.
///
/// # Errors
/// Returns an error if the text is not a frame, is a CAN XL frame, or contains anything after the frame.
pub fn parse_frame(text: &str) -> Result<Frame, LineError> {
    let mut cursor = Cursor::new(text.as_bytes(), 0);
    let frame = cursor
        .parse_frame()?
        .ok_or(LineError { column: 1, expected: "a classic or FD frame, not CAN XL" })?;
    if cursor.is_at_end() { Ok(frame) } else { Err(cursor.error("the end of the frame")) }
}

impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_frame(f, self)
    }
}

impl fmt::Display for Record<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_record(f, self)
    }
}

/// Strips trailing white space and line endings, including the white space of Unicode.
fn trim_end(line: &[u8]) -> &[u8] {
    match line.last() {
        // Fast path: nearly every line ends in a digit.
        Some(b'!'..=b'~') | None => line,
        Some(_) => core::str::from_utf8(line)
            .map_or_else(|_| line.trim_ascii_end(), |line| line.trim_end().as_bytes()),
    }
}

/// Classifies a line without a frame. Recognises candump's `DROPCOUNT: dropped 12 CAN frames on 'vcan0'
/// socket ...`.
fn classify_line_without_frame(text: &[u8]) -> CandumpLine<'_> {
    text.strip_prefix(b"DROPCOUNT: dropped ")
        .and_then(|rest| rest.split(|&byte| byte == b' ').next())
        .and_then(|frames| core::str::from_utf8(frames).ok()?.parse().ok())
        .map_or(CandumpLine::Other, |frames| CandumpLine::Dropped { frames })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::{BIT_RATE_SWITCH, ERROR, EXTENDED, EXTENDED_MASK, Format, STANDARD_MASK};
    use proptest::prelude::*;

    fn frame_of(line: &str) -> Frame {
        match parse(line) {
            Ok(CandumpLine::Frame(record)) => record.frame,
            other => panic!("{line}: {other:?}"),
        }
    }

    #[test]
    fn a_line_is_read_in_every_dress() {
        let plain = parse("(1700000000.123456) vcan0 22C##1AABBCC").unwrap();
        let CandumpLine::Frame(record) = plain else { panic!("{plain:?}") };
        assert_eq!(record.time, Timestamp::with_six_digits(1_700_000_000_123_456_000));
        assert_eq!((record.interface, record.direction), ("vcan0", None));
        assert_eq!(record.frame.data(), [0xAA, 0xBB, 0xCC]);
        assert_eq!(record.frame.flags(), BIT_RATE_SWITCH);

        let dressed = parse("(1700000000.123456789)   vcan0  22C##1AA.BB.cc   T\r\n").unwrap();
        let CandumpLine::Frame(other) = dressed else { panic!("{dressed:?}") };
        assert_eq!(other.frame, record.frame);
        assert_eq!(other.time, Timestamp::with_nine_digits(1_700_000_000_123_456_789));
        assert_eq!(other.direction, Some(Direction::Sent));
    }

    #[test]
    fn all_kinds_of_frames_are_told_apart() {
        let remote = frame_of("(0.000000) can0 1F334455#R4");
        assert!(remote.is_remote() && remote.is_extended() && remote.len() == 4 && remote.data().is_empty());
        let error = frame_of("(0.000000) can0 20000004#0001000000000000");
        assert!(error.is_error() && !error.is_extended());
        assert!(frame_of("(0.000000) can0 00000123#").is_extended());
        assert_eq!(frame_of("(0.000000) can0 123#1122334455667788_E").raw_dlc(), 14);
        assert_eq!(frame_of("(0.000000) can0 123##5AABBCCDDEEFF0011223344").len(), 11, "no padding");
        for xl in ["00242###81000000000011.", "00242#81:00:12345678#", "12345678#80:01:00000000#112233"] {
            assert_eq!(parse(&format!("(0.000000) can0 {xl}")), Ok(CandumpLine::CanXl));
        }
    }

    #[test]
    fn text_that_is_no_frame_is_let_through() {
        assert_eq!(parse(""), Ok(CandumpLine::Other));
        assert_eq!(parse("# a comment"), Ok(CandumpLine::Other));
        let drop = "DROPCOUNT: dropped 12 CAN frames on 'vcan0' socket (total drops 40)";
        assert_eq!(parse(drop), Ok(CandumpLine::Dropped { frames: 12 }));
    }

    #[test]
    fn bytes_need_not_be_text() {
        assert_eq!(parse_bytes(b"# \xFF"), Ok(CandumpLine::Other));
        let says = |line| parse_bytes(line).unwrap_err().to_string();
        assert_eq!(says(b"(1.000000) c\xFFn 123#"), "column 12: expected the name of an interface");
        assert_eq!(says(b"(1.000000) can0 123#\xFF"), "column 21: expected a space");
        assert!(matches!(parse_bytes("(1.000000) kän 123# \u{A0}".as_bytes()), Ok(CandumpLine::Frame(_))));
    }

    /// Compares lines in many notations with the values in `vectors/candump.tsv`.
    #[test]
    fn lines_have_the_values_that_can_utils_and_python_can_read() {
        let vectors = include_str!("../../tests/vectors/candump.tsv");
        let mut count = 0;
        for row in vectors.lines().filter(|row| !row.starts_with('#')) {
            let (line, expected) = row.rsplit_once("\t=> ").unwrap();
            let Ok(CandumpLine::Frame(record)) = parse(line) else { panic!("{line}: {:?}", parse(line)) };
            let (seconds, nanos) = (record.time.nanos / 1_000_000_000, record.time.nanos % 1_000_000_000);
            let read = format!("{seconds}.{nanos:09} {} {}", record.interface, record.frame);
            assert_eq!(read, expected, "{line}");
            count += 1;
        }
        assert!(count >= 300, "{count}");
    }

    #[test]
    fn the_kernels_flags_in_an_identifier_are_flags() {
        for (line, expected) in [
            ("98f010fe#35", "18F010FE#35"),
            ("18f010fe#35", "18F010FE#35"),
            ("92345678##1AA", "12345678##1AA"),
            ("D2345678##1AA", "12345678##1AA"),
            ("C0000123#R4", "00000123#R4"),
            ("C0000123#0000", "00000123#R2"),
            ("C0000123#", "00000123#R"),
            ("A0000004#0001", "20000004#0001"),
            ("E0000004#0001", "20000004#0001"),
            ("FFFFFFFF#", "3FFFFFFF#"),
        ] {
            assert_eq!(frame_of(&format!("(1.000000) can0 {line}")).to_string(), expected, "{line}");
        }
    }

    #[test]
    fn a_fraction_has_any_number_of_digits() {
        let time = |text: &str| match parse(&format!("({text}) can0 123#")) {
            Ok(CandumpLine::Frame(record)) => (record.time.nanos, record.time.nine_digits),
            other => panic!("{text}: {other:?}"),
        };
        assert_eq!(time("7"), (7_000_000_000, false));
        for digits in 1..=12 {
            let text = format!("1.{}", &"123456789876"[..digits]);
            let nanos = format!("1{:0<9}", &"123456789"[..digits.min(9)]).parse().unwrap();
            assert_eq!(time(&text), (nanos, digits > 6), "{text}");
        }
    }

    #[test]
    fn words_may_stand_before_and_behind_a_frame() {
        for line in [
            "Nov 26 18:00:00 rpi candump[512]: (1700000000.123456) can0 123#1122",
            "\t(1700000000.123456)\tcan0\t123#1122\t",
            "(1700000000.123456) can0 123#1122 :: EEC1(EngSpeed: 499.375 rpm)",
            "(1700000000.123456) can0 123#1122   ERRORFRAME",
            "words (2) and (1700000000.123456) can0 123#1122",
        ] {
            let Ok(CandumpLine::Frame(record)) = parse(line) else { panic!("{line}: {:?}", parse(line)) };
            assert_eq!(record.to_string(), "(1700000000.123456) can0 123#1122", "{line}");
            assert_eq!(record.direction, None);
        }
        let Ok(CandumpLine::Frame(sent)) = parse("(1.000000) can0 123# T :: words") else { panic!() };
        assert_eq!(sent.direction, Some(Direction::Sent));
        for line in ["# (1.000000) can0 123#", "// (1.000000) can0 123#", "rpi: (1.000000) can0 123#1"] {
            assert_eq!(parse(line), Ok(CandumpLine::Other), "{line}");
        }
    }

    #[test]
    fn what_is_wrong_is_said_with_its_column() {
        let says = |line| parse(line).unwrap_err().to_string();
        assert_eq!(says("(1.) can0 123#"), "column 4: expected digits of a second");
        assert_eq!(
            says("(1.000000) can0 12#11"),
            "column 17: expected an identifier of 3 or 8 hexadecimal digits"
        );
        assert_eq!(says("(1.000000) can0 800#11"), "column 17: expected an 11-bit identifier, at most 7FF");
        assert_eq!(says("(1.000000) can0 123#1"), "column 22: expected the second digit of a byte");
        assert_eq!(
            says("(1.000000) can0 123#112233445566778899"),
            "column 39: expected at most 8 bytes in a classic frame"
        );
        let further = "the end of the data: a byte follows a space";
        assert_eq!(says("(1.000000) can0 123#11 22"), format!("column 24: expected {further}"));
        let remote = "no data, because the identifier has the flag of a remote frame";
        assert_eq!(says("(1.000000) can0 C0000123#11"), format!("column 26: expected {remote}"));
        assert_eq!(says("(1.000000) can0 123##"), "column 22: expected one hexadecimal digit of FD flags");
        assert_eq!(says("(1.000000) "), "column 11: expected a space");
    }

    proptest! {
        #[test]
        fn every_frame_comes_back(
            nanos in 0_u64..4_000_000_000_000_000_000, nine: bool, pad in 0..3_usize, kind in 0..5, id: u32, flags in 0_u8..8,
            data in proptest::collection::vec(any::<u8>(), 0..=64),
        ) {
            let short = &data[..data.len().min(8)];
            let frame = match kind {
                0 => Frame::classic(id & STANDARD_MASK, short),
                1 => Frame::classic(id & EXTENDED_MASK | EXTENDED, short),
                2 => Frame::remote(id & STANDARD_MASK, flags),
                3 => Frame::classic(id & EXTENDED_MASK | ERROR, short),
                _ => Frame::with_data(id & STANDARD_MASK, Format::Fd, flags, &data),
            }.unwrap();
            let nanos = if nine { nanos } else { nanos / 1_000 * 1_000 };
            // Only padded seconds begin with a zero.
            let is_padded = |&digits: &u8| nanos / 1_000_000_000 < 10_u64.pow(u32::from(digits) - 1);
            let min_digits = [1, 3, 10].into_iter().nth(pad).filter(is_padded).unwrap_or(1);
            let record = Record { time: Timestamp { nine_digits: nine, min_digits, ..Timestamp::with_six_digits(nanos) }, interface: "vcan0", frame, direction: None };
            let line = record.to_string();
            prop_assert_eq!(parse(&line), Ok(CandumpLine::Frame(record)));
            prop_assert_eq!(parse_frame(&frame.to_string()), Ok(frame));
        }

        #[test]
        fn no_line_panics(line in "\\(?[0-9.)]{0,12} ?[a-z0-9 ]{0,8}[0-9A-F#R._ T]{0,40}") {
            let _ = parse(&line);
        }
    }
}
