//! The fast path of the parser, for lines in the subset that all tools can read. Nearly all lines are in it.
//!
//! It accepts only this layout. The general parser handles all other lines, and would give the same result for these:
//!
//! ```text
//!   (1700000000.123456) vcan0 22C##5AABBCC
//!   0          11     18 20   3 or 8 digits, # or ## and flags, whole bytes, the end of the line
//! ```

use super::read::{decode_eight_hex_digits, hex_digit_value, is_blank, parse_leading_digits};
use super::{Record, Timestamp};
use crate::can::{EXTENDED, EXTENDED_MASK, Format, Frame, STANDARD_MASK};

/// Length in bytes of a time with 10 + 6 digits, its parentheses and the space after it.
const TIME_LEN: usize = 20;

/// Parses a line without its line ending. Returns `None` if the line has another layout, for the general parser.
#[inline(always)]
pub(super) fn parse_record(line: &[u8]) -> Option<Record<'_>> {
    let (time, rest) = line.split_first_chunk::<TIME_LEN>()?;
    let nanos = parse_nanos(time)?;
    let blank = rest.iter().position(|&byte| is_blank(byte))?;
    let (name, frame) = rest.split_at_checked(blank)?;
    let interface = core::str::from_utf8(name).ok().filter(|name| !name.is_empty())?;
    let frame = match frame {
        [_, a, b, c, b'#', rest @ ..] => {
            let [a, b, c] = [hex_digit_value(*a), hex_digit_value(*b), hex_digit_value(*c)];
            let id = u32::from(a) << 8 | u32::from(b) << 4 | u32::from(c);
            // `value` returns 0xFF for other bytes, so more than the low four bits would be set.
            if a | b | c > 0xF || id > STANDARD_MASK {
                return None;
            }
            parse_data(id, rest)?
        }
        [_, a, b, c, d, e, f, g, h, b'#', rest @ ..] => {
            let id = u32::from_be_bytes(decode_eight_hex_digits([*a, *b, *c, *d, *e, *f, *g, *h])?);
            if id > EXTENDED_MASK {
                return None;
            }
            parse_data(id | EXTENDED, rest)?
        }
        _ => return None,
    };
    let min_digits = if time.get(1) == Some(&b'0') { 10 } else { 1 };
    let time = Timestamp { min_digits, ..Timestamp::with_six_digits(nanos) };
    Some(Record { time, interface, frame, direction: None })
}

#[inline(always)]
fn parse_nanos(time: &[u8; TIME_LEN]) -> Option<u64> {
    let &[b'(', a, b, c, d, e, f, g, h, i, j, b'.', k, l, m, n, o, p, q @ b')', r @ b' '] = time else {
        return None;
    };
    let (high, eight) = parse_leading_digits([a, b, c, d, e, f, g, h]);
    let (i, j) = (i.wrapping_sub(b'0'), j.wrapping_sub(b'0'));
    let (micros, six) = parse_leading_digits([k, l, m, n, o, p, q, r]);
    if eight != 8 || i > 9 || j > 9 || six != 6 {
        return None;
    }
    let seconds = high * 100 + u64::from(i) * 10 + u64::from(j);
    Some(seconds * 1_000_000_000 + micros * 1_000)
}

/// Parses the data of a frame, from the byte after the first `#` to the end of the line.
#[inline(always)]
fn parse_data(id: u32, text: &[u8]) -> Option<Frame> {
    let (format, flags, digits) = match text {
        [b'#', flags, digits @ ..] => (Format::Fd, hex_digit_value(*flags), digits),
        digits => (Format::Classic, 0, digits),
    };
    let len = digits.len() / 2;
    if flags > 0xF || digits.len() % 2 != 0 || len > 64 {
        return None;
    }
    let mut data = [0; 64];
    let (fours, rest) = digits.as_chunks();
    // An iterator with `next` is faster here than `zip`.
    let mut places = data.as_chunks_mut().0.iter_mut();
    for four in fours {
        *places.next()? = decode_eight_hex_digits(*four)?;
    }
    if let [_, _, ..] = rest {
        let mut last = *b"00000000";
        last.get_mut(..rest.len())?.copy_from_slice(rest);
        *places.next()? = decode_eight_hex_digits(last)?;
    }
    Frame::with_buffer(id, format, flags, data, len).ok()
}

#[cfg(test)]
mod tests {
    use super::super::{CandumpLine, parse_any_variant};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_is_nearly_always_written_goes_the_short_way() {
        for line in [
            "(1700000000.123456) vcan0 123#",
            "(1700000000.123456) vcan0 7FF#1122334455667788",
            "(0000000000.000000) c 1FFFFFFF#01",
            "(1700000000.123456) vcan0 22C##5AABBCC",
            "(1700000000.123456) vcan0 1F334455##F",
        ] {
            let record = parse_record(line.as_bytes()).expect(line);
            assert_eq!(parse_any_variant(line.as_bytes()), Ok(CandumpLine::Frame(record)), "{line}");
        }
    }

    #[test]
    fn every_change_of_one_byte_is_read_as_the_long_way_reads_it() {
        let full = format!("(1700000000.123456) vcan0 22C##5{}", "A5".repeat(64));
        for line in
            ["(1700000000.123456) vcan0 123#1122334455", "(1700000000.123456) can0 1F334455#01", &full]
        {
            for at in 0..line.len() {
                for byte in 0..=u8::MAX {
                    let mut line = line.as_bytes().to_vec();
                    line[at] = byte;
                    agrees(&line);
                }
            }
            for end in 0..line.len() {
                agrees(&line.as_bytes()[..end]);
            }
            agrees(format!("{line}00").as_bytes());
        }
    }

    fn agrees(line: &[u8]) {
        if let Some(record) = parse_record(line) {
            assert_eq!(
                parse_any_variant(line),
                Ok(CandumpLine::Frame(record)),
                "{:?}",
                String::from_utf8_lossy(line)
            );
        }
    }

    proptest! {
        #[test]
        fn whatever_it_reads_the_long_way_reads_too(
            line in "\\([0-9]{10}\\.[0-9]{6}\\) [a-z ]{0,5}[0-9]? ([0-9A-Fa-f]{3}|[0-9A-F]{8})##?[0-9A-Fa-f]{0,20}[ TR_.]{0,2}"
        ) {
            agrees(line.as_bytes());
        }
    }
}
