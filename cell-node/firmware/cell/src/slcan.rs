//! Frames over a serial line, for a board without a CAN controller. The program `vcan-setup slcan` at the other end
//! connects the line to a bus.

use core::fmt::Debug;

use heapless::Deque;
use protocol::can::Frame;
use protocol::slcan::{self, Decoder, SlcanLine};

/// Size of the receive buffer in bytes. It holds at least five FD frames of joints, or 40 ms at 115 200 baud.
const BUFFER_BYTES: usize = 512;
/// Maximum number of complete lines in the receive buffer.
const MAX_LINES: usize = 32;

/// The receive buffer of the serial line. An interrupt handler writes to it and the main loop reads from it.
#[derive(Debug)]
pub struct ReceiveBuffer {
    bytes: Deque<u8, BUFFER_BYTES>,
    /// Counter value at the arrival of the end of each line, in µs.
    ends: Deque<u32, MAX_LINES>,
}

impl ReceiveBuffer {
    /// Creates an empty buffer.
    #[must_use]
    pub const fn new() -> Self {
        Self { bytes: Deque::new(), ends: Deque::new() }
    }

    /// Appends a received byte. If the buffer is full, the byte is lost. The decoder then refuses the line, because its
    /// length is wrong.
    pub fn push(&mut self, byte: u8, now: u32) {
        let ends_line = byte == slcan::CR;
        if ends_line && self.ends.is_full() || self.bytes.push_back(byte).is_err() {
            return;
        }
        if ends_line {
            let _ = self.ends.push_back(now);
        }
    }

    /// Returns true if the buffer contains no complete line.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// Removes and decodes the next complete line. Returns it with the time of arrival of its end.
    pub fn next_line(&mut self, decoder: &mut Decoder) -> Option<(SlcanLine, u32)> {
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

impl Default for ReceiveBuffer {
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
        let (mut waiting, mut decoder) = (ReceiveBuffer::new(), Decoder::new());
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
            assert_eq!(waiting.next_line(&mut decoder), Some((SlcanLine::Frame(*frame), number * line * 10)));
        }
        assert_eq!(waiting.next_line(&mut decoder), None);
    }

    #[test]
    fn what_does_not_fit_is_no_frame_and_what_comes_later_is() {
        let frame = Frame::fd(1, 0, &[7; 64]).unwrap();
        let (mut waiting, mut decoder) = (ReceiveBuffer::new(), Decoder::new());
        for byte in text(&frame).repeat(9) {
            waiting.push(byte, 0);
        }
        let mut whole = 0;
        while let Some((line, _)) = waiting.next_line(&mut decoder) {
            whole += usize::from(line == SlcanLine::Frame(frame));
        }
        assert_eq!(whole, BUFFER_BYTES / text(&frame).len());
        for byte in [&[slcan::CR], &text(&frame)[..]].concat() {
            waiting.push(byte, 0);
        }
        let lines: Vec<_> =
            core::iter::from_fn(|| waiting.next_line(&mut decoder)).map(|(line, _)| line).collect();
        assert_eq!(lines.last(), Some(&SlcanLine::Frame(frame)));
    }
}
