//! A bus on which frames take time: requests of the clients go through a model of a real bus, and are delivered when it
//! has sent them.
//!
//! ```text
//!   client ──> collect ──> [ requests of a round, by time ] ──> NodeBus ──> deliveries, with their stamps
//!                                     └─ only a bench sends it ───────────────^   └─> record
//! ```
//!
//! Each client is a node with a transmit queue. The time of a request is the kernel's, when the client sent it, unless
//! the server has decided later arbitrations already. Nothing here reads a clock or a socket.

use std::collections::{BTreeMap, HashMap};

use bus_model::traffic::{RunEvent, TrafficClassifier};
use bus_model::{BitErrors, BusFrame, NodeBus, TransmitQueue};
use protocol::can::Frame;
use protocol::wire_time::BitRates;

use super::parcel::FrameDatagram;
use super::routing::ClientId;

mod clock;
mod record;
mod report;

pub(super) use clock::BusClock;
pub use record::BusRecord;
use report::Counts;
pub use report::TimedReport;

/// Time for which the end of a frame may be delivered late while others wait, so that one wake-up delivers several, in
/// ns.
const GATHER_NS: u64 = 100_000;

/// The properties of a timed bus.
#[derive(Debug)]
pub struct TimedBusOptions {
    /// Bit rates.
    pub rates: BitRates,
    /// The transmit queue of each client.
    pub queue: TransmitQueue,
    /// Share of bits that arrive damaged, 0 to [`BitErrors::MAX_RATE`].
    pub bit_error_rate: f64,
    /// Seed of the bit errors.
    pub seed: u64,
    /// True if frames that only a bench sends take time, too.
    pub counts_bench_traffic: bool,
    /// The record of all requests and transmissions.
    pub record: Option<BusRecord>,
}

/// A frame that a client has requested to send.
#[derive(Clone, Copy, Debug)]
struct RequestedFrame {
    /// Time of the request in ns.
    at: u64,
    /// The client; `None` if it has disconnected.
    from: Option<ClientId>,
    node: u16,
    parcel: FrameDatagram,
    frame: Frame,
    is_bench: bool,
    is_joints: bool,
}

/// A frame for the clients that receive it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Delivery {
    /// The sender; `None` if it has disconnected.
    pub(super) from: Option<ClientId>,
    pub(super) parcel: FrameDatagram,
    /// End of the frame on the bus, in ns since 1970.
    pub(super) stamp: u64,
    /// True if the frame has passed beside the bus.
    pub(super) is_bench: bool,
}

/// A frame that the transmit queue of its client has refused.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refusal {
    pub(super) from: ClientId,
    pub(super) raw_id: u32,
}

/// The effects of a round on the clients, in order.
#[derive(Debug, Default)]
pub(super) struct RoundEffects {
    pub(super) deliveries: Vec<Delivery>,
    pub(super) refusals: Vec<Refusal>,
}

/// The state of a timed bus.
#[derive(Debug)]
pub(super) struct TimedBus {
    options: TimedBusOptions,
    bus: NodeBus<u64>,
    traffic: TrafficClassifier,
    /// Requests that were read in this round.
    collected: Vec<RequestedFrame>,
    /// Frames in transmit queues, by the number of their request.
    queued: HashMap<u64, RequestedFrame>,
    requests: u64,
    counts: Counts,
}

impl TimedBus {
    /// Creates an idle bus.
    ///
    /// # Errors
    /// Returns the reason if the bit-error rate is out of range.
    pub(super) fn new(options: TimedBusOptions) -> Result<Self, bus_model::BitErrorsError> {
        let errors = BitErrors::new(options.bit_error_rate, options.seed)?;
        let errors = (options.bit_error_rate > 0.0).then_some(errors);
        let mut timed = Self {
            bus: NodeBus::new(options.rates, options.queue, errors),
            options,
            traffic: TrafficClassifier::default(),
            collected: Vec::new(),
            queued: HashMap::new(),
            requests: 0,
            counts: Counts::default(),
        };
        let TimedBusOptions { rates, queue, bit_error_rate, seed, .. } = timed.options;
        if let Some(record) = &mut timed.options.record {
            record.begin(rates, queue, bit_error_rate, seed);
        }
        Ok(timed)
    }

    /// Collects a frame that a client sent at a time in ns, until the round ends.
    pub(super) fn collect(&mut self, at: u64, from: ClientId, parcel: FrameDatagram) {
        let Some(Ok(frame)) = parcel.bytes().get(..parcel.byte_len()).map(Frame::from_bytes) else { return };
        let sorted = self.traffic.classify(at, &frame);
        if sorted.bench.is_some() && sorted.ends_pair {
            // A cell sends the two frames of a packet at once, so the first one mostly is in this round, too.
            let mut earlier = self.collected.iter_mut().rev();
            let first = earlier.find(|it| it.from == Some(from) && it.parcel.raw_id() == parcel.raw_id());
            first.into_iter().for_each(|first| first.is_bench = true);
        }
        self.collected.push(RequestedFrame {
            at,
            from: Some(from),
            node: u16::try_from(from.0).unwrap_or(u16::MAX),
            parcel,
            frame,
            is_bench: sorted.bench.is_some(),
            is_joints: matches!(sorted.says, RunEvent::Joints(_)),
        });
    }

    /// Ends a round at a time in ns: requests the collected frames, and advances the bus.
    pub(super) fn end_round(&mut self, now: u64, effects: &mut RoundEffects) {
        let mut collected = std::mem::take(&mut self.collected);
        // Frames of one client are in the order in which it sent them.
        collected.sort_by_key(|requested| requested.at);
        for requested in collected.drain(..) {
            self.request(now, requested, effects);
        }
        self.collected = collected;
        // Later requests are later than this, so frames that wait can be arbitrated at `now`.
        self.bus.advance(now + 1);
        self.take_sent(effects);
    }

    fn request(&mut self, now: u64, mut requested: RequestedFrame, effects: &mut RoundEffects) {
        let number = self.requests;
        self.requests += 1;
        requested.at = self.bus.advance(requested.at.min(now));
        self.take_sent(effects);
        let RequestedFrame { at, from, node, parcel, frame, is_bench, .. } = requested;
        let takes_time = !is_bench || self.options.counts_bench_traffic;
        let (word, shown) = match BusFrame::from_frame(&frame).filter(|_| takes_time) {
            None => {
                self.counts.beside += 1;
                effects.deliveries.push(Delivery { from, parcel, stamp: at, is_bench: true });
                ('B', None)
            }
            Some(on_bus) if self.bus.request(at, node, on_bus, number).is_ok() => {
                self.counts.requested += 1;
                self.queued.insert(number, requested);
                ('Q', Some(number))
            }
            Some(_) => {
                self.counts.refuse(frame.raw_id());
                let refusal = from.map(|from| Refusal { from, raw_id: frame.raw_id() });
                effects.refusals.extend(refusal);
                ('X', None)
            }
        };
        if let Some(record) = &mut self.options.record {
            record.write_request(word, shown, at, node, &frame);
        }
    }

    /// Moves the frames that the bus has sent to the deliveries.
    fn take_sent(&mut self, effects: &mut RoundEffects) {
        while let Some(sent) = self.bus.poll() {
            if let Some(record) = &mut self.options.record {
                record.write_transmission(&sent);
            }
            self.counts.busy_ns += sent.end - sent.start;
            if sent.is_damaged {
                self.counts.damaged += 1;
                continue;
            }
            let Some(RequestedFrame { at, from, parcel, is_joints, .. }) = self.queued.remove(&sent.tag)
            else {
                continue;
            };
            self.counts.sent += 1;
            self.counts.waits.record(sent.end - at);
            if is_joints {
                self.counts.mark_joints(sent.end);
            }
            effects.deliveries.push(Delivery { from, parcel, stamp: sent.end, is_bench: false });
        }
    }

    /// Records that deliveries were sent to all clients at a time in ns.
    pub(super) fn note_delivered(&mut self, now: u64, deliveries: &[Delivery]) {
        for delivery in deliveries.iter().filter(|delivery| !delivery.is_bench) {
            self.counts.record_delay(now.saturating_sub(delivery.stamp));
        }
    }

    /// Returns the time in ns at which the next round must end; `None` if no frame waits.
    pub(super) fn wake_time(&self) -> Option<u64> {
        let gather = if self.bus.waiting() > 1 { GATHER_NS } else { 0 };
        Some(self.bus.poll_timeout()? + gather)
    }

    /// Forgets a client that has disconnected. Its frames are still sent.
    pub(super) fn forget_client(&mut self, id: ClientId) {
        let all = self.queued.values_mut().chain(&mut self.collected);
        all.filter(|requested| requested.from == Some(id)).for_each(|requested| requested.from = None);
    }

    /// Returns the figures so far.
    pub(super) fn report(&mut self) -> TimedReport {
        if let Some(record) = &mut self.options.record {
            record.flush();
        }
        let mut waiting = BTreeMap::new();
        for requested in self.queued.values() {
            *waiting.entry(requested.frame.raw_id()).or_default() += 1;
        }
        let TimedBusOptions { rates, queue, bit_error_rate, seed, ref record, .. } = self.options;
        let failure = record.as_ref().and_then(BusRecord::failure);
        self.counts.report((rates, queue, bit_error_rate, seed), waiting, self.bus.max_waiting(), failure)
    }
}

#[cfg(test)]
mod tests;
