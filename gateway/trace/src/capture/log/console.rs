//! Parser of single lines of candump's console output.
//!
//! ```text
//!    can0  123   [8]  11 22 33 44 55 66 77 88   '."3DUfw.'        -a: as characters too
//!    (1700000000.123456)  can0  1F334455   [2]  11 22             -t a; z and d (000.001234), A a date
//!    can0  TX B -  123  [12]  11 22 33 44 55 66 77 88 99 AA BB CC -x: direction, flags; two digits: FD
//!    can0  123   [3]  33`22`11                                    -S: the last byte first
//!    can0  123   [2]  00010001 00100010                           -i
//!    can0  123   {C}  11 22 33 44 55 66 77 88                     -8: the DLC
//!    can0  5A1   [4]  remote request
//!    can0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME
//!    can0  123 [0003] (00|81:03:DEADBEEF) 11 22 33                CAN XL
//!    (2023-11-14 22:13:20.123456) can0 123#1122                   a log with dates
//! ```
//!
//! Colours (`-c`) may stand between words. Any text may stand before a frame, such as a prompt, and any text except a
//! further byte after its data.

use protocol::can::{BIT_RATE_SWITCH, ERROR_STATE, Frame, REMOTE, check_identifier};
use protocol::candump::{self, Direction, LineError, Timestamp, raw_id_from_eight_digits};

/// A frame parsed from a line, with the information whether the line showed its flags.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ConsoleFrame<'a> {
    pub(super) stamp: LineTime,
    pub(super) interface: &'a str,
    pub(super) frame: Frame,
    pub(super) direction: Option<Direction>,
    /// True if the line shows the flags of an FD frame, or if the frame is a classic one, which has no flags.
    pub(super) has_flags: bool,
}

/// The time of a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum LineTime {
    /// The line has no time.
    None,
    /// The time since 1970.
    Absolute(Timestamp),
    /// A date and a time of day in an unknown time zone, read as UTC.
    Local(Timestamp),
    /// The time since the first frame, or since the one before.
    Relative(Timestamp),
}

/// A line of candump's console output that was recognised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum ConsoleLine<'a> {
    Frame(ConsoleFrame<'a>),
    CanXl,
}

/// Parses one line, given without its line end. Returns `None` if the line does not consist of a bus name, an
/// identifier and a length, as console output does. Never panics.
///
/// # Errors
/// Returns [`LineError`] if the line begins like console output, but the text after the length is not a frame.
pub(super) fn parse(line: &[u8]) -> Option<Result<ConsoleLine<'_>, LineError>> {
    let text = line.trim_ascii_end();
    memchr::memchr3(b'[', b'{', b'#', text)?;
    let mut cursor = Cursor { text, at: 0 };
    cursor.skip_quotes();
    if matches!(cursor.remaining_text().first(), Some(b'#' | b';' | b'/')) {
        return None;
    }
    let first = cursor.parse_line();
    if first.is_some() || cursor.remaining_text().starts_with(b"(") {
        return first;
    }
    // Text before the frame may be a prompt. A malformed frame after such text is not an error, because the line may be
    // anything.
    while !cursor.take_word().is_empty() {
        cursor.skip_blanks();
        if let Some(Ok(frame)) = cursor.parse_line() {
            return Some(Ok(frame));
        }
    }
    None
}

/// The length that a line prints in brackets.
#[derive(Clone, Copy)]
enum PrintedLength {
    Classic(u8),
    /// The DLC of a classic frame.
    Dlc(u8),
    Fd(u8),
    CanXl,
}

fn parse_identifier(digits: &[u8]) -> Option<u32> {
    let id = u32::from_str_radix(core::str::from_utf8(digits).ok()?, 16).ok()?;
    match digits.len() {
        3 => check_identifier(id, 0).ok(),
        // The text after the length shows whether the frame is remote.
        _ => Some(raw_id_from_eight_digits(id) & !REMOTE),
    }
}

#[derive(Clone, Copy)]
struct Cursor<'a> {
    text: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    /// Parses a line from the position of the cursor on. Blanks are skipped first.
    fn parse_line(mut self) -> Option<Result<ConsoleLine<'a>, LineError>> {
        let stamp = if self.accept_byte(b'(') { self.parse_timestamp()? } else { LineTime::None };
        self.skip_blanks();
        let interface = core::str::from_utf8(self.take_word()).ok().filter(|name| !name.is_empty())?;
        self.skip_blanks();
        let marks = self.parse_direction_and_flags();
        self.skip_blanks();
        let id_at = self.at;
        let id = self.take_word();
        if let (LineTime::Local(_), None) = (stamp, marks) {
            // The line is from a log whose times are dates.
            let frame = id.contains(&b'#').then(|| core::str::from_utf8(id).ok()).flatten();
            if let Some(frame) = frame.and_then(|text| candump::parse_frame(text).ok()) {
                let seen =
                    ConsoleFrame { stamp, interface, frame, direction: self.direction(), has_flags: true };
                return Some(Ok(ConsoleLine::Frame(seen)));
            }
        }
        if !matches!(id.len(), 3 | 8) || !id.iter().all(u8::is_ascii_hexdigit) || !self.skip_blanks() {
            return None;
        }
        let length = self.length()?;
        if let PrintedLength::CanXl = length {
            return Some(Ok(ConsoleLine::CanXl));
        }
        let (direction, flags) = marks.map_or((None, None), |(direction, flags)| (Some(direction), flags));
        let has_flags = flags.is_some() || !matches!(length, PrintedLength::Fd(_));
        let expected = "an identifier, at most 7FF in 3 digits";
        let frame = parse_identifier(id).ok_or(LineError { column: id_at + 1, expected });
        let frame = frame.and_then(|id| self.frame(id, length, flags.unwrap_or(0)));
        if self.is_isotpsniffer_output(frame.is_ok()) {
            return None;
        }
        Some(
            frame.map(|frame| {
                ConsoleLine::Frame(ConsoleFrame { stamp, interface, frame, direction, has_flags })
            }),
        )
    }

    /// Parses the direction (`T` or `R`) after a frame in a log.
    fn direction(&mut self) -> Option<Direction> {
        self.skip_blanks();
        match self.take_word() {
            b"T" => Some(Direction::Sent),
            b"R" => Some(Direction::Received),
            _ => None,
        }
    }

    /// Returns true if a dash and a quoted text follow the data. isotpsniffer prints messages this way, which it has
    /// joined from several frames.
    fn is_isotpsniffer_output(&self, has_frame: bool) -> bool {
        if has_frame {
            self.remaining_text().starts_with(b"- '")
        } else {
            memchr::memmem::find(self.text, b"  - '").is_some()
        }
    }

    fn remaining_text(&self) -> &'a [u8] {
        self.text.get(self.at..).unwrap_or_default()
    }

    fn accept_byte(&mut self, byte: u8) -> bool {
        let there = self.remaining_text().first() == Some(&byte);
        self.at += usize::from(there);
        there
    }

    const fn expected_error(&self, expected: &'static str) -> LineError {
        LineError { column: self.at + 1, expected }
    }

    /// Skips blanks and colours. Returns true if there were any.
    fn skip_blanks(&mut self) -> bool {
        let from = self.at;
        loop {
            match self.remaining_text() {
                [b' ' | b'\t', ..] => self.at += 1,
                [0x1B, b'[', rest @ ..] => {
                    let parameters = rest.iter().take_while(|byte| matches!(byte, 0x20..=0x3F)).count();
                    self.at += 3 + parameters;
                }
                _ => return self.at > from,
            }
        }
    }

    /// Skips blanks, colours, and the quotation marks of mails and issues.
    fn skip_quotes(&mut self) {
        while self.skip_blanks() || self.accept_byte(b'>') || self.accept_byte(b'|') {}
    }

    /// Returns the text up to the next blank or colour.
    fn take_word(&mut self) -> &'a [u8] {
        self.take_while(|byte| !matches!(byte, b' ' | b'\t' | 0x1B))
    }

    /// Returns the longest run of bytes from the cursor on that match `is`.
    fn take_while(&mut self, is: impl Fn(u8) -> bool) -> &'a [u8] {
        let rest = self.remaining_text();
        let len = rest.iter().take_while(|&&byte| is(byte)).count();
        self.at += len;
        rest.get(..len).unwrap_or_default()
    }

    /// Returns a decimal number and the count of its digits.
    fn number(&mut self) -> Option<(u64, usize)> {
        let digits = self.take_while(|byte| byte.is_ascii_digit());
        Some((core::str::from_utf8(digits).ok()?.parse().ok()?, digits.len()))
    }

    /// Parses the time in parentheses before the bus name, up to and including the closing parenthesis.
    fn parse_timestamp(&mut self) -> Option<LineTime> {
        let is_padded = self.remaining_text().first() == Some(&b'0');
        let (number, digits) = self.number()?;
        let is_date = self.accept_byte(b'-');
        let seconds = if is_date { self.parse_date(number)? } else { number };
        let fraction = self.accept_byte(b'.').then(|| self.take_while(|byte| byte.is_ascii_digit()))?;
        let (fraction, fraction_digits) = candump::fraction_to_nanos(fraction)?;
        let nanos = seconds.checked_mul(1_000_000_000)?.checked_add(fraction)?;
        let time = Timestamp { nine_digits: fraction_digits > 6, ..Timestamp::with_six_digits(nanos) };
        self.accept_byte(b')').then_some(())?;
        Some(match digits {
            _ if is_date => LineTime::Local(time),
            10.. => LineTime::Absolute(Timestamp { min_digits: if is_padded { 10 } else { 1 }, ..time }),
            _ => LineTime::Relative(time),
        })
    }

    /// Parses the rest of `2026-11-24 03:55:42` after the year. Returns seconds since 1970.
    fn parse_date(&mut self, year: u64) -> Option<u64> {
        let mut two_digits = |end: Option<u8>| {
            let (number, digits) = self.number()?;
            (digits == 2 && end.is_none_or(|end| self.accept_byte(end))).then_some(number)
        };
        let (month, day) = (two_digits(Some(b'-'))?, two_digits(Some(b' '))?);
        let (hour, minute, second) = (two_digits(Some(b':'))?, two_digits(Some(b':'))?, two_digits(None)?);
        let is_date = (1970..2554).contains(&year) && (1..=12).contains(&month) && (1..=31).contains(&day);
        (is_date && hour < 24 && minute < 60 && second <= 60)
            .then(|| ((days_since_1970(year, month, day) * 24 + hour) * 60 + minute) * 60 + second)
    }

    /// Parses the output of `-x`: the direction, and the flags of an FD frame, which may be missing.
    fn parse_direction_and_flags(&mut self) -> Option<(Direction, Option<u8>)> {
        let mut cursor = *self;
        let direction = match cursor.take_word() {
            b"TX" => Direction::Sent,
            b"RX" => Direction::Received,
            _ => return None,
        };
        self.at = cursor.at;
        let mut flags = 0;
        for (letters, flag) in [(b"BS", BIT_RATE_SWITCH), (b"ER", ERROR_STATE)] {
            cursor.skip_blanks();
            match cursor.take_word() {
                b"-" => {}
                [letter] if letters.contains(letter) => flags |= flag,
                _ => return Some((direction, None)),
            }
        }
        self.at = cursor.at;
        Some((direction, Some(flags)))
    }

    fn length(&mut self) -> Option<PrintedLength> {
        let is_dlc = self.accept_byte(b'{');
        if is_dlc {
            let digit = self.take_while(|byte| byte.is_ascii_hexdigit());
            let [digit] = digit else { return None };
            let dlc = char::from(*digit).to_digit(16).and_then(|dlc| u8::try_from(dlc).ok())?;
            return self.accept_byte(b'}').then_some(PrintedLength::Dlc(dlc));
        }
        let (number, digits) = self.accept_byte(b'[').then(|| self.number())??;
        self.accept_byte(b']').then_some(())?;
        let len = u8::try_from(number).unwrap_or(u8::MAX);
        match digits {
            1 => Some(PrintedLength::Classic(len)),
            2 => Some(PrintedLength::Fd(len)),
            4 => Some(PrintedLength::CanXl),
            _ => None,
        }
    }

    fn frame(&mut self, id: u32, length: PrintedLength, flags: u8) -> Result<Frame, LineError> {
        let wrong = self.expected_error("a length of at most 8 bytes, or 64 in two digits");
        let len = match length {
            PrintedLength::Dlc(dlc) => dlc.min(8),
            PrintedLength::Classic(len) | PrintedLength::Fd(len) => len,
            PrintedLength::CanXl => 0,
        };
        self.skip_blanks();
        let made = if self.remaining_text().starts_with(b"remote request") {
            Frame::remote(id, len)
        } else {
            let data = self.data(usize::from(len), wrong)?;
            let data = data.get(..usize::from(len)).unwrap_or_default();
            match length {
                PrintedLength::Fd(_) => Frame::fd(id, flags, data),
                PrintedLength::Classic(_) | PrintedLength::Dlc(_) | PrintedLength::CanXl => {
                    Frame::classic(id, data)
                }
            }
        };
        let frame = made.map_err(|_| wrong)?;
        Ok(match length {
            PrintedLength::Dlc(dlc @ 9..) => frame.with_raw_dlc(dlc),
            PrintedLength::Dlc(_)
            | PrintedLength::Classic(_)
            | PrintedLength::Fd(_)
            | PrintedLength::CanXl => frame,
        })
    }

    /// Parses exactly `len` bytes in hexadecimal or binary digits. Returns the error `too_long` if `len` exceeds 64.
    fn data(&mut self, len: usize, too_long: LineError) -> Result<[u8; 64], LineError> {
        let mut data = [0; 64];
        let mut is_swapped = false;
        for place in data.get_mut(..len).ok_or(too_long)? {
            let swap = self.accept_byte(b'`');
            is_swapped |= swap;
            if !swap {
                self.skip_blanks();
            }
            let missing = self.expected_error("a data byte, because there are fewer than the length states");
            let digits = self.take_while(|byte| byte.is_ascii_hexdigit());
            *place = byte(digits).ok_or(missing)?;
        }
        if is_swapped && let Some(data) = data.get_mut(..len) {
            data.reverse();
        }
        let from = self.at;
        self.skip_blanks();
        let further = LineError {
            column: self.at + 1,
            expected: "the end of the data, because there are more bytes than the length states",
        };
        let is_near = self.at <= from + 1;
        if is_near && byte(Self { ..*self }.take_word()).is_some() { Err(further) } else { Ok(data) }
    }
}

/// Parses a byte of two hexadecimal or eight binary digits.
fn byte(digits: &[u8]) -> Option<u8> {
    let base = match digits.len() {
        2 => 16,
        8 => 2,
        _ => return None,
    };
    let digits = core::str::from_utf8(digits).ok().filter(|digits| !digits.starts_with('+'))?;
    u8::from_str_radix(digits, base).ok()
}

/// Returns the days from 1970-01-01 to a day of the Gregorian calendar, for years from 1970 on.
const fn days_since_1970(year: u64, month: u64, day: u64) -> u64 {
    // Years begin in March here, so that a leap day is the last day of its year.
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let of_years = year * 365 + year / 4 - year / 100 + year / 400;
    // The constant is the day count of 1970-01-01 in this calendar.
    of_years + (153 * month + 2) / 5 + day - 1 - 719_468
}
