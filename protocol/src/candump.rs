//! The text of `candump -L`: read widely, written in the subset that every tool reads.
//!
//! ```text
//!   (1700000000.123456) vcan0 123#DEADBEEF       classic, 3 hex digits: 11-bit identifier
//!   (1700000000.123456) vcan0 1F334455#R4        remote, 8 digits: 29-bit identifier
//!   (1700000000.123456) vcan0 22C##5AABBCC       FD: ## and one digit of flags (1 BRS, 2 ESI, 4 FDF)
//!   (1700000000.123456) vcan0 20000004#0001...   error frame: 8 digits with 0x20000000 set
//! ```
//!
//! Also read: several spaces, 9 digits of a second (`-N`), a direction `T` or `R` at the end (`-x`),
//! dots between bytes, a raw DLC (`_9` to `_F`). Lines that do not begin with a parenthesis are other
//! text, as can-utils has it; CAN XL frames (5 digits, `###`) are named but not read.

use core::fmt::{self, Write};

use thiserror::Error;

use crate::can::{ERROR, EXTENDED, EXTENDED_MASK, Format, Frame, STANDARD_MASK};

/// When a line's frame was on the bus.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub struct Timestamp {
    /// Nanoseconds since 1970.
    pub nanos: u64,
    /// Whether it was given, or is to be written, with 9 digits instead of 6.
    pub nine_digits: bool,
}

/// Whether the frame was sent or received by whoever took the capture.
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
    /// When.
    pub time: Timestamp,
    /// On which bus.
    pub interface: &'a str,
    /// What.
    pub frame: Frame,
    /// Which way, when the capture says so.
    pub direction: Option<Direction>,
}

/// What a line is.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Line<'a> {
    /// A frame.
    Frame(Record<'a>),
    /// candump's own word that it lost frames.
    Dropped {
        /// How many.
        frames: u64,
    },
    /// A CAN XL frame, which is not read.
    CanXl,
    /// A comment, an empty line, anything that can-utils skip too.
    Other,
}

/// What is wrong with a line that begins like a frame.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[error("column {column}: {expected}")]
pub struct LineError {
    /// Where, from 1.
    pub column: usize,
    /// What should stand there.
    pub expected: &'static str,
}

/// Reads one line, with or without its end. Never panics.
///
/// # Errors
/// When it begins with a parenthesis and is no frame.
pub fn parse(line: &str) -> Result<Line<'_>, LineError> {
    let text = line.trim_end();
    if !text.starts_with('(') {
        return Ok(other(text));
    }
    let mut cursor = Cursor { text, at: 1 };
    let time = cursor.time()?;
    cursor.expect(b')', "`)` after the time")?;
    cursor.spaces()?;
    let interface = cursor.word()?;
    cursor.spaces()?;
    let Some(frame) = cursor.frame()? else {
        return Ok(Line::CanXl);
    };
    let direction = cursor.direction()?;
    Ok(Line::Frame(Record { time, interface, frame, direction }))
}

/// Reads a frame alone, as cansend takes it: `123#DEADBEEF`. Never panics.
///
/// # Errors
/// When it is no frame, is CAN XL, or something follows it.
pub fn parse_frame(text: &str) -> Result<Frame, LineError> {
    let mut cursor = Cursor { text, at: 0 };
    let frame =
        cursor.frame()?.ok_or(LineError { column: 1, expected: "a classic or FD frame, not CAN XL" })?;
    if cursor.at == text.len() { Ok(frame) } else { Err(cursor.error("the end of the frame")) }
}

/// Writes one line without its end: single spaces, upper case, no direction.
///
/// # Errors
/// When `out` fails.
pub fn write_record(out: &mut impl Write, record: &Record<'_>) -> fmt::Result {
    let (seconds, nanos) = (record.time.nanos / 1_000_000_000, record.time.nanos % 1_000_000_000);
    if record.time.nine_digits {
        write!(out, "({seconds}.{nanos:09}) ")?;
    } else {
        write!(out, "({seconds}.{:06}) ", nanos / 1_000)?;
    }
    out.write_str(record.interface)?;
    out.write_char(' ')?;
    write_frame(out, &record.frame)
}

/// Writes a frame alone, as cansend takes it.
///
/// # Errors
/// When `out` fails.
pub fn write_frame(out: &mut impl Write, frame: &Frame) -> fmt::Result {
    if frame.is_error() {
        write!(out, "{:08X}#", frame.raw_id() & (ERROR | EXTENDED_MASK))?;
    } else if frame.is_extended() {
        write!(out, "{:08X}#", frame.id())?;
    } else {
        write!(out, "{:03X}#", frame.id())?;
    }
    match frame.format() {
        Format::Classic if frame.is_remote() => {
            out.write_char('R')?;
            if !frame.is_empty() {
                out.write_char(char::from(hex_digit(frame.len())))?;
            }
        }
        Format::Classic => {}
        Format::Fd => {
            out.write_char('#')?;
            out.write_char(char::from(hex_digit(frame.flags())))?;
        }
    }
    for &byte in frame.data() {
        out.write_char(char::from(hex_digit(byte >> 4)))?;
        out.write_char(char::from(hex_digit(byte)))?;
    }
    if frame.raw_dlc() != 0 {
        out.write_char('_')?;
        out.write_char(char::from(hex_digit(frame.raw_dlc())))?;
    }
    Ok(())
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

/// Other text; candump's own `DROPCOUNT: dropped 12 CAN frames on 'vcan0' socket ...` is understood.
fn other(text: &str) -> Line<'_> {
    text.strip_prefix("DROPCOUNT: dropped ")
        .and_then(|rest| rest.split(' ').next())
        .and_then(|frames| frames.parse().ok())
        .map_or(Line::Other, |frames| Line::Dropped { frames })
}

const fn hex_digit(value: u8) -> u8 {
    let value = value & 0xF;
    if value < 10 { b'0' + value } else { b'A' + value - 10 }
}

const fn nibble(digit: u8) -> Option<u8> {
    match digit {
        b'0'..=b'9' => Some(digit - b'0'),
        b'A'..=b'F' => Some(digit - b'A' + 10),
        b'a'..=b'f' => Some(digit - b'a' + 10),
        _ => None,
    }
}

struct Cursor<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Cursor<'a> {
    fn error(&self, expected: &'static str) -> LineError {
        LineError { column: self.at + 1, expected }
    }

    fn rest(&self) -> &'a [u8] {
        self.text.as_bytes().get(self.at..).unwrap_or_default()
    }

    fn peek(&self) -> Option<u8> {
        self.rest().first().copied()
    }

    fn take(&mut self, byte: u8) -> bool {
        let there = self.peek() == Some(byte);
        self.at += usize::from(there);
        there
    }

    fn expect(&mut self, byte: u8, expected: &'static str) -> Result<(), LineError> {
        if self.take(byte) { Ok(()) } else { Err(self.error(expected)) }
    }

    /// At least one space.
    fn spaces(&mut self) -> Result<(), LineError> {
        self.expect(b' ', "a space")?;
        self.at += self.rest().iter().take_while(|&&byte| byte == b' ').count();
        Ok(())
    }

    fn word(&mut self) -> Result<&'a str, LineError> {
        let len = self.rest().iter().take_while(|&&byte| byte != b' ').count();
        let word = self.text.get(self.at..self.at + len).filter(|word| !word.is_empty());
        let word = word.ok_or_else(|| self.error("the name of an interface"))?;
        self.at += len;
        Ok(word)
    }

    /// Decimal digits: their value and how many there are.
    fn digits(&mut self, expected: &'static str) -> Result<(u64, usize), LineError> {
        let start = self.at;
        let mut value = 0_u64;
        while let Some(digit @ b'0'..=b'9') = self.peek() {
            let next = value.checked_mul(10).and_then(|value| value.checked_add(u64::from(digit - b'0')));
            value = next.ok_or_else(|| self.error(expected))?;
            self.at += 1;
        }
        if self.at == start { Err(self.error(expected)) } else { Ok((value, self.at - start)) }
    }

    fn time(&mut self) -> Result<Timestamp, LineError> {
        let (seconds, _) = self.digits("seconds since 1970")?;
        self.expect(b'.', "`.` and the fraction of a second")?;
        let (fraction, digits) = self.digits("6 or 9 digits of a second")?;
        let nanos = match digits {
            6 => fraction * 1_000,
            9 => fraction,
            _ => return Err(self.error("6 or 9 digits of a second")),
        };
        let whole = seconds.checked_mul(1_000_000_000).and_then(|whole| whole.checked_add(nanos));
        let nanos = whole.ok_or_else(|| self.error("a time before the year 2554"))?;
        Ok(Timestamp { nanos, nine_digits: digits == 9 })
    }

    /// A frame, or `None` for CAN XL, whose text is skipped.
    fn frame(&mut self) -> Result<Option<Frame>, LineError> {
        let expected = "an identifier of 3 or 8 hexadecimal digits";
        let start = self.at;
        let mut id = 0_u32;
        while let Some(digit) = self.peek().and_then(nibble) {
            id = id.wrapping_shl(4) | u32::from(digit);
            self.at += 1;
        }
        let digits = self.at - start;
        if digits == 5 && self.rest().starts_with(b"###") {
            self.at = self.text.len();
            return Ok(None);
        }
        self.expect(b'#', expected)?;
        let id = match digits {
            3 if id <= STANDARD_MASK => id,
            3 => {
                return Err(LineError { column: start + 1, expected: "an 11-bit identifier, at most 7FF" });
            }
            8 if id & ERROR != 0 && id & EXTENDED == 0 => id,
            8 if id <= EXTENDED_MASK => id | EXTENDED,
            8 => {
                return Err(LineError {
                    column: start + 1,
                    expected: "a 29-bit identifier, at most 1FFFFFFF",
                });
            }
            _ => {
                return Err(LineError { column: start + 1, expected });
            }
        };
        if self.take(b'#') {
            let flags = self.peek().and_then(nibble).ok_or_else(|| self.error("one digit of FD flags"))?;
            self.at += 1;
            return self.data(id, Format::Fd, flags).map(Some);
        }
        if matches!(self.peek(), Some(b'R' | b'r')) {
            self.at += 1;
            return self.remote(id).map(Some);
        }
        self.data(id, Format::Classic, 0).map(Some)
    }

    fn remote(&mut self, id: u32) -> Result<Frame, LineError> {
        let length = self.peek().and_then(nibble);
        self.at += usize::from(length.is_some());
        let frame = Frame::remote(id, length.unwrap_or(0)).map_err(|_| self.error("a length of 0 to 8"))?;
        self.raw_dlc(frame)
    }

    fn data(&mut self, id: u32, format: Format, flags: u8) -> Result<Frame, LineError> {
        let mut data = [0; 64];
        let mut len = 0;
        loop {
            self.take(b'.');
            let Some(high) = self.peek().and_then(nibble) else {
                break;
            };
            self.at += 1;
            let low = self.peek().and_then(nibble).ok_or_else(|| self.error("the second digit of a byte"))?;
            self.at += 1;
            *data.get_mut(len).ok_or_else(|| self.error("at most 64 bytes"))? = high << 4 | low;
            len += 1;
        }
        let frame = Frame::with_data(id, format, flags, data.get(..len).unwrap_or_default());
        let frame = frame.map_err(|_| self.error("at most 8 bytes in a classic frame"))?;
        self.raw_dlc(frame)
    }

    fn raw_dlc(&mut self, frame: Frame) -> Result<Frame, LineError> {
        if !self.take(b'_') {
            return Ok(frame);
        }
        match self.peek().and_then(nibble) {
            Some(dlc @ 9..) if frame.len() == 8 && frame.format() == Format::Classic => {
                self.at += 1;
                Ok(frame.with_raw_dlc(dlc))
            }
            _ => Err(self.error("a raw DLC of 9 to F, of a classic frame of 8 bytes")),
        }
    }

    fn direction(&mut self) -> Result<Option<Direction>, LineError> {
        if self.rest().is_empty() {
            return Ok(None);
        }
        self.spaces()?;
        match self.rest() {
            b"T" => Ok(Some(Direction::Sent)),
            b"R" => Ok(Some(Direction::Received)),
            _ => Err(self.error("`T`, `R` or the end of the line")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::BIT_RATE_SWITCH;
    use proptest::prelude::*;

    fn frame_of(line: &str) -> Frame {
        match parse(line) {
            Ok(Line::Frame(record)) => record.frame,
            other => panic!("{line}: {other:?}"),
        }
    }

    #[test]
    fn a_line_is_read_in_every_dress() {
        let plain = parse("(1700000000.123456) vcan0 22C##1AABBCC").unwrap();
        let Line::Frame(record) = plain else { panic!("{plain:?}") };
        assert_eq!(record.time, Timestamp { nanos: 1_700_000_000_123_456_000, nine_digits: false });
        assert_eq!((record.interface, record.direction), ("vcan0", None));
        assert_eq!(record.frame.data(), [0xAA, 0xBB, 0xCC]);
        assert_eq!(record.frame.flags(), BIT_RATE_SWITCH);

        let dressed = parse("(1700000000.123456789)   vcan0  22C##1AA.BB.cc   T\r\n").unwrap();
        let Line::Frame(other) = dressed else { panic!("{dressed:?}") };
        assert_eq!(other.frame, record.frame);
        assert_eq!(other.time, Timestamp { nanos: 1_700_000_000_123_456_789, nine_digits: true });
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
        assert_eq!(parse("(0.000000) can0 00242###81000000000011."), Ok(Line::CanXl));
    }

    #[test]
    fn text_that_is_no_frame_is_let_through() {
        assert_eq!(parse(""), Ok(Line::Other));
        assert_eq!(parse("# a comment"), Ok(Line::Other));
        let drop = "DROPCOUNT: dropped 12 CAN frames on 'vcan0' socket (total drops 40)";
        assert_eq!(parse(drop), Ok(Line::Dropped { frames: 12 }));
    }

    #[test]
    fn what_is_wrong_is_said_with_its_column() {
        let says = |line| parse(line).unwrap_err().to_string();
        assert_eq!(says("(1.5) can0 123#"), "column 5: 6 or 9 digits of a second");
        assert_eq!(says("(1.000000) can0 12#11"), "column 17: an identifier of 3 or 8 hexadecimal digits");
        assert_eq!(says("(1.000000) can0 800#11"), "column 17: an 11-bit identifier, at most 7FF");
        assert_eq!(says("(1.000000) can0 123#1"), "column 22: the second digit of a byte");
        assert_eq!(
            says("(1.000000) can0 123#112233445566778899"),
            "column 39: at most 8 bytes in a classic frame"
        );
        assert_eq!(says("(1.000000) can0 123#11 X"), "column 24: `T`, `R` or the end of the line");
        assert_eq!(says("(1.000000) can0 123##"), "column 22: one digit of FD flags");
        assert_eq!(says("(1.000000) "), "column 11: a space");
    }

    proptest! {
        #[test]
        fn every_frame_comes_back(
            nanos in 0_u64..4_000_000_000_000_000_000, nine: bool, kind in 0..5, id: u32, flags in 0_u8..8,
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
            let record = Record { time: Timestamp { nanos, nine_digits: nine }, interface: "vcan0", frame, direction: None };
            let line = record.to_string();
            prop_assert_eq!(parse(&line), Ok(Line::Frame(record)));
            prop_assert_eq!(parse_frame(&frame.to_string()), Ok(frame));
        }

        #[test]
        fn no_line_panics(line in "\\(?[0-9.)]{0,12} ?[a-z0-9 ]{0,8}[0-9A-F#R._ T]{0,40}") {
            let _ = parse(&line);
        }
    }
}
