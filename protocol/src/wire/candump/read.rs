//! A cursor over the bytes of a line, and the parser of each field.

use super::write::MAX_SECOND_DIGITS;
use super::{Direction, LineError, Timestamp};
use crate::can::{ERROR, EXTENDED, EXTENDED_MASK, Format, Frame, REMOTE, check_identifier};

/// The value of each byte as a hexadecimal digit; [`NOT_A_DIGIT`] for bytes that are not digits.
#[expect(clippy::indexing_slicing, reason = "when this is compiled")]
const HEX_DIGIT_VALUES: [u8; 256] = {
    let mut nibbles = [NOT_A_DIGIT; 256];
    let mut value = 0;
    while value < 16 {
        nibbles[b"0123456789ABCDEF"[value as usize] as usize] = value;
        nibbles[b"0123456789abcdef"[value as usize] as usize] = value;
        value += 1;
    }
    nibbles
};
const NOT_A_DIGIT: u8 = 0xFF;

/// Returns the value of a hexadecimal digit; [`NOT_A_DIGIT`] for any other byte.
#[expect(clippy::indexing_slicing, reason = "a byte is less than 256")]
#[inline]
pub(super) const fn hex_digit_value(digit: u8) -> u8 {
    HEX_DIGIT_VALUES[digit as usize]
}

fn parse_hex_digit(digit: u8) -> Option<u8> {
    Some(hex_digit_value(digit)).filter(|&value| value < 16)
}

/// Decodes eight hexadecimal digits to four bytes. Returns `None` if one of them is not a digit.
#[inline]
pub(super) const fn decode_eight_hex_digits(digits: [u8; 8]) -> Option<[u8; 4]> {
    /// Returns `byte` repeated eight times.
    const fn repeat_byte(byte: u8) -> u64 {
        u64::from_le_bytes([byte; 8])
    }
    let text = u64::from_le_bytes(digits);
    let letters = text & repeat_byte(0x40);
    // '1' is 31, 'A' is 41 and 'a' is 61: a letter's value is 9 more than its lower half.
    let values = (text & repeat_byte(0x0F)).wrapping_add((letters >> 6).wrapping_mul(9));
    // The upper half of a digit is 3, that of a letter 4 or 6; this maps 6 to 4.
    let segments =
        (text & repeat_byte(0xF0) & !(letters >> 1)) ^ (letters >> 2).wrapping_add(repeat_byte(0x30));
    // A value has 4 bits; that of a letter is 10 or more.
    let tens = (values.wrapping_add(repeat_byte(6)) ^ (letters >> 2)) & repeat_byte(0x10);
    if segments | values & repeat_byte(0xF0) | tens != 0 {
        return None;
    }
    // Combine neighbours into one, two, then four bytes.
    let bytes = (values << 4 | values >> 8) & 0x00FF_00FF_00FF_00FF;
    let twos = (bytes | bytes >> 8) & 0x0000_FFFF_0000_FFFF;
    let [a, b, c, d, ..] = (twos | twos >> 16).to_le_bytes();
    Some([a, b, c, d])
}

/// Returns the value of the decimal digits at the start of eight bytes, and their number.
#[inline]
pub(super) fn parse_leading_digits(text: [u8; 8]) -> (u64, usize) {
    const ASCII_ZEROS: u64 = 0x3030_3030_3030_3030;
    let text = u64::from_le_bytes(text);
    let digits = text ^ ASCII_ZEROS;
    // For a digit 0 to 9, neither the value nor the value plus 6 has a bit in the upper half.
    let others = (digits | digits.wrapping_add(0x0606_0606_0606_0606)) & 0xF0F0_F0F0_F0F0_F0F0;
    let bits = others.trailing_zeros() & !7;
    // Missing digits become leading zeros. Carries can only corrupt bytes after the first non-digit, which
    // are shifted out.
    let digits = digits.checked_shl(64 - bits).unwrap_or(0);
    // Combine neighbours: single digits, pairs, then groups of four.
    let digits = digits.wrapping_mul(10).wrapping_add(digits >> 8) & 0x00FF_00FF_00FF_00FF;
    let digits = digits.wrapping_mul(100).wrapping_add(digits >> 16) & 0x0000_FFFF_0000_FFFF;
    (digits.wrapping_mul(10_000).wrapping_add(digits >> 32) & 0xFFFF_FFFF, (bits >> 3) as usize)
}

/// Returns true if the text after an identifier of `digits` digits belongs to a CAN XL frame: `#81:00:12345678#` as
/// can-utils write it, or `###` as early drafts did.
fn is_can_xl(digits: usize, rest: &[u8]) -> bool {
    let is_header = |text: &[u8]| {
        text.iter().zip(b"#00:00:00000000#").all(|(byte, like)| match like {
            b'0' => byte.is_ascii_hexdigit(),
            _ => byte == like,
        })
    };
    let header = rest.get(..16).filter(|_| matches!(digits, 3 | 5 | 8));
    header.is_some_and(is_header) || digits == 5 && rest.starts_with(b"###")
}

pub(super) struct Cursor<'a> {
    text: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    pub(super) const fn new(text: &'a [u8], at: usize) -> Self {
        Self { text, at }
    }

    pub(super) const fn is_at_end(&self) -> bool {
        self.at >= self.text.len()
    }

    pub(super) const fn error(&self, expected: &'static str) -> LineError {
        LineError { column: self.at + 1, expected }
    }

    fn rest(&self) -> &'a [u8] {
        self.text.get(self.at..).unwrap_or_default()
    }

    fn peek(&self) -> Option<u8> {
        self.text.get(self.at).copied()
    }

    fn accept(&mut self, byte: u8) -> bool {
        let there = self.peek() == Some(byte);
        self.at += usize::from(there);
        there
    }

    pub(super) fn expect(&mut self, byte: u8, expected: &'static str) -> Result<(), LineError> {
        if self.accept(byte) { Ok(()) } else { Err(self.error(expected)) }
    }

    /// Skips spaces and tabs. Returns an error if there are none.
    pub(super) fn skip_blanks(&mut self) -> Result<(), LineError> {
        let blanks = self.rest().iter().take_while(|byte| is_blank(**byte)).count();
        self.at += blanks;
        if blanks == 0 { Err(self.error("a space")) } else { Ok(()) }
    }

    /// Reads the interface name up to the next space or tab.
    pub(super) fn parse_interface(&mut self) -> Result<&'a str, LineError> {
        let rest = self.rest();
        let len = rest.iter().position(|&byte| is_blank(byte)).unwrap_or(rest.len());
        let word = rest.get(..len).and_then(|word| core::str::from_utf8(word).ok());
        let word = word.filter(|word| !word.is_empty());
        let word = word.ok_or_else(|| self.error("the name of an interface"))?;
        self.at += len;
        Ok(word)
    }

    /// Reads decimal digits. Returns their value and their number.
    fn parse_digits(&mut self, expected: &'static str) -> Result<(u64, usize), LineError> {
        let start = self.at;
        let mut value = 0_u64;
        while let Some(digit @ b'0'..=b'9') = self.peek() {
            let next = value.checked_mul(10).and_then(|value| value.checked_add(u64::from(digit - b'0')));
            value = next.ok_or_else(|| self.error(expected))?;
            self.at += 1;
        }
        if self.at == start { Err(self.error(expected)) } else { Ok((value, self.at - start)) }
    }

    pub(super) fn parse_time(&mut self) -> Result<Timestamp, LineError> {
        let padded = self.peek() == Some(b'0');
        let (seconds, whole_digits) = self.parse_digits("seconds since 1970")?;
        let (nanos, digits) = if self.accept(b'.') { self.parse_fraction()? } else { (0, 0) };
        let whole = seconds.checked_mul(1_000_000_000).and_then(|whole| whole.checked_add(nanos));
        let nanos = whole.ok_or_else(|| self.error("a time before the year 2554"))?;
        let min_digits = if padded {
            u8::try_from(whole_digits).unwrap_or(MAX_SECOND_DIGITS).min(MAX_SECOND_DIGITS)
        } else {
            1
        };
        Ok(Timestamp { nanos, nine_digits: digits > 6, min_digits })
    }

    /// Reads the fraction of a second. Returns the nanoseconds and the number of digits.
    fn parse_fraction(&mut self) -> Result<(u64, usize), LineError> {
        let count = self.rest().iter().take_while(|byte| byte.is_ascii_digit()).count();
        let digits = self.rest().get(..count).unwrap_or_default();
        let (nanos, digits) = fraction_to_nanos(digits).ok_or_else(|| self.error("digits of a second"))?;
        self.at += count;
        Ok((nanos, digits))
    }

    /// Reads a frame. Returns `None` for a CAN XL frame, whose text is skipped.
    pub(super) fn parse_frame(&mut self) -> Result<Option<Frame>, LineError> {
        let expected = "an identifier of 3 or 8 hexadecimal digits";
        let start = self.at;
        let mut id = 0_u32;
        while let Some(digit) = self.peek().and_then(parse_hex_digit) {
            id = id.wrapping_shl(4) | u32::from(digit);
            self.at += 1;
        }
        let digits = self.at - start;
        if is_can_xl(digits, self.rest()) {
            self.at = self.text.len();
            return Ok(None);
        }
        self.expect(b'#', expected)?;
        let wrong = |expected| LineError { column: start + 1, expected };
        let id = match digits {
            3 => check_identifier(id, 0).map_err(|_| wrong("an 11-bit identifier, at most 7FF"))?,
            8 => raw_id_from_eight_digits(id),
            _ => return Err(wrong(expected)),
        };
        if self.accept(b'#') {
            let flags = self
                .peek()
                .and_then(parse_hex_digit)
                .ok_or_else(|| self.error("one hexadecimal digit of FD flags"))?;
            self.at += 1;
            // CAN FD has no remote frames.
            return self.parse_data_frame(id & !REMOTE, Format::Fd, flags).map(Some);
        }
        if matches!(self.peek(), Some(b'R' | b'r')) {
            self.at += 1;
            return self.parse_remote_frame(id).map(Some);
        }
        let column = self.at + 1;
        let frame = self.parse_data_frame(id & !REMOTE, Format::Classic, 0)?;
        if id & REMOTE == 0 {
            return Ok(Some(frame));
        }
        // The kernel's struct of a remote frame has a length and data bytes that carry no information.
        if frame.data().iter().any(|byte| *byte != 0) {
            return Err(LineError {
                column,
                expected: "no data, because the identifier has the flag of a remote frame",
            });
        }
        let remote = Frame::remote(id, frame.len()).map_err(|_| self.error("a length of 0 to 8"))?;
        Ok(Some(remote.with_raw_dlc(frame.raw_dlc())))
    }

    fn parse_remote_frame(&mut self, id: u32) -> Result<Frame, LineError> {
        let length = self.peek().and_then(parse_hex_digit);
        self.at += usize::from(length.is_some());
        let frame = Frame::remote(id, length.unwrap_or(0)).map_err(|_| self.error("a length of 0 to 8"))?;
        self.parse_raw_dlc(frame)
    }

    fn parse_data_frame(&mut self, id: u32, format: Format, flags: u8) -> Result<Frame, LineError> {
        let mut data = [0; 64];
        let mut len = 0;
        loop {
            self.accept(b'.');
            let Some(high) = self.peek().and_then(parse_hex_digit) else {
                break;
            };
            self.at += 1;
            let low = self
                .peek()
                .and_then(parse_hex_digit)
                .ok_or_else(|| self.error("the second digit of a byte"))?;
            self.at += 1;
            *data.get_mut(len).ok_or_else(|| self.error("at most 64 bytes"))? = high << 4 | low;
            len += 1;
        }
        let frame = Frame::with_buffer(id, format, flags, data, len);
        let frame = frame.map_err(|_| self.error("at most 8 bytes in a classic frame"))?;
        self.parse_raw_dlc(frame)
    }

    fn parse_raw_dlc(&mut self, frame: Frame) -> Result<Frame, LineError> {
        if !self.accept(b'_') {
            return Ok(frame);
        }
        match self.peek().and_then(parse_hex_digit) {
            Some(dlc @ 9..) if frame.len() == 8 && frame.format() == Format::Classic => {
                self.at += 1;
                Ok(frame.with_raw_dlc(dlc))
            }
            _ => Err(self.error("a raw DLC of 9 to F, which only a classic frame of 8 bytes can have")),
        }
    }

    /// Reads the direction after a frame, if any. Other words are ignored, but a further data byte is an error.
    pub(super) fn parse_direction(&mut self) -> Result<Option<Direction>, LineError> {
        if self.is_at_end() {
            return Ok(None);
        }
        self.skip_blanks()?;
        let rest = self.rest();
        let len = rest.iter().position(|&byte| is_blank(byte)).unwrap_or(rest.len());
        match rest.get(..len) {
            Some(b"T") => Ok(Some(Direction::Sent)),
            Some(b"R") => Ok(Some(Direction::Received)),
            Some([high, low]) if hex_digit_value(*high) < 16 && hex_digit_value(*low) < 16 => {
                Err(self.error("the end of the data: a byte follows a space"))
            }
            Some(_) | None => Ok(None),
        }
    }
}

/// Returns true for a byte that separates words.
pub(super) const fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t')
}

/// Converts the digits after the decimal point of a second to nanoseconds. Returns the nanoseconds and the number of
/// digits. Digits below a nanosecond are dropped. Returns `None` if `digits` is empty or contains other bytes.
#[must_use]
pub fn fraction_to_nanos(digits: &[u8]) -> Option<(u64, usize)> {
    if digits.is_empty() || !digits.iter().all(u8::is_ascii_digit) {
        return None;
    }
    let nine = digits.iter().chain(&[b'0'; 9]).take(9);
    Some((nine.fold(0, |nanos, digit| nanos * 10 + u64::from(digit - b'0')), digits.len()))
}

/// Converts an identifier of 8 hexadecimal digits to a raw identifier. The upper three bits are the kernel's flags. If
/// they are all 0, the identifier is extended, as in can-utils and python-can; an error frame is not marked as
/// extended.
#[must_use]
pub const fn raw_id_from_eight_digits(word: u32) -> u32 {
    let number = word & EXTENDED_MASK;
    if word & ERROR != 0 { number | ERROR } else { number | EXTENDED | word & REMOTE }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_byte_is_a_digit_or_none() {
        for byte in 0..=u8::MAX {
            let expected = char::from(byte).to_digit(16).and_then(|value| u8::try_from(value).ok());
            assert_eq!(parse_hex_digit(byte), expected);
        }
    }

    #[test]
    fn one_wrong_byte_among_eight_hexadecimal_digits_is_found() {
        for at in 0..8 {
            for byte in 0..=u8::MAX {
                let mut text = *b"9aF05BeD";
                text[at] = byte;
                let value = str::from_utf8(&text).ok().filter(|_| byte.is_ascii_hexdigit());
                let value = value.map(|text| u32::from_str_radix(text, 16).unwrap().to_be_bytes());
                assert_eq!(decode_eight_hex_digits(text), value, "{text:?}");
            }
        }
    }

    #[test]
    fn a_number_ends_before_the_first_byte_that_is_no_digit() {
        for at in 0..8 {
            for byte in 0..=u8::MAX {
                let mut text = *b"98765432";
                text[at] = byte;
                let count = if byte.is_ascii_digit() { 8 } else { at };
                let value = str::from_utf8(&text[..count]).unwrap().parse().unwrap_or(0);
                assert_eq!(parse_leading_digits(text), (value, count), "{text:?}");
            }
        }
    }

    proptest! {
        #[test]
        fn eight_digits_are_four_bytes(value: u32, upper: bool) {
            let text = if upper { format!("{value:08X}") } else { format!("{value:08x}") };
            prop_assert_eq!(decode_eight_hex_digits(*text.as_bytes().first_chunk().unwrap()), Some(value.to_be_bytes()));
        }

        #[test]
        fn eight_bytes_are_digits_or_none(text: [u8; 8]) {
            let digits = text.iter().all(u8::is_ascii_hexdigit);
            prop_assert_eq!(decode_eight_hex_digits(text).is_some(), digits);
        }

        #[test]
        fn any_bytes_are_the_number_they_begin_with(text: [u8; 8], digits in 0..=8_usize) {
            let mut text = text;
            for byte in &mut text[..digits] {
                *byte = b'0' + *byte % 10;
            }
            let count = text.iter().position(|byte| !byte.is_ascii_digit()).unwrap_or(8);
            let value = str::from_utf8(&text[..count]).unwrap().parse().unwrap_or(0);
            prop_assert_eq!(parse_leading_digits(text), (value, count));
        }
    }
}
