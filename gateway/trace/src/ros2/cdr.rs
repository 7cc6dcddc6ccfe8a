//! CDR, the encoding of ROS 2's messages: little endian, each number at a multiple of its size.
//!
//! ```text
//!   byte  0    1    2    3    4 ...
//!         00   01   00   00   fields; a number's place is counted from byte 4
//!         text: u32 length with the NUL, bytes, NUL        sequence: u32 count, elements
//! ```

use thiserror::Error;

/// "Plain CDR, little endian", and two bytes of options.
const HEAD: [u8; 4] = [0, 1, 0, 0];

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

    /// A byte.
    pub fn u8(&mut self, value: u8) {
        self.out.push(value);
    }

    /// A truth value.
    pub fn bool(&mut self, value: bool) {
        self.out.push(u8::from(value));
    }

    /// Two bytes.
    pub fn u16(&mut self, value: u16) {
        self.number(value.to_le_bytes());
    }

    /// Four bytes.
    pub fn u32(&mut self, value: u32) {
        self.number(value.to_le_bytes());
    }

    /// Four bytes with a sign.
    pub fn i32(&mut self, value: i32) {
        self.number(value.to_le_bytes());
    }

    /// Eight bytes.
    pub fn u64(&mut self, value: u64) {
        self.number(value.to_le_bytes());
    }

    /// A number of single precision.
    pub fn f32(&mut self, value: f32) {
        self.number(value.to_le_bytes());
    }

    /// A number of double precision.
    pub fn f64(&mut self, value: f64) {
        self.number(value.to_le_bytes());
    }

    /// A text.
    pub fn str(&mut self, text: &str) {
        self.count(text.len() + 1);
        self.out.extend_from_slice(text.as_bytes());
        self.out.push(0);
    }

    /// How many elements follow.
    ///
    /// # Panics
    /// When they are more than 2^32 - 1: no message of ours comes near.
    pub fn count(&mut self, count: usize) {
        self.u32(u32::try_from(count).expect("a message has fewer than 2^32 elements"));
    }

    /// A sequence of bytes.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.count(bytes.len());
        self.out.extend_from_slice(bytes);
    }

    /// A sequence of anything.
    pub fn sequence<T>(
        &mut self,
        elements: impl ExactSizeIterator<Item = T>,
        mut write: impl FnMut(&mut Self, T),
    ) {
        self.count(elements.len());
        for element in elements {
            write(self, element);
        }
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
}

/// Reads a message; texts and bytes are borrowed from it. Never panics.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    /// Begins at a message's first field.
    ///
    /// # Errors
    /// When it is no little-endian CDR.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        match bytes {
            [0, 1, _, _, ..] => Ok(Self { bytes, at: HEAD.len() }),
            [first, second, ..] => Err(CdrError::Encoding { got: [*first, *second] }),
            _ => Err(CdrError::Encoding { got: [0; 2] }),
        }
    }

    /// A byte.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn u8(&mut self) -> Result<u8, CdrError> {
        self.number("a byte").map(u8::from_le_bytes)
    }

    /// A truth value.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn bool(&mut self) -> Result<bool, CdrError> {
        Ok(self.u8()? != 0)
    }

    /// Two bytes.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn u16(&mut self) -> Result<u16, CdrError> {
        self.number("a number").map(u16::from_le_bytes)
    }

    /// Four bytes.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn u32(&mut self) -> Result<u32, CdrError> {
        self.number("a number").map(u32::from_le_bytes)
    }

    /// Four bytes with a sign.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn i32(&mut self) -> Result<i32, CdrError> {
        self.number("a number").map(i32::from_le_bytes)
    }

    /// Eight bytes.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn u64(&mut self) -> Result<u64, CdrError> {
        self.number("a number").map(u64::from_le_bytes)
    }

    /// A number of single precision.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn f32(&mut self) -> Result<f32, CdrError> {
        self.number("a number").map(f32::from_le_bytes)
    }

    /// A number of double precision.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn f64(&mut self) -> Result<f64, CdrError> {
        self.number("a number").map(f64::from_le_bytes)
    }

    /// A text.
    ///
    /// # Errors
    /// When the message ends before it, or it is none.
    pub fn str(&mut self) -> Result<&'a str, CdrError> {
        let bytes = self.bytes()?;
        let wrong = CdrError::Text { at: self.at - bytes.len() };
        let text = match bytes {
            // Some writers leave the NUL of an empty text away.
            [] => bytes,
            [text @ .., 0] => text,
            _ => return Err(wrong),
        };
        str::from_utf8(text).map_err(|_| wrong)
    }

    /// How many elements follow; the message may be shorter than that.
    ///
    /// # Errors
    /// When the message ends before it.
    pub fn count(&mut self) -> Result<usize, CdrError> {
        self.u32().map(|count| usize::try_from(count).unwrap_or(usize::MAX))
    }

    /// A sequence of bytes.
    ///
    /// # Errors
    /// When the message ends before its end.
    pub fn bytes(&mut self) -> Result<&'a [u8], CdrError> {
        let count = self.count()?;
        self.take(count, "a sequence of bytes")
    }

    /// Whether everything has been read.
    #[must_use]
    pub const fn is_at_end(&self) -> bool {
        self.at >= self.bytes.len()
    }

    fn number<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], CdrError> {
        let over = (self.at - HEAD.len()) % N;
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
        out.u8(value.byte);
        out.f64(value.wide);
        out.bool(value.truth);
        out.u16(value.short);
        out.str(&value.text);
        out.i32(value.signed);
        out.bytes(&value.bytes);
        out.u64(value.long);
        out.sequence(value.singles.iter(), |out, &value| out.f32(value));
        out.sequence(value.doubles.iter(), |out, &value| out.f64(value));
        out.sequence(value.texts.iter(), |out, text| out.str(text));
        out.u32(value.last);
        buffer
    }

    fn read(bytes: &[u8]) -> Result<Everything, CdrError> {
        fn some<T>(
            from: &mut Reader<'_>,
            one: impl Fn(&mut Reader<'_>) -> Result<T, CdrError>,
        ) -> Result<Vec<T>, CdrError> {
            (0..from.count()?).map(|_| one(from)).collect()
        }
        let mut from = Reader::new(bytes)?;
        Ok(Everything {
            byte: from.u8()?,
            wide: from.f64()?,
            truth: from.bool()?,
            short: from.u16()?,
            text: from.str()?.to_owned(),
            signed: from.i32()?,
            bytes: from.bytes()?.to_vec(),
            long: from.u64()?,
            singles: some(&mut from, |from| from.f32())?,
            doubles: some(&mut from, |from| from.f64())?,
            texts: some(&mut from, |from| from.str().map(str::to_owned))?,
            last: from.u32()?,
        })
    }

    #[test]
    fn numbers_stand_at_multiples_of_their_size_counted_from_byte_4() {
        let mut buffer = Vec::new();
        let mut out = Writer::new(&mut buffer);
        out.str("ab");
        out.u64(1);
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
        assert_eq!(text.str(), Err(CdrError::Text { at: 8 }));
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
