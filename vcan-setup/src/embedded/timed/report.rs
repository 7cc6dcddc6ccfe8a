//! The figures of a timed bus.

use std::collections::BTreeMap;

use bus_model::TransmitQueue;
use protocol::quantiles::{Quantiles, TimeHistogram};
use protocol::wire_time::BitRates;
use serde::{Deserialize, Serialize};

/// Delay of a delivery after the end of its frame from which the server counts as behind, in ns.
const BEHIND_NS: u64 = 1_000_000;

/// The figures of a timed bus since its start.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
pub struct TimedReport {
    /// Bit rates, such as `1M/5M`.
    pub rates: String,
    /// The transmit queue of each client, such as `priority:32`.
    pub queue: String,
    /// Share of bits that arrive damaged.
    pub bit_error_rate: f64,
    /// Seed of the bit errors.
    pub seed: u64,
    /// Frames that were put into transmit queues.
    pub requested: u64,
    /// Frames that were sent.
    pub sent: u64,
    /// Transmissions that were damaged.
    pub damaged: u64,
    /// Frames that a full transmit queue refused.
    pub refused: u64,
    /// Frames that only a bench sends, and which passed beside the bus.
    pub beside: u64,
    /// Frames that wait to be sent.
    pub waiting: u64,
    /// Largest number of frames that have waited at the same time.
    pub max_waiting: u64,
    /// Time in s for which the bus was busy.
    pub busy_s: f64,
    /// Share of the time between the ends of the first and the last joints for which the bus was busy; `None` before the
    /// second joints.
    pub load: Option<f64>,
    /// Time from a request to the end of the frame.
    pub wait_us: Quantiles,
    /// Time from the end of a frame to its delivery to the last client.
    pub delay_us: Quantiles,
    /// Number of times that the server fell behind: it delivered frames more than 1 ms after their ends.
    pub behind: u64,
    /// Refused frames by identifier, with the flags of `can_id`, in hexadecimal.
    pub refused_by_id: BTreeMap<String, u64>,
    /// Waiting frames by identifier, with the flags of `can_id`, in hexadecimal.
    pub waiting_by_id: BTreeMap<String, u64>,
    /// The reason why the record is incomplete.
    pub record_failure: Option<String>,
}

/// The counters of a timed bus.
#[derive(Debug, Default)]
pub(super) struct Counts {
    pub(super) requested: u64,
    pub(super) sent: u64,
    pub(super) damaged: u64,
    pub(super) beside: u64,
    pub(super) busy_ns: u64,
    refused_by_id: BTreeMap<u32, u64>,
    /// End and busy time before it, of the first and the last joints.
    joints: Option<[(u64, u64); 2]>,
    pub(super) waits: TimeHistogram,
    delays: TimeHistogram,
    is_behind: bool,
    behind: u64,
}

impl Counts {
    pub(super) fn refuse(&mut self, raw_id: u32) {
        *self.refused_by_id.entry(raw_id).or_default() += 1;
    }

    /// Notes joints that ended on the bus.
    pub(super) fn mark_joints(&mut self, end: u64) {
        let mark = (end, self.busy_ns);
        let [first, _] = self.joints.unwrap_or([mark, mark]);
        self.joints = Some([first, mark]);
    }

    pub(super) fn record_delay(&mut self, nanos: u64) {
        self.delays.record(nanos);
        let was_behind = std::mem::replace(&mut self.is_behind, nanos > BEHIND_NS);
        self.behind += u64::from(self.is_behind && !was_behind);
    }

    pub(super) fn report(
        &self,
        (rates, queue, bit_error_rate, seed): (BitRates, TransmitQueue, f64, u64),
        waiting: BTreeMap<u32, u64>,
        max_waiting: usize,
        failure: Option<&str>,
    ) -> TimedReport {
        let by_id = |counts: &BTreeMap<u32, u64>| {
            counts.iter().map(|(id, &count)| (format!("{id:X}"), count)).collect()
        };
        let load = self
            .joints
            .filter(|[first, last]| first.0 < last.0)
            .map(|[first, last]| to_f64(last.1 - first.1) / to_f64(last.0 - first.0));
        TimedReport {
            rates: rates.to_string(),
            queue: queue.to_string(),
            bit_error_rate,
            seed,
            requested: self.requested,
            sent: self.sent,
            damaged: self.damaged,
            refused: self.refused_by_id.values().sum(),
            beside: self.beside,
            waiting: waiting.values().sum(),
            max_waiting: max_waiting as u64,
            busy_s: to_f64(self.busy_ns) / 1e9,
            load,
            wait_us: self.waits.quantiles(),
            delay_us: self.delays.quantiles(),
            behind: self.behind,
            refused_by_id: by_id(&self.refused_by_id),
            waiting_by_id: by_id(&waiting),
            record_failure: failure.map(str::to_owned),
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "2^53 ns are 104 days")]
const fn to_f64(nanos: u64) -> f64 {
    nanos as f64
}
