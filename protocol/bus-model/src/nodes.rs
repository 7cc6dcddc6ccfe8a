//! The nodes of a bus, each with a transmit queue of limited depth.
//!
//! ```text
//!   request(at, node, frame) ──> queue of the node ──> BusModel ──> poll: Attempt, …
//!                                  └─ full: refused
//! ```

use std::collections::VecDeque;
use std::fmt;
use std::num::NonZeroU32;
use std::str::FromStr;

use protocol::can::Frame;
use protocol::wire_time::{BitRates, FrameBits};
use thiserror::Error;

use crate::{Attempt, BitErrors, BusModel, Priority, Request};

/// Order in which a node sends the frames of its transmit queue.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum QueueOrder {
    /// In the order of their requests, as SocketCAN does: only the oldest frame takes part in arbitration.
    Fifo,
    /// The lowest identifier first, as a controller with several transmit buffers does: each frame takes part in
    /// arbitration.
    Priority,
}

/// The transmit queue that each node of a bus has.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct TransmitQueue {
    /// Order in which the frames are sent.
    pub order: QueueOrder,
    /// Maximum number of frames that wait in the queue, including the one on the wire.
    pub depth: NonZeroU32,
}

impl TransmitQueue {
    /// Maximum depth, that of the largest `txqueuelen` in use.
    pub const MAX_DEPTH: u32 = 65_536;
}

impl Default for TransmitQueue {
    /// Returns 32 frames in the order of their priorities: the transmit buffers of an M_CAN controller.
    fn default() -> Self {
        Self { order: QueueOrder::Priority, depth: NonZeroU32::new(32).unwrap_or(NonZeroU32::MIN) }
    }
}

/// The error for a text that does not describe a transmit queue.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[error("{0:?} is not a transmit queue: use fifo or priority, or add a depth of 1 to 65536, such as fifo:10")]
pub struct TransmitQueueError(String);

impl FromStr for TransmitQueue {
    type Err = TransmitQueueError;

    fn from_str(text: &str) -> Result<Self, TransmitQueueError> {
        let refused = || TransmitQueueError(text.to_owned());
        let (order, depth) = match text.split_once(':') {
            Some((order, depth)) => (order, depth.parse().map_err(|_| refused())?),
            None => (text, Self::default().depth),
        };
        let order = match order {
            "fifo" => QueueOrder::Fifo,
            "priority" => QueueOrder::Priority,
            _ => return Err(refused()),
        };
        if depth.get() > Self::MAX_DEPTH {
            return Err(refused());
        }
        Ok(Self { order, depth })
    }
}

impl fmt::Display for TransmitQueue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let order = match self.order {
            QueueOrder::Fifo => "fifo",
            QueueOrder::Priority => "priority",
        };
        write!(f, "{order}:{}", self.depth)
    }
}

/// The refusal of a frame by a full transmit queue.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[error("the transmit queue is full")]
pub struct QueueFull;

/// The properties of a frame that decide when a bus sends it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct BusFrame {
    /// Priority in arbitration.
    pub priority: Priority,
    /// Number of bits, by bit rate.
    pub bits: FrameBits,
}

impl BusFrame {
    /// Returns the properties of a frame; `None` for an error frame of a driver, which no node can request.
    #[must_use]
    pub fn from_frame(frame: &Frame) -> Option<Self> {
        Some(Self { priority: Priority::from_frame(frame), bits: FrameBits::from_frame(frame)? })
    }
}

/// A bus whose nodes have transmit queues of limited depth. Times are in ns from an arbitrary origin.
#[derive(Debug)]
pub struct NodeBus<T> {
    model: BusModel<(u16, T)>,
    queue: TransmitQueue,
    /// Number of frames in the queue of each node.
    waiting: Vec<u32>,
    ended: VecDeque<Attempt<T>>,
}

impl<T: Copy> NodeBus<T> {
    /// Creates an idle bus.
    #[must_use]
    pub fn new(rates: BitRates, queue: TransmitQueue, errors: Option<BitErrors>) -> Self {
        let model = BusModel::new(rates);
        Self {
            model: errors.into_iter().fold(model, BusModel::with_errors),
            queue,
            waiting: Vec::new(),
            ended: VecDeque::new(),
        }
    }

    /// Requests to send a frame, and advances the time to that of the request. A request earlier than the previous one
    /// has the time of the previous one. Returns the time of the request.
    ///
    /// # Errors
    /// Returns [`QueueFull`] if the transmit queue of the node has no room. The time advances all the same.
    pub fn request(&mut self, at: u64, node: u16, frame: BusFrame, tag: T) -> Result<u64, QueueFull> {
        let at = self.advance(at);
        let TransmitQueue { order, depth } = self.queue;
        let waiting = self.waiting_of(node);
        if *waiting >= depth.get() {
            return Err(QueueFull);
        }
        *waiting += 1;
        let queue = match order {
            QueueOrder::Fifo => Some(node),
            QueueOrder::Priority => None,
        };
        let BusFrame { priority, bits } = frame;
        self.model.request(Request { at, priority, bits, queue, tag: (node, tag) });
        Ok(at)
    }

    /// Advances the time to `until`, unless it is later already. Returns the time. [`NodeBus::poll`] then returns the
    /// attempts that have ended until then.
    pub fn advance(&mut self, until: u64) -> u64 {
        let now = self.model.run_until(until);
        while let Some(Attempt { tag: (node, tag), at, start, end, is_damaged }) = self.model.poll() {
            if !is_damaged {
                *self.waiting_of(node) -= 1;
            }
            self.ended.push_back(Attempt { tag, at, start, end, is_damaged });
        }
        now
    }

    /// Advances the time until all queued frames are sent.
    pub fn finish(&mut self) {
        while let Some(at) = self.poll_timeout() {
            self.advance(at);
        }
    }

    /// Returns the next attempt that has ended, in order of time; `None` if there are no more.
    pub fn poll(&mut self) -> Option<Attempt<T>> {
        self.ended.pop_front()
    }

    /// Returns the time in ns at which the next attempt ends if no further request is made; `None` if no frame
    /// waits.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<u64> {
        self.model.poll_timeout()
    }

    /// Returns the bit rates.
    #[must_use]
    pub const fn rates(&self) -> BitRates {
        self.model.rates()
    }

    /// Returns the number of waiting frames of all nodes, including the one on the wire.
    #[must_use]
    pub const fn waiting(&self) -> usize {
        self.model.waiting()
    }

    /// Returns the largest number of frames that have waited at the same time.
    #[must_use]
    pub const fn max_waiting(&self) -> usize {
        self.model.max_waiting()
    }

    fn waiting_of(&mut self, node: u16) -> &mut u32 {
        let index = usize::from(node);
        if self.waiting.len() <= index {
            self.waiting.resize(index + 1, 0);
        }
        self.waiting.get_mut(index).expect("there are as many now")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bus(queue: &str) -> NodeBus<u64> {
        NodeBus::new("1M/5M".parse().unwrap(), queue.parse().unwrap(), None)
    }

    /// Returns the tags of the sent frames in their order.
    fn sent(bus: &mut NodeBus<u64>) -> Vec<u64> {
        bus.finish();
        std::iter::from_fn(|| bus.poll()).map(|sent| sent.tag).collect()
    }

    fn frame(id: u32) -> BusFrame {
        BusFrame::from_frame(&Frame::classic(id, &[1, 2, 3, 4]).unwrap()).unwrap()
    }

    #[test]
    fn a_node_sends_in_the_order_of_its_queue() {
        let requests = [(1, 0x700), (1, 0x002), (2, 0x300), (1, 0x001), (2, 0x200)];
        for (queue, expected) in [("priority:8", [0, 3, 1, 4, 2]), ("fifo:8", [0, 1, 3, 2, 4])] {
            let mut bus = bus(queue);
            for ((node, id), tag) in requests.into_iter().zip(0..) {
                // The first frame is on the wire when the others are requested.
                bus.request(tag, node, frame(id), tag).unwrap();
            }
            assert_eq!((bus.waiting(), bus.max_waiting()), (5, 5));
            assert_eq!(sent(&mut bus), expected, "{queue}");
        }
    }

    #[test]
    fn a_full_queue_refuses_frames_until_one_is_sent() {
        let mut bus = bus("priority:2");
        let took = frame(1).bits.nanoseconds(bus.rates());
        assert_eq!(bus.request(5, 1, frame(1), 0), Ok(5));
        assert_eq!(bus.request(5, 1, frame(2), 1), Ok(5));
        assert_eq!(bus.request(6, 1, frame(0), 2), Err(QueueFull));
        assert_eq!(bus.request(3, 2, frame(3), 3), Ok(6), "not earlier than the previous one");
        assert_eq!(bus.request(4 + took, 1, frame(4), 4), Err(QueueFull));
        assert_eq!(bus.request(5 + took, 1, frame(4), 5), Ok(5 + took));
        assert_eq!(sent(&mut bus), [0, 1, 3, 5]);
    }

    #[test]
    fn a_damaged_frame_stays_in_its_queue() {
        let errors = BitErrors::new(0.01, 1).unwrap();
        let mut bus = NodeBus::new("1M".parse().unwrap(), "fifo:3".parse().unwrap(), Some(errors));
        for tag in 0..3 {
            bus.request(0, 7, frame(9), tag).unwrap();
        }
        bus.finish();
        let all: Vec<_> = std::iter::from_fn(|| bus.poll()).collect();
        assert!(all.iter().any(|it| it.is_damaged), "{all:?}");
        assert_eq!(all.iter().filter(|it| !it.is_damaged).map(|it| it.tag).collect::<Vec<_>>(), [0, 1, 2]);
        assert!(all.windows(2).all(|pair| pair[0].end == pair[1].start), "{all:?}");
        assert_eq!(bus.request(all.last().unwrap().end, 7, frame(9), 3).map(|_| ()), Ok(()));
    }

    #[test]
    fn an_error_frame_is_no_request() {
        let error = Frame::classic(protocol::can::ERROR | 4, &[0; 8]).unwrap();
        assert_eq!(BusFrame::from_frame(&error), None);
    }

    #[test]
    fn a_transmit_queue_is_an_order_and_a_depth() {
        for (text, expected) in [("fifo", "fifo:32"), ("priority", "priority:32"), ("fifo:10", "fifo:10")] {
            assert_eq!(text.parse::<TransmitQueue>().unwrap().to_string(), expected);
        }
        for wrong in ["", "lifo", "fifo:", "fifo:0", "priority:65537", "priority:-1", "fifo:1:2"] {
            let error = wrong.parse::<TransmitQueue>().unwrap_err();
            assert!(error.to_string().starts_with(&format!("{wrong:?} is not a transmit queue: use fifo")));
        }
    }
}
