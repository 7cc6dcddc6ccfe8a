//! The writer of frames and records. It formats a line in a buffer on the stack, so that the output is called only a
//! few times per line.

use core::fmt::{self, Write};

use super::Record;
use crate::can::{ERROR, EXTENDED_MASK, Format, Frame};

/// The two hexadecimal digits of each byte.
#[expect(clippy::indexing_slicing, reason = "when this is compiled")]
const HEX_DIGIT_PAIRS: [[u8; 2]; 256] = {
    let digits = *b"0123456789ABCDEF";
    let mut pairs = [[0; 2]; 256];
    let mut at = 0;
    while at < 256 {
        pairs[at] = [digits[at >> 4], digits[at & 0xF]];
        at += 1;
    }
    pairs
};

/// Maximum length in bytes of a frame: 8 digits of an identifier, `##`, flags, 64 data bytes and a raw DLC.
const MAX_FRAME_LEN: usize = 8 + 2 + 1 + 128 + 2;
/// Maximum number of digits to which seconds are padded.
pub(super) const MAX_SECOND_DIGITS: u8 = 20;
/// Maximum length in bytes of a time: two parentheses, digits of seconds, a point, 9 digits and a space.
const MAX_TIME_LEN: usize = 2 + MAX_SECOND_DIGITS as usize + 1 + 9 + 1;

/// Writes one record without a line ending, with single spaces, in upper case and without the direction.
///
/// # Errors
/// Returns an error if writing to `out` fails.
pub fn write_record(out: &mut impl Write, record: &Record<'_>) -> fmt::Result {
    let mut time = TextBuffer::<MAX_TIME_LEN>::new();
    let (seconds, nanos) = (record.time.nanos / 1_000_000_000, record.time.nanos % 1_000_000_000);
    time.push(b'(');
    time.push_decimal(seconds, usize::from(record.time.min_digits.clamp(1, MAX_SECOND_DIGITS)));
    time.push(b'.');
    if record.time.nine_digits {
        time.push_decimal(nanos, 9);
    } else {
        time.push_decimal(nanos / 1_000, 6);
    }
    time.push(b')');
    time.push(b' ');
    out.write_str(time.as_str())?;
    out.write_str(record.interface)?;
    out.write_char(' ')?;
    write_frame(out, &record.frame)
}

/// Writes a frame without time and interface, in the notation of cansend.
///
/// # Errors
/// Returns an error if writing to `out` fails.
pub fn write_frame(out: &mut impl Write, frame: &Frame) -> fmt::Result {
    let mut text = TextBuffer::<MAX_FRAME_LEN>::new();
    if frame.is_error() || frame.is_extended() {
        let id = if frame.is_error() { frame.raw_id() & (ERROR | EXTENDED_MASK) } else { frame.id() };
        for byte in id.to_be_bytes() {
            text.push_byte(byte);
        }
    } else {
        let [.., high, low] = frame.id().to_be_bytes();
        text.push_digit(high);
        text.push_byte(low);
    }
    text.push(b'#');
    match frame.format() {
        Format::Classic if frame.is_remote() => {
            text.push(b'R');
            if !frame.is_empty() {
                text.push_digit(frame.len());
            }
        }
        Format::Classic => {}
        Format::Fd => {
            text.push(b'#');
            text.push_digit(frame.flags());
        }
    }
    for &byte in frame.data() {
        text.push_byte(byte);
    }
    if frame.raw_dlc() != 0 {
        text.push(b'_');
        text.push_digit(frame.raw_dlc());
    }
    out.write_str(text.as_str())
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_frame(f, self)
    }
}

/// An ASCII buffer of at most `N` bytes.
struct TextBuffer<const N: usize> {
    bytes: [u8; N],
    len: usize,
}

impl<const N: usize> TextBuffer<N> {
    const fn new() -> Self {
        Self { bytes: [0; N], len: 0 }
    }

    fn push(&mut self, byte: u8) {
        if let Some(place) = self.bytes.get_mut(self.len) {
            *place = byte;
            self.len += 1;
        }
    }

    /// Appends the lower four bits of a value as a hexadecimal digit.
    fn push_digit(&mut self, value: u8) {
        let [_, digit] = hex_digits(value);
        self.push(digit);
    }

    /// Appends a byte as two hexadecimal digits.
    fn push_byte(&mut self, value: u8) {
        if let Some(place) = self.bytes.get_mut(self.len..).and_then(<[u8]>::first_chunk_mut) {
            *place = hex_digits(value);
            self.len += 2;
        }
    }

    /// Appends a number with at least `min` decimal digits.
    fn push_decimal(&mut self, value: u64, min: usize) {
        let mut digits = [b'0'; 20];
        let (mut rest, mut from) = (value, digits.len());
        for digit in digits.iter_mut().rev() {
            if rest == 0 {
                break;
            }
            *digit += u8::try_from(rest % 10).unwrap_or(0);
            rest /= 10;
            from -= 1;
        }
        for &digit in digits.get(from.min(digits.len() - min)..).unwrap_or_default() {
            self.push(digit);
        }
    }

    fn as_str(&self) -> &str {
        let text = self.bytes.get(..self.len).and_then(|text| core::str::from_utf8(text).ok());
        text.expect("ASCII that fits")
    }
}

fn hex_digits(value: u8) -> [u8; 2] {
    HEX_DIGIT_PAIRS.get(usize::from(value)).copied().unwrap_or_default()
}
