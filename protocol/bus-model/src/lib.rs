//! A model of one CAN bus with its bit rates, in virtual time.
//!
//! ```text
//!                    in order of time                     the bus, free ─┐
//!   request(at, ..) ─────────────────> frames that wait ──────────────> one on the wire ─> poll: Attempt, Attempt, …
//!                                        ^  the lowest identifier first   │  not interrupted
//!                                        └──────── damaged: again ────────┘
//! ```
//!
//! A frame occupies the bus for exactly the duration of its bits ([`protocol::wire_time`]), including the intermission.
//! When the frame ends, the waiting frames are arbitrated as on the wire; frames requested at that very instant take
//! part. No frame is interrupted. With a bit-error rate, some frames are damaged: a damaged frame occupies the bus for
//! the bits sent before the error and for an error frame, and then takes part in arbitration again.
//!
//! Equal requests give equal attempts on every machine, in whatever steps the time is advanced. Times are in ns
//! from an arbitrary origin.
//!
//! The model does not include bus-off and its error counters, overload frames, clock differences, the
//! propagation delay of the cable (which the bit rate must allow for), or two nodes that send with one
//! identifier. The latter is a fault on a real bus; here the earlier request is sent first.

mod nodes;
mod noise;
mod priority;
#[cfg(test)]
mod tests;
pub mod traffic;

use std::cmp::Ordering;
use std::collections::{BinaryHeap, VecDeque};

use protocol::wire_time::{BitRates, FrameBits};

pub use nodes::{BusFrame, NodeBus, QueueFull, QueueOrder, TransmitQueue, TransmitQueueError};
pub use noise::{BitErrors, BitErrorsError, ERROR_FRAME_BITS};
pub use priority::Priority;

/// A request to send a frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Request<T = u64> {
    /// Earliest time at which the frame may be sent, in ns.
    pub at: u64,
    /// Priority of the frame in arbitration.
    pub priority: Priority,
    /// Number of bits of the frame, by bit rate.
    pub bits: FrameBits,
    /// Number of the transmit queue in which the frame waits, a small number that the caller chooses. The frames of a
    /// queue are sent in the order of their requests, as SocketCAN does. `None` if the frame takes part in every
    /// arbitration, as from a controller with a buffer for each identifier.
    pub queue: Option<u16>,
    /// Tag of the caller, returned with each attempt to send the frame.
    pub tag: T,
}

/// One attempt to send a frame, successful or not.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Attempt<T = u64> {
    /// Tag of the request.
    pub tag: T,
    /// Time of the request in ns. Times never decrease: a request earlier than the previous one has the time of the
    /// previous one.
    pub at: u64,
    /// Start of the first bit, in ns.
    pub start: u64,
    /// Time at which the bus was free again, in ns: the end of the intermission after the frame or the error
    /// frame.
    pub end: u64,
    /// True if the frame was damaged, so that it waits for another attempt.
    pub is_damaged: bool,
}

/// A bus in virtual time; each frame carries a tag `T` of the caller.
#[derive(Debug)]
pub struct BusModel<T = u64> {
    rates: BitRates,
    errors: Option<BitErrors>,
    /// Time of the latest request, in ns.
    newest: u64,
    /// Time in ns before which all arbitration is decided.
    free_at: u64,
    /// Time of the request that ended the last idle period of the bus, in ns.
    ready_at: u64,
    on_wire: Option<(WaitingFrame<T>, Attempt<T>)>,
    contenders: BinaryHeap<WaitingFrame<T>>,
    queues: Vec<Queue<T>>,
    ended: VecDeque<Attempt<T>>,
    requests: u64,
    waiting: usize,
    most_waiting: usize,
}

/// A waiting frame.
#[derive(Clone, Copy, Debug)]
struct WaitingFrame<T> {
    request: Request<T>,
    /// Sequence number of the request. Of two frames with one identifier, the one requested first is sent first.
    number: u64,
}

/// A transmit queue, of whose frames only the first takes part in arbitration.
#[derive(Debug)]
struct Queue<T> {
    /// True if a frame of this queue takes part in arbitration or is on the wire.
    is_contending: bool,
    waiting_frames: VecDeque<WaitingFrame<T>>,
}

impl<T> Ord for WaitingFrame<T> {
    /// Orders frames so that the maximum, which leaves the heap first, wins the arbitration.
    fn cmp(&self, other: &Self) -> Ordering {
        (other.request.priority, other.number).cmp(&(self.request.priority, self.number))
    }
}

impl<T> PartialOrd for WaitingFrame<T> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> PartialEq for WaitingFrame<T> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<T> Eq for WaitingFrame<T> {}

impl<T: Copy> BusModel<T> {
    /// Creates an idle bus without errors.
    #[must_use]
    pub const fn new(rates: BitRates) -> Self {
        Self {
            rates,
            errors: None,
            newest: 0,
            free_at: 0,
            ready_at: 0,
            on_wire: None,
            contenders: BinaryHeap::new(),
            queues: Vec::new(),
            ended: VecDeque::new(),
            requests: 0,
            waiting: 0,
            most_waiting: 0,
        }
    }

    /// Returns the bus with bit errors from now on.
    #[must_use]
    pub fn with_errors(mut self, errors: BitErrors) -> Self {
        self.errors = Some(errors);
        self
    }

    /// Returns the bit rates.
    #[must_use]
    pub const fn rates(&self) -> BitRates {
        self.rates
    }

    /// Requests to send a frame. A request earlier than the previous one gets the time of the previous one.
    ///
    /// Advances the time of the model to that of the request. [`BusModel::poll`] then returns the attempts that ended
    /// before it.
    pub fn request(&mut self, mut request: Request<T>) {
        request.at = request.at.max(self.newest);
        self.run_until(request.at);
        let waiting = WaitingFrame { request, number: self.requests };
        self.requests += 1;
        if self.waiting == 0 && self.on_wire.is_none() {
            self.ready_at = request.at;
        }
        self.waiting += 1;
        self.most_waiting = self.most_waiting.max(self.waiting);
        match request.queue.map(|queue| self.queue(queue)) {
            Some(queue) if queue.is_contending => queue.waiting_frames.push_back(waiting),
            queue => {
                queue.into_iter().for_each(|queue| queue.is_contending = true);
                self.contenders.push(waiting);
            }
        }
    }

    /// Advances the time of the model to `until`, in ns, unless it is later already, and returns it. Frames that wait
    /// at that time are not arbitrated yet, because more requests may follow for that instant.
    pub fn run_until(&mut self, until: u64) -> u64 {
        self.newest = self.newest.max(until);
        self.transmit_until(self.newest);
        self.newest
    }

    fn transmit_until(&mut self, until: u64) {
        loop {
            if let Some((waiting, attempt)) = self.on_wire {
                if attempt.end > until {
                    return;
                }
                self.on_wire = None;
                self.free_at = attempt.end;
                self.ended.push_back(attempt);
                if attempt.is_damaged {
                    self.contenders.push(waiting);
                } else {
                    self.waiting -= 1;
                    self.next_of_queue(waiting.request.queue);
                }
            }
            let start = self.free_at.max(self.ready_at);
            if start >= until {
                return;
            }
            let Some(waiting) = self.contenders.pop() else { return };
            self.on_wire = Some((waiting, self.attempt(&waiting.request, start)));
        }
    }

    /// Advances the time of the model until all waiting frames are sent.
    pub fn finish(&mut self) {
        while let Some(at) = self.poll_timeout() {
            self.run_until(at);
        }
    }

    /// Returns the next attempt that has ended, in order of time; `None` if there are no more.
    pub fn poll(&mut self) -> Option<Attempt<T>> {
        self.ended.pop_front()
    }

    /// Returns the time in ns to which the model must advance for the next attempt if no further request is made;
    /// `None` if no frame waits.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<u64> {
        match self.on_wire {
            Some((_, attempt)) => Some(attempt.end),
            None if self.contenders.is_empty() => None,
            None => Some(self.free_at.max(self.ready_at) + 1),
        }
    }

    /// Returns the number of waiting frames, including the one on the wire.
    #[must_use]
    pub const fn waiting(&self) -> usize {
        self.waiting
    }

    /// Returns the largest number of frames that have waited at the same time since the model was created.
    #[must_use]
    pub const fn max_waiting(&self) -> usize {
        self.most_waiting
    }

    fn queue(&mut self, number: u16) -> &mut Queue<T> {
        let index = usize::from(number);
        if self.queues.len() <= index {
            let empty = || Queue { is_contending: false, waiting_frames: VecDeque::new() };
            self.queues.resize_with(index + 1, empty);
        }
        self.queues.get_mut(index).expect("there are as many now")
    }

    /// Moves the next frame of a queue into arbitration.
    fn next_of_queue(&mut self, queue: Option<u16>) {
        let Some(queue) = queue.map(|queue| self.queue(queue)) else { return };
        let next = queue.waiting_frames.pop_front();
        queue.is_contending = next.is_some();
        self.contenders.extend(next);
    }

    fn attempt(&mut self, request: &Request<T>, start: u64) -> Attempt<T> {
        let Request { tag, at, bits, .. } = *request;
        let spoilt = self.errors.as_mut().and_then(|errors| errors.damage_frame(bits));
        let took = spoilt.unwrap_or(bits).nanoseconds(self.rates);
        Attempt { tag, at, start, end: start + took, is_damaged: spoilt.is_some() }
    }
}
