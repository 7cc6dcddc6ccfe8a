//! Frames from a line to the bus: decodes the bytes of the line, and queues the frames until the bus accepts them.

use std::collections::VecDeque;

use protocol::can::{Format, Frame};
use protocol::slcan::{AdapterFault, AdapterReport, BusState, Decoder, SlcanLine};

use super::account::{FaultCounts, LineToBusCounts};

/// The maximum number of frames queued for the bus.
pub const MAX_WAITING_FRAMES: usize = 1_024;

/// The decoder of a line and the queue of its frames to the bus.
#[derive(Debug, Default)]
pub struct LineToBusQueue {
    decoder: Decoder,
    /// True if the bus carries classic frames only.
    classic: bool,
    is_up: bool,
    /// True if the bus is virtual. Only then are error frames sent, because hardware would send them as data frames.
    is_virtual: bool,
    frames: VecDeque<Frame>,
    account: LineToBusCounts,
    replies: AdapterReplies,
    /// The last error state that the adapter reported for its bus.
    state: BusState,
    faults: FaultCounts,
}

/// The replies of an adapter since it was last opened.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct AdapterReplies {
    /// True if the adapter acknowledged a line or sent a frame since then.
    pub accepted: bool,
    /// The number of refusals since the last acknowledgement.
    pub refusals: u64,
}

impl AdapterReplies {
    const ACCEPTED: Self = Self { accepted: true, refusals: 0 };
}

impl LineToBusQueue {
    /// Creates an empty queue to a bus that is not open yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Records that the bus is open. With `classic`, FD frames are dropped. Error frames are sent only if `is_virtual`
    /// is true.
    pub const fn handle_bus_opened(&mut self, classic: bool, is_virtual: bool) {
        (self.is_up, self.classic, self.is_virtual) = (true, classic, is_virtual);
    }

    /// Records that the adapter was opened. Counting of its replies begins anew, and its bus is taken to be without
    /// errors.
    pub fn handle_adapter_opened(&mut self) {
        (self.replies, self.state) = (AdapterReplies::default(), BusState::Active);
    }

    /// Records that the bus was lost, and drops the frames that are queued for it.
    pub fn handle_bus_lost(&mut self) {
        self.is_up = false;
        self.account.dropped.bus_away += self.clear_and_count();
    }

    /// Decodes bytes of the line, and queues the frames in them.
    pub fn receive_bytes(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            match self.decoder.push(byte) {
                Some(SlcanLine::Frame(frame)) => {
                    self.replies = AdapterReplies::ACCEPTED;
                    self.push(frame);
                }
                Some(SlcanLine::Failed) => {
                    self.account.bells += 1;
                    self.replies.refusals += 1;
                }
                Some(SlcanLine::Done | SlcanLine::Sent) => self.replies = AdapterReplies::ACCEPTED,
                Some(SlcanLine::Reported(report)) => self.record_adapter_report(report),
                Some(SlcanLine::Other | SlcanLine::Command(_)) => self.account.other_lines += 1,
                None | Some(SlcanLine::Refused(_)) => {}
            }
        }
    }

    /// Returns the adapter's replies since it was last opened.
    #[must_use]
    pub const fn replies(&self) -> AdapterReplies {
        self.replies
    }

    /// Returns the faults that the adapter reported.
    #[must_use]
    pub const fn faults(&self) -> &FaultCounts {
        &self.faults
    }

    /// Counts the faults that the adapter reports, and queues an error frame for them.
    fn record_adapter_report(&mut self, report: AdapterReport) {
        let before = self.state;
        self.state = report.state().unwrap_or(before);
        let changed = (self.state != before).then_some(self.state.name());
        let mut is_empty = true;
        for name in report.faults().map(AdapterFault::name).chain(changed) {
            *self.faults.entry(name).or_default() += 1;
            is_empty = false;
        }
        if let Some(frame) = report.error_frame(before).filter(|_| self.is_virtual) {
            self.push(frame);
        }
        self.account.other_lines += u64::from(is_empty);
    }

    /// Records that the line was lost, and discards the incomplete text at its end.
    pub fn handle_line_lost(&mut self) {
        self.decoder.discard_unfinished();
    }

    /// Returns the queued frames, oldest first.
    pub fn waiting_frames(&mut self) -> &[Frame] {
        self.frames.make_contiguous()
    }

    /// Removes the first `count` frames from the queue after they were sent.
    pub fn remove_sent(&mut self, count: usize) {
        let count = self.frames.drain(..count.min(self.frames.len())).count();
        self.account.sent += count as u64;
    }

    /// Drops the queued frames, because the program ends.
    pub fn drop_remaining(&mut self) {
        self.account.dropped.ended += self.clear_and_count();
    }

    /// Returns the counts of the frames.
    #[must_use]
    pub fn account(&self) -> LineToBusCounts {
        LineToBusCounts { refused: self.decoder.rejected_lines().into(), ..self.account }
    }

    fn push(&mut self, frame: Frame) {
        self.account.received += 1;
        let dropped = &mut self.account.dropped;
        let reason = if !self.is_up {
            &mut dropped.bus_away
        } else if self.classic && frame.format() == Format::Fd {
            &mut dropped.not_classic
        } else if self.frames.len() >= MAX_WAITING_FRAMES {
            &mut dropped.queue_full
        } else {
            self.frames.push_back(frame);
            return;
        };
        *reason += 1;
    }

    fn clear_and_count(&mut self) -> u64 {
        self.frames.drain(..).count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn frames_wait_in_order_and_the_rest_is_counted() {
        let mut incoming = LineToBusQueue::new();
        incoming.receive_bytes(b"t1230\r");
        incoming.handle_bus_opened(true, true);
        incoming.receive_bytes(b"\rz\r\x07V1013\rt1240\rb1250\rt1239\rS8\rt12");
        incoming.receive_bytes(b"60\r");
        assert_eq!(incoming.waiting_frames().iter().map(Frame::id).collect::<Vec<_>>(), [0x124, 0x126]);
        incoming.remove_sent(1);
        incoming.receive_bytes(b"t12");
        incoming.handle_line_lost();
        incoming.receive_bytes(b"t1270\r");
        assert_eq!(incoming.waiting_frames().iter().map(Frame::id).collect::<Vec<_>>(), [0x126, 0x127]);
        incoming.handle_bus_lost();
        let account = incoming.account();
        assert_eq!((account.received, account.sent, account.bells, account.other_lines), (5, 1, 1, 2));
        assert_eq!((account.dropped.bus_away, account.dropped.not_classic), (3, 1));
        assert_eq!((account.refused.dlc, account.refused.short, account.refused.total()), (1, 1, 2));
    }

    #[test]
    fn faults_are_counted_and_go_to_a_virtual_bus_as_error_frames() {
        for (is_virtual, expected) in [(true, vec![0xA8, 0x40, 0x88, 0x204]), (false, vec![])] {
            let mut incoming = LineToBusQueue::new();
            incoming.handle_bus_opened(true, is_virtual);
            incoming.receive_bytes(b"e1a\rsb256256\rsb256256\rF80\rF00\r");
            incoming.handle_adapter_opened();
            incoming.receive_bytes(b"sp128000\r");
            let frames: Vec<_> = incoming.waiting_frames().iter().map(Frame::id).collect();
            assert_eq!(frames, expected);
            assert!(incoming.waiting_frames().iter().all(Frame::is_error));
            let names = ["bus error", "bus off", "error passive", "no ACK"].map(|name| (name, 1));
            assert_eq!(*incoming.faults(), FaultCounts::from(names));
            let account = incoming.account();
            assert_eq!((account.received, account.other_lines), (expected.len() as u64, 2));
        }
    }

    #[test]
    fn refusals_in_succession_are_counted_from_the_last_acceptance() {
        let mut incoming = LineToBusQueue::new();
        let mut after = |bytes: &[u8]| {
            incoming.receive_bytes(bytes);
            let AdapterReplies { accepted, refusals } = incoming.replies();
            (accepted, refusals)
        };
        assert_eq!(after(b"\x07\x07V1013\r"), (false, 2));
        assert_eq!(after(b"z\r\x07"), (true, 1));
        assert_eq!(after(b"\r"), (true, 0));
        assert_eq!(after(b"\x07t1230\r"), (true, 0));
        incoming.handle_adapter_opened();
        assert_eq!(incoming.replies(), AdapterReplies::default());
        assert_eq!(incoming.account().bells, 4);
    }

    proptest! {
        #[test]
        fn every_frame_is_sent_or_dropped_for_a_reason(
            steps in proptest::collection::vec((0_u8..6, 0_usize..400), 0..60)
        ) {
            let mut incoming = LineToBusQueue::new();
            for (kind, amount) in steps {
                match kind {
                    0 => incoming.handle_bus_opened(amount % 2 == 0, amount % 3 == 0),
                    1 => incoming.handle_bus_lost(),
                    2 => incoming.remove_sent(amount),
                    _ => (0..amount).for_each(|_| incoming.receive_bytes(b"t1230\rb1230\re1a\rsp128000\r")),
                }
                let waiting = incoming.waiting_frames().len();
                prop_assert!(waiting <= MAX_WAITING_FRAMES);
                let account = incoming.account();
                prop_assert_eq!(account.received, account.sent + account.dropped.total() + waiting as u64);
            }
            incoming.drop_remaining();
            let account = incoming.account();
            prop_assert_eq!(account.received, account.sent + account.dropped.total());
        }
    }
}
