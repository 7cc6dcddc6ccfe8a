//! One CAN bus with its bit rates, in virtual time: who sends when, and until when.
//!
//! ```text
//!                    in order of time                     the bus, free ─┐
//!   request(at, ..) ─────────────────> frames that wait ──────────────> one on the wire ─> poll: Attempt, Attempt, …
//!                                        ^  the lowest identifier first   │  not interrupted
//!                                        └──────── damaged: again ────────┘
//! ```
//!
//! A frame takes exactly the time of its bits ([`protocol::wire_time`]), intermission included; when it ends, whatever waits is
//! arbitrated as on the wire, and what was asked for at that very instant takes part. No frame is interrupted. With a bit-error
//! rate frames are damaged, which costs what was sent of them and an error frame, and they take part again.
//!
//! The same requests give the same attempts, on any machine and however they are taken. Times are ns on any clock.
//!
//! What it leaves out: bus-off and the error counters that lead to it, overload frames, clocks that are not alike, the time from
//! one end of the cable to the other (which the bit rate has to allow for), and two nodes that send under one
//! identifier, which is a fault on a real bus; here the earlier request is sent first.

mod noise;
mod priority;
#[cfg(test)]
mod tests;

use std::cmp::Ordering;
use std::collections::{BinaryHeap, VecDeque};

use protocol::wire_time::{BitRates, Bits};

pub use noise::{BitErrors, BitErrorsError, ERROR_FRAME};
pub use priority::Priority;

/// A frame that is to be sent.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Request<T = u64> {
    /// From when on, in ns.
    pub at: u64,
    /// What arbitration compares.
    pub priority: Priority,
    /// How long it takes.
    pub bits: Bits,
    /// The transmit queue that it waits in: its frames go out in the order in which they were asked for, as from SocketCAN. Any
    /// small numbers. Without one it takes part in every arbitration, as from a controller with room for each identifier.
    pub queue: Option<u16>,
    /// The caller's own tag.
    pub tag: T,
}

/// A frame that was on the wire.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Attempt<T = u64> {
    /// The request's tag.
    pub tag: T,
    /// When it was requested, in ns; at the earliest the time of the request before it.
    pub at: u64,
    /// Its first bit, in ns.
    pub start: u64,
    /// When the bus was free again, in ns: the end of the intermission, of the frame or of an error frame.
    pub end: u64,
    /// True if it was damaged. Then it waits again and is sent again.
    pub is_damaged: bool,
}

/// A bus, whose frames each carry a tag `T` of the caller.
#[derive(Debug)]
pub struct BusModel<T = u64> {
    rates: BitRates,
    errors: Option<BitErrors>,
    /// The time of the newest request.
    newest: u64,
    /// Everything that begins before this is decided.
    free_at: u64,
    /// When the oldest of what waits was asked for, if nothing waited before.
    ready_at: u64,
    on_wire: Option<(Waiting<T>, Attempt<T>)>,
    contenders: BinaryHeap<Waiting<T>>,
    queues: Vec<Queue<T>>,
    ended: VecDeque<Attempt<T>>,
    requests: u64,
    waiting: usize,
    most_waiting: usize,
}

/// One that waits.
#[derive(Clone, Copy, Debug)]
struct Waiting<T> {
    request: Request<T>,
    /// Which request it was: of one identifier the older one goes first.
    number: u64,
}

/// A transmit queue.
#[derive(Debug)]
struct Queue<T> {
    /// Whether a frame of its own takes part, or is on the wire.
    is_heard: bool,
    behind: VecDeque<Waiting<T>>,
}

impl<T> Ord for Waiting<T> {
    /// The maximum leaves the heap first: the frame that wins the arbitration.
    fn cmp(&self, other: &Self) -> Ordering {
        (other.request.priority, other.number).cmp(&(self.request.priority, self.number))
    }
}

impl<T> PartialOrd for Waiting<T> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> PartialEq for Waiting<T> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<T> Eq for Waiting<T> {}

impl<T: Copy> BusModel<T> {
    /// An idle bus without errors.
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

    /// The same, with errors from now on.
    #[must_use]
    pub fn with_errors(mut self, errors: BitErrors) -> Self {
        self.errors = Some(errors);
        self
    }

    /// Its bit rates.
    #[must_use]
    pub const fn rates(&self) -> BitRates {
        self.rates
    }

    /// Requests to send from a time on. A time before that of the newest request counts as that one's.
    ///
    /// Time passes up to then: attempts that ended are there to be polled.
    pub fn request(&mut self, mut request: Request<T>) {
        request.at = request.at.max(self.newest);
        self.run_until(request.at);
        let waiting = Waiting { request, number: self.requests };
        self.requests += 1;
        if self.waiting == 0 && self.on_wire.is_none() {
            self.ready_at = request.at;
        }
        self.waiting += 1;
        self.most_waiting = self.most_waiting.max(self.waiting);
        match request.queue.map(|queue| self.queue(queue)) {
            Some(queue) if queue.is_heard => queue.behind.push_back(waiting),
            queue => {
                queue.into_iter().for_each(|queue| queue.is_heard = true);
                self.contenders.push(waiting);
            }
        }
    }

    /// Lets time pass. What waits at `until` is not arbitrated yet, for more may be asked for at that instant.
    pub fn run_until(&mut self, until: u64) {
        self.newest = self.newest.max(until);
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

    /// Lets all that waits go out.
    pub fn finish(&mut self) {
        while let Some(at) = self.poll_timeout() {
            self.run_until(at);
        }
    }

    /// The next attempt that ended, in order of time.
    pub fn poll(&mut self) -> Option<Attempt<T>> {
        self.ended.pop_front()
    }

    /// Until when time has to pass for anything to happen, if nothing more is requested; `None` when no frame waits.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<u64> {
        match self.on_wire {
            Some((_, attempt)) => Some(attempt.end),
            None if self.contenders.is_empty() => None,
            None => Some(self.free_at.max(self.ready_at) + 1),
        }
    }

    /// How many frames wait, the one on the wire among them.
    #[must_use]
    pub const fn waiting(&self) -> usize {
        self.waiting
    }

    /// The most that ever waited at the same time.
    #[must_use]
    pub const fn most_waiting(&self) -> usize {
        self.most_waiting
    }

    fn queue(&mut self, number: u16) -> &mut Queue<T> {
        let index = usize::from(number);
        if self.queues.len() <= index {
            let empty = || Queue { is_heard: false, behind: VecDeque::new() };
            self.queues.resize_with(index + 1, empty);
        }
        self.queues.get_mut(index).expect("there are as many now")
    }

    /// A queue's next frame takes part from now on.
    fn next_of_queue(&mut self, queue: Option<u16>) {
        let Some(queue) = queue.map(|queue| self.queue(queue)) else { return };
        let next = queue.behind.pop_front();
        queue.is_heard = next.is_some();
        self.contenders.extend(next);
    }

    fn attempt(&mut self, request: &Request<T>, start: u64) -> Attempt<T> {
        let Request { tag, at, bits, .. } = *request;
        let spoilt = self.errors.as_mut().and_then(|errors| errors.spoils(bits));
        let took = spoilt.unwrap_or(bits).nanoseconds(self.rates);
        Attempt { tag, at, start, end: start + took, is_damaged: spoilt.is_some() }
    }
}
