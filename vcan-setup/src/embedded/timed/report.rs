//! The figures of a timed bus.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use bus_model::TransmitQueue;
use protocol::bus::embedded::{FiguresRequest, MAX_FIGURES_BYTES};
use protocol::quantiles::{Quantiles, TimeHistogram};
use protocol::wire_time::BitRates;
use serde::{Deserialize, Serialize};

/// Delay of a delivery after the end of its frame from which the server counts as behind, in ns.
const BEHIND_NS: u64 = 1_000_000;

/// Time in ns after which joints begin another run.
const MAX_JOINTS_GAP_NS: u64 = 1_000_000_000;

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
    /// second joints. Joints after a second without any are first ones.
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

impl TimedReport {
    /// Returns the report as JSON. Leaves out the identifiers if they would not fit into a datagram.
    #[must_use]
    pub fn to_json(&self) -> Vec<u8> {
        let bytes = serde_json::to_vec(self).unwrap_or_default();
        if bytes.len() <= MAX_FIGURES_BYTES {
            return bytes;
        }
        let (refused_by_id, waiting_by_id) = <_>::default();
        serde_json::to_vec(&Self { refused_by_id, waiting_by_id, ..self.clone() }).unwrap_or_default()
    }

    /// Requests the present report from the server of a bus in `directory`, or else in the usual one, and waits for it.
    /// Returns `None` if the server does not answer in time, or if frames take no time on its bus.
    #[must_use]
    pub fn request(name: &str, directory: Option<&Path>, timeout: Duration) -> Option<Self> {
        Self::from_json(&FiguresRequest::send(name, directory).ok()?.receive(timeout)?)
    }

    /// Returns the report with the counts since an earlier report of the same server. Quantiles and maxima stay those since the
    /// server's start.
    #[must_use]
    pub fn since(mut self, earlier: &Self) -> Self {
        // Another server has begun to count again.
        if [(self.requested, earlier.requested), (self.beside, earlier.beside)]
            .iter()
            .any(|(now, then)| now < then)
        {
            return self;
        }
        for (now, then) in [
            (&mut self.requested, earlier.requested),
            (&mut self.sent, earlier.sent),
            (&mut self.damaged, earlier.damaged),
            (&mut self.refused, earlier.refused),
            (&mut self.beside, earlier.beside),
            (&mut self.behind, earlier.behind),
        ] {
            *now = now.saturating_sub(then);
        }
        self.busy_s = (self.busy_s - earlier.busy_s).max(0.0);
        for (id, count) in &earlier.refused_by_id {
            if let Some(now) = self.refused_by_id.get_mut(id) {
                *now = now.saturating_sub(*count);
            }
        }
        self.refused_by_id.retain(|_, count| *count > 0);
        self
    }

    /// Reads a report from JSON; `None` if it is none.
    #[must_use]
    pub fn from_json(bytes: &[u8]) -> Option<Self> {
        serde_json::from_slice(bytes).ok()
    }
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
        let first = match self.joints {
            Some([first, last]) if end - last.0 <= MAX_JOINTS_GAP_NS => first,
            Some(_) | None => mark,
        };
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_on_a_bus_that_others_used_before_counts_from_its_own_start() {
        let report = |requested, refused: &[(&str, u64)]| TimedReport {
            requested,
            refused: refused.iter().map(|(_, count)| count).sum(),
            refused_by_id: refused.iter().map(|&(id, count)| (id.to_owned(), count)).collect(),
            busy_s: requested as f64,
            ..TimedReport::default()
        };
        let (before, after) =
            (report(5, &[("201", 3), ("202", 1)]), report(9, &[("201", 3), ("202", 4), ("203", 1)]));
        let run = after.clone().since(&before);
        assert_eq!((run.requested, run.refused, run.busy_s), (4, 4, 4.0));
        let by_id: Vec<_> = run.refused_by_id.iter().map(|(id, count)| (id.as_str(), *count)).collect();
        assert_eq!(by_id, [("202", 3), ("203", 1)]);
        assert_eq!(after.since(&report(10, &[])).requested, 9, "another server counts");
    }

    #[test]
    fn the_load_is_that_of_the_last_joints_without_a_gap() {
        let mut counts = Counts::default();
        let queue = "fifo:1".parse().unwrap();
        let load = |counts: &Counts| {
            counts.report(("1M".parse().unwrap(), queue, 0.0, 1), BTreeMap::new(), 0, None).load
        };
        for (end, busy) in [(0, 0), (1_000_000_000, 500_000_000)] {
            counts.busy_ns = busy;
            counts.mark_joints(end);
        }
        assert_eq!(load(&counts), Some(0.5));
        // Nobody sends for a minute; then another run begins.
        counts.mark_joints(61_000_000_000);
        assert_eq!(load(&counts), None);
        counts.busy_ns += 250_000_000;
        counts.mark_joints(62_000_000_000);
        assert_eq!(load(&counts), Some(0.25));
    }

    #[test]
    fn what_does_not_fit_into_a_datagram_goes_without_identifiers() {
        let refused_by_id = (0..20_000).map(|id| (format!("{id:08X}"), 1)).collect();
        let report = TimedReport { refused: 20_000, refused_by_id, ..TimedReport::default() };
        let bytes = report.to_json();
        assert!(bytes.len() <= MAX_FIGURES_BYTES);
        let read = TimedReport::from_json(&bytes).unwrap();
        assert_eq!((read.refused, read.refused_by_id.len()), (20_000, 0));
        assert_eq!(TimedReport::from_json(b"skinbus"), None);
    }
}
