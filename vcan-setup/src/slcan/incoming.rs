//! From a line to the bus: bytes become frames, which wait until the bus takes them.

use std::collections::VecDeque;

use protocol::can::{Format, Frame};
use protocol::slcan::{Decoder, Line};

use super::account::ToBus;

/// Frames that wait for the bus at most.
pub const QUEUE: usize = 1_024;

/// The way of frames from a line to the bus.
#[derive(Debug, Default)]
pub struct Incoming {
    decoder: Decoder,
    /// The bus carries classic frames only.
    classic: bool,
    is_up: bool,
    frames: VecDeque<Frame>,
    account: ToBus,
}

impl Incoming {
    /// To a bus that is not there yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// The bus is there; `classic` drops FD frames.
    pub const fn up(&mut self, classic: bool) {
        self.is_up = true;
        self.classic = classic;
    }

    /// The bus is gone, and takes nothing of what waits.
    pub fn down(&mut self) {
        self.is_up = false;
        self.account.dropped.bus_away += self.clear();
    }

    /// Takes bytes of the line.
    pub fn take(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            match self.decoder.push(byte) {
                Some(Line::Frame(frame)) => self.push(frame),
                Some(Line::Failed) => self.account.bells += 1,
                Some(Line::Other | Line::Command(_)) => self.account.other_lines += 1,
                None | Some(Line::Done | Line::Sent | Line::Refused(_)) => {}
            }
        }
    }

    /// The line is gone, with what it had begun.
    pub fn line_lost(&mut self) {
        self.decoder.restart();
    }

    /// The frames that wait for the bus, from the first one on.
    pub fn waiting(&mut self) -> &[Frame] {
        self.frames.make_contiguous()
    }

    /// The bus took so many of them.
    pub fn sent(&mut self, count: usize) {
        let count = self.frames.drain(..count.min(self.frames.len())).count();
        self.account.sent += count as u64;
    }

    /// The end: what waits is dropped.
    pub fn end(&mut self) {
        self.account.dropped.ended += self.clear();
    }

    /// What became of the frames.
    #[must_use]
    pub fn account(&self) -> ToBus {
        ToBus { refused: self.decoder.refused().into(), ..self.account }
    }

    fn push(&mut self, frame: Frame) {
        self.account.received += 1;
        let dropped = &mut self.account.dropped;
        let reason = if !self.is_up {
            &mut dropped.bus_away
        } else if self.classic && frame.format() == Format::Fd {
            &mut dropped.not_classic
        } else if self.frames.len() >= QUEUE {
            &mut dropped.queue_full
        } else {
            self.frames.push_back(frame);
            return;
        };
        *reason += 1;
    }

    fn clear(&mut self) -> u64 {
        self.frames.drain(..).count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn frames_wait_in_order_and_the_rest_is_counted() {
        let mut incoming = Incoming::new();
        incoming.take(b"t1230\r");
        incoming.up(true);
        incoming.take(b"\rz\r\x07V1013\rt1240\rb1250\rt1239\rS8\rt12");
        incoming.take(b"60\r");
        assert_eq!(incoming.waiting().iter().map(Frame::id).collect::<Vec<_>>(), [0x124, 0x126]);
        incoming.sent(1);
        incoming.take(b"t12");
        incoming.line_lost();
        incoming.take(b"t1270\r");
        assert_eq!(incoming.waiting().iter().map(Frame::id).collect::<Vec<_>>(), [0x126, 0x127]);
        incoming.down();
        let account = incoming.account();
        assert_eq!((account.received, account.sent, account.bells, account.other_lines), (5, 1, 1, 2));
        assert_eq!((account.dropped.bus_away, account.dropped.not_classic), (3, 1));
        assert_eq!((account.refused.dlc, account.refused.short, account.refused.total()), (1, 1, 2));
    }

    proptest! {
        #[test]
        fn every_frame_is_sent_or_dropped_for_a_reason(
            steps in proptest::collection::vec((0_u8..6, 0_usize..400), 0..60)
        ) {
            let mut incoming = Incoming::new();
            for (kind, amount) in steps {
                match kind {
                    0 => incoming.up(amount % 2 == 0),
                    1 => incoming.down(),
                    2 => incoming.sent(amount),
                    _ => (0..amount).for_each(|_| incoming.take(b"t1230\rb1230\r")),
                }
                let waiting = incoming.waiting().len();
                prop_assert!(waiting <= QUEUE);
                let account = incoming.account();
                prop_assert_eq!(account.received, account.sent + account.dropped.total() + waiting as u64);
            }
            incoming.end();
            let account = incoming.account();
            prop_assert_eq!(account.received, account.sent + account.dropped.total());
        }
    }
}
