//! A model of a real bus for the wire of a bench: with bit rates, arbitration and queues.

use std::collections::BTreeMap;

use bus_model::{Attempt, BusModel, Priority, Request};
use protocol::can::Frame;
use protocol::time::Micros;
use protocol::wire_time::{BitRates, FrameBits};

/// A requested frame, with the time of the request.
pub type Requested = (Micros, Frame);

/// A real bus, and the frames that wait for it.
#[derive(Debug)]
pub(crate) struct RealBus<T> {
    model: BusModel,
    waiting: BTreeMap<u64, T>,
    /// The time at which the bus is advanced next, if that is scheduled.
    pub(crate) next_advance: Option<Micros>,
    pub(crate) requested: Vec<Requested>,
    pub(crate) attempts: Vec<Attempt>,
}

impl<T> RealBus<T> {
    pub(crate) const fn new(rates: BitRates) -> Self {
        Self {
            model: BusModel::new(rates),
            waiting: BTreeMap::new(),
            next_advance: None,
            requested: Vec::new(),
            attempts: Vec::new(),
        }
    }

    /// Requests the transmission of a frame.
    pub(crate) fn request(&mut self, now: Micros, frame: &Frame, item: T) {
        let Some(bits) = FrameBits::from_frame(frame) else { return };
        let tag = u64::try_from(self.requested.len()).unwrap_or(u64::MAX);
        let request =
            Request { at: now.0 * 1_000, priority: Priority::from_frame(frame), bits, queue: None, tag };
        self.requested.push((now, *frame));
        self.waiting.insert(tag, item);
        self.model.request(request);
    }

    /// Returns the frames whose transmission has ended until now, with the times of their ends in whole µs, rounded up.
    pub(crate) fn ended(&mut self, now: Micros) -> Vec<(Micros, T)> {
        self.model.run_until(now.0 * 1_000);
        let mut ended = Vec::new();
        while let Some(attempt) = self.model.poll() {
            self.attempts.push(attempt);
            let item = self.waiting.remove(&attempt.tag);
            ended.extend(item.map(|item| (Micros(attempt.end.div_ceil(1_000)), item)));
        }
        ended
    }

    /// Returns the time at which the bus must be advanced next.
    pub(crate) fn next(&self) -> Option<Micros> {
        self.model.poll_timeout().map(|nanos| Micros(nanos.div_ceil(1_000)))
    }
}
