//! A board without a CAN controller: frames as lines over a serial line, whose other end joins a bus
//! (`vcan-setup slcan`).

use core::fmt::Debug;

use heapless::Deque;
use protocol::can::Frame;
use protocol::slcan::{self, Decoder, Line};

/// Bytes that may wait for the loop: five FD frames of joints and more, or 40 ms at 115 200 baud.
const BYTES: usize = 512;
/// Ends of lines that may wait.
const LINES: usize = 32;

/// What came and was not read yet. An interrupt puts it in, the loop takes it out.
#[derive(Debug)]
pub struct Waiting {
    bytes: Deque<u8, BYTES>,
    /// When the ends of the lines in there came.
    ends: Deque<u32, LINES>,
}

impl Waiting {
    /// Nothing.
    #[must_use]
    pub const fn new() -> Self {
        Self { bytes: Deque::new(), ends: Deque::new() }
    }

    /// Takes a byte that came now. What does not fit is lost, and the line with it: its length is wrong then.
    pub fn push(&mut self, byte: u8, now: u32) {
        let ends_line = byte == slcan::CR;
        if ends_line && self.ends.is_full() || self.bytes.push_back(byte).is_err() {
            return;
        }
        if ends_line {
            let _ = self.ends.push_back(now);
        }
    }

    /// Whether no whole line waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// Gives the next line to the decoder: what it says, and when its end came.
    pub fn take(&mut self, decoder: &mut Decoder) -> Option<(Line, u32)> {
        let at = self.ends.pop_front()?;
        loop {
            let byte = self.bytes.pop_front()?;
            let line = decoder.push(byte);
            if byte == slcan::CR {
                return Some((line?, at));
            }
        }
    }
}

impl Default for Waiting {
    fn default() -> Self {
        Self::new()
    }
}

/// Writes a frame as a line, byte by byte.
pub fn send(frame: &Frame, write: impl FnMut(u8)) {
    if let Some(text) = slcan::encode(frame) {
        text.as_bytes().iter().copied().for_each(write);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(frame: &Frame) -> Vec<u8> {
        let mut text = Vec::new();
        send(frame, |byte| text.push(byte));
        text
    }

    #[test]
    fn lines_come_out_with_their_times_and_not_before_their_ends() {
        let frames = [1, 2, 3].map(|id| Frame::fd(id, 0, &[7; 24]).unwrap());
        let (mut waiting, mut decoder) = (Waiting::new(), Decoder::new());
        let mut at = 0;
        for frame in &frames {
            for byte in text(frame) {
                at += 10;
                waiting.push(byte, at);
            }
        }
        let line = u32::try_from(text(&frames[0]).len()).unwrap();
        waiting.push(b't', at);
        for (number, frame) in (1..).zip(&frames) {
            assert_eq!(waiting.take(&mut decoder), Some((Line::Frame(*frame), number * line * 10)));
        }
        assert_eq!(waiting.take(&mut decoder), None);
    }

    #[test]
    fn what_does_not_fit_is_no_frame_and_what_comes_later_is() {
        let frame = Frame::fd(1, 0, &[7; 64]).unwrap();
        let (mut waiting, mut decoder) = (Waiting::new(), Decoder::new());
        for byte in text(&frame).repeat(9) {
            waiting.push(byte, 0);
        }
        let mut whole = 0;
        while let Some((line, _)) = waiting.take(&mut decoder) {
            whole += usize::from(line == Line::Frame(frame));
        }
        assert_eq!(whole, BYTES / text(&frame).len());
        for byte in [&[slcan::CR], &text(&frame)[..]].concat() {
            waiting.push(byte, 0);
        }
        let lines: Vec<_> =
            core::iter::from_fn(|| waiting.take(&mut decoder)).map(|(line, _)| line).collect();
        assert_eq!(lines.last(), Some(&Line::Frame(frame)));
    }
}
