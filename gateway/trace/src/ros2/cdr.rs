//! CDR, the encoding of ROS 2 messages: little endian, each number aligned to its size.
//!
//! ```text
//!   byte  0    1    2    3    4 ...
//!         00   01   00   00   fields; alignment is counted from byte 4
//!         text: u32 length with the NUL, bytes, NUL        sequence: u32 count, elements
//! ```

use protocol::can::IdentifierError;
use thiserror::Error;

/// The encapsulation header: "plain CDR, little endian", and two option bytes.
const CDR_HEADER: [u8; 4] = [0, 1, 0, 0];
/// The maximum number of elements in a decoded sequence.
const MAX_SEQUENCE_ELEMENTS: u32 = 64;

/// A value that can be encoded as a field of a message.
pub trait Encode {
    /// Appends the value to the message.
    fn encode(&self, out: &mut CdrWriter<'_>);
}

/// A value that can be decoded from a field of a message. Texts are borrowed from the message.
pub trait Decode<'a>: Sized {
    /// Decodes the value at the reader's position. Never panics.
    ///
    /// # Errors
    /// Returns [`CdrError`] if the message ends too early or holds an invalid value.
    fn decode(from: &mut CdrReader<'a>) -> Result<Self, CdrError>;
}

macro_rules! numbers {
    ($($number:ty: $what:literal),+) => {$(
        impl Encode for $number {
            fn encode(&self, out: &mut CdrWriter<'_>) {
                out.put_number(self.to_le_bytes());
            }
        }

        impl Decode<'_> for $number {
            fn decode(from: &mut CdrReader<'_>) -> Result<Self, CdrError> {
                from.read_number($what).map(Self::from_le_bytes)
            }
        }
    )+};
}
numbers!(
    u8: "a byte",
    u16: "a number",
    u32: "a number",
    i32: "a number",
    u64: "a number",
    f32: "a number",
    f64: "a number"
);

impl Encode for bool {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(u8::from(*self));
    }
}

impl Decode<'_> for bool {
    fn decode(from: &mut CdrReader<'_>) -> Result<Self, CdrError> {
        Ok(from.get::<u8>()? != 0)
    }
}

impl Encode for str {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put_count(self.len() + 1);
        out.out.extend_from_slice(self.as_bytes());
        out.out.push(0);
    }
}

impl<'a> Decode<'a> for &'a str {
    fn decode(from: &mut CdrReader<'a>) -> Result<Self, CdrError> {
        let bytes = from.get_bytes()?;
        let wrong = CdrError::Text { at: from.at - bytes.len() };
        let text = match bytes {
            _ if from.form == CdrEncoding::Ros1 => bytes,
            // Some programs write an empty text without its NUL.
            [] => bytes,
            [text @ .., 0] => text,
            _ => return Err(wrong),
        };
        str::from_utf8(text).map_err(|_| wrong)
    }
}

/// Decodes a sequence of at most `LONGEST` elements.
impl<'a, T: Decode<'a>> Decode<'a> for Vec<T> {
    fn decode(from: &mut CdrReader<'a>) -> Result<Self, CdrError> {
        let count = from.get::<u32>()?;
        if count > MAX_SEQUENCE_ELEMENTS {
            return Err(CdrError::Value { what: "a count", got: count.into(), allowed: "0 to 64" });
        }
        (0..count).map(|_| from.get()).collect()
    }
}

/// Decodes an array of N elements, which is stored without a count.
impl<'a, T: Decode<'a> + Copy + Default, const N: usize> Decode<'a> for [T; N] {
    fn decode(from: &mut CdrReader<'a>) -> Result<Self, CdrError> {
        let mut all = [T::default(); N];
        for one in &mut all {
            *one = from.get()?;
        }
        Ok(all)
    }
}

impl<A: Encode, B: Encode> Encode for (A, B) {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(&self.0);
        out.put(&self.1);
    }
}

impl<T: Encode + ?Sized> Encode for &T {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        (**self).encode(out);
    }
}

/// Writes a message into a buffer that can be reused.
#[derive(Debug)]
pub struct CdrWriter<'a> {
    out: &'a mut Vec<u8>,
}

impl<'a> CdrWriter<'a> {
    /// Begins a message in the buffer, whose former contents are removed.
    pub fn new(out: &'a mut Vec<u8>) -> Self {
        out.clear();
        out.extend_from_slice(&CDR_HEADER);
        Self { out }
    }

    /// Appends a number, a text, or another field.
    pub fn put(&mut self, value: impl Encode) {
        value.encode(self);
    }

    /// Appends the count of a sequence, whose elements the caller appends afterwards.
    ///
    /// # Panics
    /// Panics if there are more than 2^32 - 1 elements, which no message of skinbus has.
    pub fn put_count(&mut self, count: usize) {
        self.put(u32::try_from(count).expect("a message has fewer than 2^32 elements"));
    }

    /// Appends a sequence of bytes.
    pub fn put_bytes(&mut self, bytes: &[u8]) {
        self.put_count(bytes.len());
        self.out.extend_from_slice(bytes);
    }

    /// Appends a sequence of elements.
    pub fn put_sequence(&mut self, elements: impl ExactSizeIterator<Item = impl Encode>) {
        self.put_count(elements.len());
        elements.for_each(|element| self.put(element));
    }

    /// Appends a number after the padding that aligns it.
    fn put_number<const N: usize>(&mut self, bytes: [u8; N]) {
        let over = (self.out.len() - CDR_HEADER.len()) % N;
        if over != 0 {
            self.out.resize(self.out.len() + N - over, 0);
        }
        self.out.extend_from_slice(&bytes);
    }
}

/// An error in the bytes of a message.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum CdrError {
    /// The encoding is not supported.
    #[error("a message begins with {got:02x?}, not with 00 01: only little-endian CDR is read")]
    Encoding {
        /// The first two bytes of the message, which name the encoding; 0 if they are missing.
        got: [u8; 2],
    },
    /// The message ends too early.
    #[error("a message ends at byte {at} in the middle of {what}")]
    Short {
        /// The length of the message in bytes.
        at: usize,
        /// The kind of field that is incomplete.
        what: &'static str,
    },
    /// A text is not UTF-8, or does not end with a NUL.
    #[error("the text at byte {at} of a message is not UTF-8, or has no final NUL")]
    Text {
        /// The offset of the text in the message.
        at: usize,
    },
    /// The value of a field is not allowed.
    #[error("{what} of a message is {got}; allowed: {allowed}")]
    Value {
        /// The name of the field.
        what: &'static str,
        /// The value.
        got: u64,
        /// The allowed values.
        allowed: &'static str,
    },
    /// An identifier has more bits than its kind of frame allows.
    #[error("id of a message: {0}")]
    Identifier(#[from] IdentifierError),
    /// A time is out of range.
    #[error(
        "the time of a message is {sec} s and {nanosec} ns: seconds must not be negative, and nanoseconds must be \
         from 0 to 999999999"
    )]
    Time {
        /// Seconds since 1970.
        sec: i64,
        /// Nanoseconds.
        nanosec: u32,
    },
}

/// The encoding in which a message is stored.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum CdrEncoding {
    /// The encoding of ROS 2.
    Cdr,
    /// The encoding of ROS 1: without a header and padding, and texts without a NUL.
    Ros1,
}

/// Decodes the fields of a message in order. Texts and bytes are borrowed from the message. Never panics.
#[derive(Clone, Debug)]
pub struct CdrReader<'a> {
    bytes: &'a [u8],
    at: usize,
    form: CdrEncoding,
}

impl<'a> CdrReader<'a> {
    /// Begins at the first field of a message.
    ///
    /// # Errors
    /// Returns [`CdrError::Encoding`] if the message is not little-endian CDR.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        match bytes {
            [0, 1, _, _, ..] => Ok(Self { bytes, at: CDR_HEADER.len(), form: CdrEncoding::Cdr }),
            [first, second, ..] => Err(CdrError::Encoding { got: [*first, *second] }),
            _ => Err(CdrError::Encoding { got: [0; 2] }),
        }
    }

    /// Begins at the first field of a ROS 1 message.
    #[must_use]
    pub const fn from_ros1(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, form: CdrEncoding::Ros1 }
    }

    /// Decodes a number, a text, or another part of a message.
    ///
    /// # Errors
    /// Returns [`CdrError`] if the message ends too early or holds an invalid value.
    pub fn get<T: Decode<'a>>(&mut self) -> Result<T, CdrError> {
        T::decode(self)
    }

    /// Decodes a sequence of bytes.
    ///
    /// # Errors
    /// Returns [`CdrError::Short`] if the message ends too early.
    pub fn get_bytes(&mut self) -> Result<&'a [u8], CdrError> {
        let count = self.get::<u32>()?;
        self.read_bytes(usize::try_from(count).unwrap_or(usize::MAX), "a sequence of bytes")
    }

    fn read_number<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], CdrError> {
        let over = match self.form {
            CdrEncoding::Cdr => (self.at - CDR_HEADER.len()) % N,
            CdrEncoding::Ros1 => 0,
        };
        if over != 0 {
            self.at += N - over;
        }
        let &bytes =
            self.read_bytes(N, what)?.first_chunk().ok_or(CdrError::Short { at: self.bytes.len(), what })?;
        Ok(bytes)
    }

    fn read_bytes(&mut self, count: usize, what: &'static str) -> Result<&'a [u8], CdrError> {
        let end = self.at.saturating_add(count);
        let taken = self.bytes.get(self.at..end).ok_or(CdrError::Short { at: self.bytes.len(), what })?;
        self.at = end;
        Ok(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use byteorder::LittleEndian;
    use proptest::prelude::*;
    use serde::{Deserialize, Serialize};

    /// A message with one field of every kind, encoded in this order.
    #[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
    struct Everything {
        byte: u8,
        wide: f64,
        truth: bool,
        short: u16,
        text: String,
        signed: i32,
        bytes: Vec<u8>,
        long: u64,
        singles: Vec<f32>,
        doubles: Vec<f64>,
        texts: Vec<String>,
        last: u32,
    }

    fn everything() -> impl Strategy<Value = Everything> {
        let text = || "[a-z0-9 µ]{0,9}";
        let singles = proptest::collection::vec(-1e9..1e9_f32, 0..4);
        let doubles = proptest::collection::vec(-1e9..1e9_f64, 0..4);
        let texts = proptest::collection::vec(text(), 0..4);
        let bytes = proptest::collection::vec(any::<u8>(), 0..9);
        let numbers = (any::<u8>(), -1e9..1e9_f64, any::<bool>(), any::<u16>(), any::<i32>());
        let rest = (any::<u64>(), any::<u32>(), text(), bytes, singles, doubles, texts);
        (numbers, rest).prop_map(|((byte, wide, truth, short, signed), rest)| {
            let (long, last, text, bytes, singles, doubles, texts) = rest;
            Everything { byte, wide, truth, short, text, signed, bytes, long, singles, doubles, texts, last }
        })
    }

    fn ours(value: &Everything) -> Vec<u8> {
        let mut buffer = b"what was there before".to_vec();
        let mut out = CdrWriter::new(&mut buffer);
        out.put(value.byte);
        out.put(value.wide);
        out.put(value.truth);
        out.put(value.short);
        out.put(value.text.as_str());
        out.put(value.signed);
        out.put_bytes(&value.bytes);
        out.put(value.long);
        out.put_sequence(value.singles.iter());
        out.put_sequence(value.doubles.iter());
        out.put_sequence(value.texts.iter().map(String::as_str));
        out.put(value.last);
        buffer
    }

    fn read(bytes: &[u8]) -> Result<Everything, CdrError> {
        let mut from = CdrReader::new(bytes)?;
        Ok(Everything {
            byte: from.get()?,
            wide: from.get()?,
            truth: from.get()?,
            short: from.get()?,
            text: from.get::<&str>()?.to_owned(),
            signed: from.get()?,
            bytes: from.get_bytes()?.to_vec(),
            long: from.get()?,
            singles: from.get()?,
            doubles: from.get()?,
            texts: from.get::<Vec<&str>>()?.into_iter().map(str::to_owned).collect(),
            last: from.get()?,
        })
    }

    #[test]
    fn numbers_stand_at_multiples_of_their_size_counted_from_byte_4() {
        let mut buffer = Vec::new();
        let mut out = CdrWriter::new(&mut buffer);
        out.put("ab");
        out.put(1_u64);
        assert_eq!(
            buffer,
            [0, 1, 0, 0, 3, 0, 0, 0, b'a', b'b', 0, 0, 1, 0, 0, 0, 0, 0, 0, 0],
            "7 bytes and one that fills"
        );
    }

    #[test]
    fn what_is_no_message_is_said() {
        let wrong = |bytes: &[u8]| CdrReader::new(bytes).map(|_| ()).unwrap_err().to_string();
        assert_eq!(
            wrong(&[0, 0, 0, 0]),
            "a message begins with [00, 00], not with 00 01: only little-endian CDR is read"
        );
        assert_eq!(CdrReader::new(&[]).unwrap_err(), CdrError::Encoding { got: [0; 2] });
        let mut short = CdrReader::new(&[0, 1, 0, 0, 9, 0, 0, 0, 1]).unwrap();
        assert_eq!(
            short.get_bytes().unwrap_err().to_string(),
            "a message ends at byte 9 in the middle of a sequence of bytes"
        );
        let mut text = CdrReader::new(&[0, 1, 0, 0, 1, 0, 0, 0, b'a']).unwrap();
        assert_eq!(text.get::<&str>(), Err(CdrError::Text { at: 8 }));
    }

    proptest! {
        #[test]
        fn another_program_writes_the_same_bytes_and_both_read_them(value in everything()) {
            let bytes = ours(&value);
            let (head, body) = bytes.split_at(4);
            prop_assert_eq!(head, CDR_HEADER);
            let theirs = cdr_encoding::to_vec::<_, LittleEndian>(&value).unwrap();
            prop_assert_eq!(body, &theirs[..]);
            prop_assert_eq!(read(&bytes), Ok(value.clone()));
            let (back, used) = cdr_encoding::from_bytes::<Everything, LittleEndian>(body).unwrap();
            prop_assert_eq!((back, used), (value, body.len()));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(0_u8..4, 0..80)) {
            let _ = read(&bytes);
        }
    }
}
