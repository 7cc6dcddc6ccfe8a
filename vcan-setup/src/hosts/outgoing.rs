//! Frames from the local bus to the other hosts: numbers them, queues them, and drops those that do not fit into the
//! queue.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::message::{MAX_FRAMES, MessageHeader, StampedFrame, encode};

/// The maximum number of queued frames: those of a fully loaded bus in 100 ms.
pub const MAX_WAITING_FRAMES: usize = 4_096;

/// Counts of the frames from the local bus. `taken` equals `sent + dropped` plus the frames in the queue.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
pub struct BusAccount {
    /// Frames received from the bus.
    pub taken: u64,
    /// Frames passed to the transport.
    pub sent: u64,
    /// Messages that were passed to the transport, each with several frames.
    pub messages: u64,
    /// Frames dropped because the queue was full or the transport refused them.
    pub dropped: u64,
    /// Frames that the bus dropped because this process did not read in time; not in `taken`.
    pub missed: u64,
}

/// The queue of frames from the local bus to the transport.
#[derive(Debug)]
pub struct BusToHostsQueue {
    life: u64,
    /// The queued frames with their numbers. Frames of one message have consecutive numbers.
    waiting: VecDeque<(u64, StampedFrame)>,
    /// The number that the next frame from the bus gets.
    next: u64,
    account: BusAccount,
}

impl BusToHostsQueue {
    /// Creates an empty queue. `life` is a random number that identifies this start of the link.
    #[must_use]
    pub fn new(life: u64) -> Self {
        Self {
            life,
            waiting: VecDeque::with_capacity(MAX_WAITING_FRAMES),
            next: 0,
            account: BusAccount::default(),
        }
    }

    /// Numbers a frame from the bus and queues it, or drops it if the queue is full.
    pub fn push(&mut self, stamped: StampedFrame) {
        let number = self.next;
        self.next += 1;
        self.account.taken += 1;
        if self.waiting.len() < MAX_WAITING_FRAMES {
            self.waiting.push_back((number, stamped));
        } else {
            self.account.dropped += 1;
        }
    }

    /// Sets the total number of frames that the bus has dropped before this process could read them.
    pub const fn set_missed_count(&mut self, so_far: u64) {
        self.account.missed = so_far;
    }

    /// Encodes the next message from the oldest frames. Returns their number. The frames stay in the queue until
    /// [`BusToHostsQueue::remove_sent`] or [`BusToHostsQueue::remove_refused`] is called.
    pub fn encode_message(&self, bytes: &mut Vec<u8>) -> usize {
        let Some(&(first, _)) = self.waiting.front() else { return 0 };
        let run = self.waiting.iter().zip(first..).take(MAX_FRAMES);
        let count = run.take_while(|((number, _), expected)| number == expected).count();
        // All frames before `first` were either sent or dropped.
        let dropped = first - self.account.sent;
        let head = MessageHeader { life: self.life, first, dropped, missed: self.account.missed };
        encode(&head, self.waiting.iter().take(count).map(|(_, stamped)| stamped), bytes);
        count
    }

    /// Removes the frames of a message that was passed to the transport.
    pub fn remove_sent(&mut self, count: usize) {
        let gone = self.waiting.drain(..count.min(self.waiting.len())).count() as u64;
        self.account.sent += gone;
        self.account.messages += 1;
    }

    /// Removes the frames of a message that the transport refused.
    pub fn remove_refused(&mut self, count: usize) {
        self.account.dropped += self.waiting.drain(..count.min(self.waiting.len())).count() as u64;
    }

    /// Returns the account of the frames so far.
    #[must_use]
    pub const fn account(&self) -> BusAccount {
        self.account
    }

    /// Returns the number of waiting frames.
    #[must_use]
    pub fn waiting_frame_count(&self) -> usize {
        self.waiting.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::message::decode;
    use super::*;
    use protocol::can::Frame;

    fn frame(at_nanos: u64) -> StampedFrame {
        StampedFrame { at_nanos, frame: Frame::classic(0x201, &at_nanos.to_le_bytes()).unwrap() }
    }

    /// Returns the next message: its first number, the number of frames dropped before, and the times of its frames.
    fn next(outgoing: &mut BusToHostsQueue) -> Option<(u64, u64, Vec<u64>)> {
        let (mut bytes, mut frames) = (Vec::new(), Vec::new());
        let count = outgoing.encode_message(&mut bytes);
        if count == 0 {
            return None;
        }
        let head = decode(&bytes, &mut frames).unwrap();
        assert_eq!(frames.len(), count);
        outgoing.remove_sent(count);
        Some((head.first, head.dropped, frames.iter().map(|it| it.at_nanos).collect()))
    }

    #[test]
    fn frames_go_out_in_order_and_in_batches() {
        let mut outgoing = BusToHostsQueue::new(1);
        assert_eq!(next(&mut outgoing), None);
        (0..300).for_each(|at| outgoing.push(frame(at)));
        assert_eq!(next(&mut outgoing), Some((0, 0, (0..256).collect())));
        assert_eq!(next(&mut outgoing), Some((256, 0, (256..300).collect())));
        assert_eq!(
            (outgoing.account().sent, outgoing.account().messages, outgoing.waiting_frame_count()),
            (300, 2, 0)
        );
    }

    #[test]
    fn what_is_dropped_has_a_number_and_is_told() {
        let mut outgoing = BusToHostsQueue::new(1);
        let all = MAX_WAITING_FRAMES as u64;
        (0..all + 7).for_each(|at| outgoing.push(frame(at)));
        assert_eq!((outgoing.account().dropped, outgoing.waiting_frame_count()), (7, MAX_WAITING_FRAMES));
        assert_eq!(next(&mut outgoing).unwrap().0, 0);
        outgoing.push(frame(9_000));
        outgoing.remove_refused(256); // frames 256 to 511
        let mut last = None;
        while let Some(message) = next(&mut outgoing) {
            // A gap in the numbers of the frames ends a message.
            last = Some(message);
        }
        assert_eq!(last, Some((all + 7, 7 + 256, vec![9_000])));
        let BusAccount { taken, sent, dropped, .. } = outgoing.account();
        assert_eq!((taken, sent, dropped), (all + 8, all + 8 - 263, 263));
    }
}
