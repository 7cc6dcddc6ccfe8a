//! CDR, the encoding of ROS 2's messages: little endian, each number at a multiple of its size.
//!
//! ```text
//!   byte  0    1    2    3    4 ...
//!         00   01   00   00   fields; a number's place is counted from byte 4
//!         text: u32 length with the NUL, bytes, NUL        sequence: u32 count, elements
//! ```

use protocol::can::IdentifierError;
use thiserror::Error;

/// "Plain CDR, little endian", and two bytes of options.
const HEAD: [u8; 4] = [0, 1, 0, 0];
/// Sequences longer than this are none of ours.
const LONGEST: u32 = 64;

/// What a message is made of, as it is written.
pub trait Encode {
    /// Writes it behind what is there.
    fn encode(&self, out: &mut Writer<'_>);
}

/// What a message is made of, as it is read; texts are borrowed from the message.
pub trait Decode<'a>: Sized {
    /// Reads it where the reader is. Never panics.
    ///
    /// # Errors
    /// When the message ends before it, or holds a value that it does not have.
    fn decode(from: &mut Reader<'a>) -> Result<Self, CdrError>;
}

macro_rules! numbers {
    ($($number:ty: $what:literal),+) => {$(
        impl Encode for $number {
            fn encode(&self, out: &mut Writer<'_>) {
                out.number(self.to_le_bytes());
            }
        }

        impl Decode<'_> for $number {
            fn decode(from: &mut Reader<'_>) -> Result<Self, CdrError> {
                from.number($what).map(Self::from_le_bytes)
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
    fn encode(&self, out: &mut Writer<'_>) {
        out.put(u8::from(*self));
    }
}

impl Decode<'_> for bool {
    fn decode(from: &mut Reader<'_>) -> Result<Self, CdrError> {
        Ok(from.get::<u8>()? != 0)
    }
}

impl Encode for str {
    fn encode(&self, out: &mut Writer<'_>) {
        out.count(self.len() + 1);
        out.out.extend_from_slice(self.as_bytes());
        out.out.push(0);
    }
}

impl<'a> Decode<'a> for &'a str {
    fn decode(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        let bytes = from.bytes()?;
        let wrong = CdrError::Text { at: from.at - bytes.len() };
        let text = match bytes {
            _ if from.form == Form::Ros1 => bytes,
            // Some writers leave the NUL of an empty text away.
            [] => bytes,
            [text @ .., 0] => text,
            _ => return Err(wrong),
        };
        str::from_utf8(text).map_err(|_| wrong)
    }
}

/// At most `LONGEST` elements.
impl<'a, T: Decode<'a>> Decode<'a> for Vec<T> {
    fn decode(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        let count = from.get::<u32>()?;
        if count > LONGEST {
            return Err(CdrError::Value { what: "a count", got: count.into(), allowed: "0 to 64" });
        }
        (0..count).map(|_| from.get()).collect()
    }
}

/// One after the other, without a count.
impl<'a, T: Decode<'a> + Copy + Default, const N: usize> Decode<'a> for [T; N] {
    fn decode(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        let mut all = [T::default(); N];
        for one in &mut all {
            *one = from.get()?;
        }
        Ok(all)
    }
}

impl<A: Encode, B: Encode> Encode for (A, B) {
    fn encode(&self, out: &mut Writer<'_>) {
        out.put(&self.0);
        out.put(&self.1);
    }
}

impl<T: Encode + ?Sized> Encode for &T {
    fn encode(&self, out: &mut Writer<'_>) {
        (**self).encode(out);
    }
}

/// Writes a message into a buffer that can be used again.
#[derive(Debug)]
pub struct Writer<'a> {
    out: &'a mut Vec<u8>,
}

impl<'a> Writer<'a> {
    /// Begins a message; what was in the buffer is gone.
    pub fn new(out: &'a mut Vec<u8>) -> Self {
        out.clear();
        out.extend_from_slice(&HEAD);
        Self { out }
    }

    /// A number, a text, or what else a message is made of.
    pub fn put(&mut self, value: impl Encode) {
        value.encode(self);
    }

    /// How many elements follow.
    ///
    /// # Panics
    /// When they are more than 2^32 - 1: no message of ours comes near.
    pub fn count(&mut self, count: usize) {
        self.put(u32::try_from(count).expect("a message has fewer than 2^32 elements"));
    }

    /// A sequence of bytes.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.count(bytes.len());
        self.out.extend_from_slice(bytes);
    }

    /// A sequence of anything.
    pub fn sequence(&mut self, elements: impl ExactSizeIterator<Item = impl Encode>) {
        self.count(elements.len());
        elements.for_each(|element| self.put(element));
    }

    /// A number at a multiple of its size.
    fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        let over = (self.out.len() - HEAD.len()) % N;
        if over != 0 {
            self.out.resize(self.out.len() + N - over, 0);
        }
        self.out.extend_from_slice(&bytes);
    }
}

/// Bytes that are not the message they should be.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum CdrError {
    /// Another encoding.
    #[error("a message begins with {got:02x?}, not with 00 01: only little-endian CDR is read")]
    Encoding {
        /// The first two bytes, or 0.
        got: [u8; 2],
    },
    /// Fewer bytes than its fields need.
    #[error("a message ends at byte {at} in the middle of {what}")]
    Short {
        /// Where, from 0.
        at: usize,
        /// Of what.
        what: &'static str,
    },
    /// A text that is none.
    #[error("the text at byte {at} of a message is not UTF-8 with a NUL at its end")]
    Text {
        /// Where, from 0.
        at: usize,
    },
    /// A value that the type does not have.
    #[error("{what} of a message is {got}: allowed is {allowed}")]
    Value {
        /// Of what.
        what: &'static str,
        /// The value.
        got: u64,
        /// What would be right.
        allowed: &'static str,
    },
    /// An identifier that has more bits than its frame's kind.
    #[error("id of a message: {0}")]
    Identifier(#[from] IdentifierError),
    /// A time that no recording has.
    #[error(
        "the time of a message is {sec} s and {nanosec} ns: allowed are 0 s or more, and less than 1000000000 ns"
    )]
    Time {
        /// Seconds since 1970.
        sec: i64,
        /// Nanoseconds.
        nanosec: u32,
    },
}

/// The encoding of a message.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Form {
    /// That of ROS 2.
    Cdr,
    /// That of ROS 1: without a head, without padding, texts without a NUL.
    Ros1,
}

/// Reads a message; texts and bytes are borrowed from it. Never panics.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    form: Form,
}

impl<'a> Reader<'a> {
    /// Begins at a message's first field.
    ///
    /// # Errors
    /// When it is no little-endian CDR.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        match bytes {
            [0, 1, _, _, ..] => Ok(Self { bytes, at: HEAD.len(), form: Form::Cdr }),
            [first, second, ..] => Err(CdrError::Encoding { got: [*first, *second] }),
            _ => Err(CdrError::Encoding { got: [0; 2] }),
        }
    }

    /// Begins at the first field of a message of ROS 1.
    #[must_use]
    pub const fn ros1(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, form: Form::Ros1 }
    }

    /// A number, a text, or what else a message is made of.
    ///
    /// # Errors
    /// When the message ends before it, or holds a value that it does not have.
    pub fn get<T: Decode<'a>>(&mut self) -> Result<T, CdrError> {
        T::decode(self)
    }

    /// A sequence of bytes.
    ///
    /// # Errors
    /// When the message ends before its end.
    pub fn bytes(&mut self) -> Result<&'a [u8], CdrError> {
        let count = self.get::<u32>()?;
        self.take(usize::try_from(count).unwrap_or(usize::MAX), "a sequence of bytes")
    }

    fn number<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], CdrError> {
        let over = match self.form {
            Form::Cdr => (self.at - HEAD.len()) % N,
            Form::Ros1 => 0,
        };
        if over != 0 {
            self.at += N - over;
        }
        let &bytes =
            self.take(N, what)?.first_chunk().ok_or(CdrError::Short { at: self.bytes.len(), what })?;
        Ok(bytes)
    }

    fn take(&mut self, count: usize, what: &'static str) -> Result<&'a [u8], CdrError> {
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

    /// Every kind of field, in an order that a case chooses.
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
        let mut out = Writer::new(&mut buffer);
        out.put(value.byte);
        out.put(value.wide);
        out.put(value.truth);
        out.put(value.short);
        out.put(value.text.as_str());
        out.put(value.signed);
        out.bytes(&value.bytes);
        out.put(value.long);
        out.sequence(value.singles.iter());
        out.sequence(value.doubles.iter());
        out.sequence(value.texts.iter().map(String::as_str));
        out.put(value.last);
        buffer
    }

    fn read(bytes: &[u8]) -> Result<Everything, CdrError> {
        let mut from = Reader::new(bytes)?;
        Ok(Everything {
            byte: from.get()?,
            wide: from.get()?,
            truth: from.get()?,
            short: from.get()?,
            text: from.get::<&str>()?.to_owned(),
            signed: from.get()?,
            bytes: from.bytes()?.to_vec(),
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
        let mut out = Writer::new(&mut buffer);
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
        let wrong = |bytes: &[u8]| Reader::new(bytes).map(|_| ()).unwrap_err().to_string();
        assert_eq!(
            wrong(&[0, 0, 0, 0]),
            "a message begins with [00, 00], not with 00 01: only little-endian CDR is read"
        );
        assert_eq!(Reader::new(&[]).unwrap_err(), CdrError::Encoding { got: [0; 2] });
        let mut short = Reader::new(&[0, 1, 0, 0, 9, 0, 0, 0, 1]).unwrap();
        assert_eq!(
            short.bytes().unwrap_err().to_string(),
            "a message ends at byte 9 in the middle of a sequence of bytes"
        );
        let mut text = Reader::new(&[0, 1, 0, 0, 1, 0, 0, 0, b'a']).unwrap();
        assert_eq!(text.get::<&str>(), Err(CdrError::Text { at: 8 }));
    }

    proptest! {
        #[test]
        fn another_program_writes_the_same_bytes_and_both_read_them(value in everything()) {
            let bytes = ours(&value);
            let (head, body) = bytes.split_at(4);
            prop_assert_eq!(head, HEAD);
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
