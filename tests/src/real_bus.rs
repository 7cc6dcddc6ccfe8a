//! The wire of a bench as a real bus: with bit rates, arbitration and queues.

use std::collections::BTreeMap;

use bus_model::{Attempt, BusModel, Priority, Request};
use protocol::can::Frame;
use protocol::time::Micros;
use protocol::wire_time::{BitRates, Bits};

/// A frame that was to be sent, and when.
pub type Requested = (Micros, Frame);

/// A real bus, and what waits to go out on it.
#[derive(Debug)]
pub(crate) struct RealBus<T> {
    model: BusModel,
    waiting: BTreeMap<u64, T>,
    /// When it is looked at next, if that has been entered.
    pub(crate) look: Option<Micros>,
    pub(crate) requested: Vec<Requested>,
    pub(crate) attempts: Vec<Attempt>,
}

impl<T> RealBus<T> {
    pub(crate) const fn new(rates: BitRates) -> Self {
        Self {
            model: BusModel::new(rates),
            waiting: BTreeMap::new(),
            look: None,
            requested: Vec::new(),
            attempts: Vec::new(),
        }
    }

    /// A frame is to be sent now.
    pub(crate) fn request(&mut self, now: Micros, frame: &Frame, item: T) {
        let Some(bits) = Bits::of(frame) else { return };
        let tag = u64::try_from(self.requested.len()).unwrap_or(u64::MAX);
        let request = Request { at: now.0 * 1_000, priority: Priority::of(frame), bits, queue: None, tag };
        self.requested.push((now, *frame));
        self.waiting.insert(tag, item);
        self.model.request(request);
    }

    /// What has come to its end by now, and when that was, in whole µs and never too early.
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

    /// When it has to be looked at next.
    pub(crate) fn next(&self) -> Option<Micros> {
        self.model.poll_timeout().map(|nanos| Micros(nanos.div_ceil(1_000)))
    }
}
