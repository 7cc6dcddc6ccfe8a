//! The lines of a capture, one by one, in bounded memory whatever the file is.

use std::io::{self, BufRead, BufReader, Read};

use thiserror::Error;

/// The longest line that is read: twice that of the longest CAN XL frame.
const LONGEST: usize = 8_192;
/// Bytes that are read at once.
const CHUNK: usize = 1 << 16;

/// Why a line is not text of a frame.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
pub enum LineFault {
    /// It has no end.
    #[error("a line of more than {LONGEST} bytes")]
    Long,
    /// Not UTF-8.
    #[error("bytes that are no text")]
    Bytes,
}

/// Reads lines.
#[derive(Debug)]
pub struct Lines<R> {
    input: BufReader<R>,
    line: Vec<u8>,
    number: u64,
}

/// One line: its number, from 1, and its text.
pub type Numbered<'a> = (u64, Result<&'a str, LineFault>);

impl<R: Read> Lines<R> {
    /// Reads from the input's beginning.
    pub fn new(input: R) -> Self {
        Self { input: BufReader::with_capacity(CHUNK, input), line: Vec::new(), number: 0 }
    }

    /// Whether all that has been read from the input is used up, so that the next line may take a while.
    pub fn is_drained(&self) -> bool {
        self.input.buffer().is_empty()
    }

    /// The next line with its end; `None` after the last one. What does not begin with a parenthesis is never
    /// a fault: it is no frame anyway.
    ///
    /// # Errors
    /// When the input cannot be read.
    pub fn next_line(&mut self) -> io::Result<Option<Numbered<'_>>> {
        self.line.clear();
        let limit = u64::try_from(LONGEST).unwrap_or(u64::MAX);
        if (&mut self.input).take(limit).read_until(b'\n', &mut self.line)? == 0 {
            return Ok(None);
        }
        self.number += 1;
        let long = self.line.len() == LONGEST && self.line.last() != Some(&b'\n');
        if long {
            self.skip_line()?;
        }
        let frame = self.line.first() == Some(&b'(');
        let text = match core::str::from_utf8(&self.line) {
            _ if long => Err(LineFault::Long),
            Ok(text) => Ok(text),
            Err(_) => Err(LineFault::Bytes),
        };
        Ok(Some((self.number, if frame { text } else { Ok(text.unwrap_or_default()) })))
    }

    /// Goes to the end of a line without keeping it.
    fn skip_line(&mut self) -> io::Result<()> {
        loop {
            let buffer = self.input.fill_buf()?;
            if buffer.is_empty() {
                return Ok(());
            }
            let end = buffer.iter().position(|&byte| byte == b'\n');
            let skipped = end.map_or(buffer.len(), |end| end + 1);
            self.input.consume(skipped);
            if end.is_some() {
                return Ok(());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(bytes: &[u8]) -> Vec<(u64, Result<String, LineFault>)> {
        let mut lines = Lines::new(bytes);
        let mut all = Vec::new();
        while let Some((number, line)) = lines.next_line().unwrap() {
            all.push((number, line.map(str::to_owned)));
        }
        all
    }

    #[test]
    fn lines_are_counted_and_the_last_one_needs_no_end() {
        let expected = [(1, Ok("one\n".to_owned())), (2, Ok("\r\n".to_owned())), (3, Ok("three".to_owned()))];
        assert_eq!(all(b"one\n\r\nthree"), expected);
    }

    #[test]
    fn a_line_without_end_is_left_out_and_the_next_one_is_read() {
        let mut bytes = vec![b'('; 3 * CHUNK];
        bytes.extend_from_slice(b"\nnext\n");
        bytes.extend_from_slice(&vec![b'x'; CHUNK]);
        let expected = [(1, Err(LineFault::Long)), (2, Ok("next\n".to_owned())), (3, Ok(String::new()))];
        let found = all(&bytes);
        assert_eq!(found[..2], expected[..2]);
        assert_eq!((found.len(), found[2].1.is_ok()), (3, true), "no frame, so no fault");
    }

    #[test]
    fn a_line_may_be_as_long_as_the_limit_and_not_longer() {
        let line = |len: usize| [b"(".repeat(len - 1).as_slice(), b"\n"].concat();
        assert!(all(&line(LONGEST))[0].1.is_ok());
        assert_eq!(all(&line(LONGEST + 1)), [(1, Err(LineFault::Long))]);
    }

    #[test]
    fn bytes_that_are_no_text_are_a_fault_only_in_a_frame() {
        let expected = [(1, Err(LineFault::Bytes)), (2, Ok(String::new()))];
        assert_eq!(all(b"(\xff\n\xff\n"), expected);
    }
}
