//! A model of a real bus for the wire of a bench: with bit rates, arbitration and queues.

use std::collections::BTreeMap;
use std::num::NonZeroU32;

use bus_model::{Attempt, BusFrame, NodeBus, QueueOrder, TransmitQueue};
use protocol::can::Frame;
use protocol::time::Micros;
use protocol::wire_time::BitRates;

/// A requested frame, with the time of the request.
pub type Requested = (Micros, Frame);

/// A transmit queue in which every frame of all cells takes part in arbitration.
const EVERY_FRAME: TransmitQueue = TransmitQueue { order: QueueOrder::Priority, depth: NonZeroU32::MAX };

/// A real bus, and the frames that wait for it.
#[derive(Debug)]
pub(crate) struct RealBus<T> {
    bus: NodeBus<u64>,
    waiting: BTreeMap<u64, T>,
    /// The time at which the bus is advanced next, if that is scheduled.
    pub(crate) next_advance: Option<Micros>,
    pub(crate) requested: Vec<Requested>,
    pub(crate) attempts: Vec<Attempt>,
}

impl<T> RealBus<T> {
    pub(crate) fn new(rates: BitRates) -> Self {
        Self {
            bus: NodeBus::new(rates, EVERY_FRAME, None),
            waiting: BTreeMap::new(),
            next_advance: None,
            requested: Vec::new(),
            attempts: Vec::new(),
        }
    }

    /// Requests the transmission of a frame.
    pub(crate) fn request(&mut self, now: Micros, frame: &Frame, item: T) {
        let Some(on_bus) = BusFrame::from_frame(frame) else { return };
        let tag = u64::try_from(self.requested.len()).unwrap_or(u64::MAX);
        if self.bus.request(now.0 * 1_000, 0, on_bus, tag).is_ok() {
            self.requested.push((now, *frame));
            self.waiting.insert(tag, item);
        }
    }

    /// Returns the frames whose transmission has ended until now, with the times of their ends in whole µs, rounded up.
    pub(crate) fn ended(&mut self, now: Micros) -> Vec<(Micros, T)> {
        self.bus.advance(now.0 * 1_000);
        let mut ended = Vec::new();
        while let Some(attempt) = self.bus.poll() {
            self.attempts.push(attempt);
            let item = self.waiting.remove(&attempt.tag);
            ended.extend(item.map(|item| (Micros(attempt.end.div_ceil(1_000)), item)));
        }
        ended
    }

    /// Returns the time at which the bus must be advanced next.
    pub(crate) fn next(&self) -> Option<Micros> {
        self.bus.poll_timeout().map(|nanos| Micros(nanos.div_ceil(1_000)))
    }
}
