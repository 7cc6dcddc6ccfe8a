//! The result of the model.

use model::quantiles::Times;
use protocol::wire_time::BitRates;
use serde::{Serialize, Serializer};

use crate::fit::traffic::BenchFrames;
use crate::fit::verdict::{Answer, Cells};

/// The result for all buses.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Frames of any kind, on all buses.
    pub frames: u64,
    /// Frames of buses beyond the first 64, which are not modelled.
    pub frames_of_other_buses: u64,
    /// Share of bits that were damaged on purpose.
    pub bit_error_rate: f64,
    /// True if the frames have times; otherwise loads and delays are unknown.
    pub has_times: bool,
    /// The buses, in order of appearance.
    pub buses: Vec<BusShadow>,
}

/// The result for one bus.
#[derive(Clone, Debug, Serialize)]
pub struct BusShadow {
    /// Its name.
    pub bus: String,
    /// Its format and bit rates, as text.
    pub name: String,
    /// Its bit rates.
    #[serde(serialize_with = "as_text")]
    pub rates: BitRates,
    /// Frames of any kind.
    pub frames: u64,
    /// The time of the first frame, in ns of the capture's clock.
    pub first_ns: u64,
    /// The origin of times in s, in ns of the same clock; by default the first frame.
    #[serde(skip)]
    pub zero_ns: u64,
    /// The time from the first frame to the last.
    pub duration_s: f64,
    /// The duration of operation, for which load, stretches, delays and queues are computed.
    pub operation_s: f64,
    /// The fit in the worst case, with all cells of the skin answering; `None` without a skin.
    pub worst_case: Option<Answer>,
    /// The fit of the captured traffic; `None` without operation.
    pub this_run: Option<Answer>,
    /// The answering cells, if the bus carries this project's protocol.
    pub answering: Option<Answering>,
    /// The traffic before the first joints, and without joints for a second.
    pub start_up: Option<StartUp>,
    /// The counts of frames.
    #[serde(flatten)]
    pub counts: Counts,
    /// The requested load of the bus.
    pub load: Loads,
    /// Stretches without a pause.
    pub stretches: Stretches,
    /// Delays from the request of a frame to the end of its intermission, in µs, over all frames.
    pub delay_us: Delays,
    /// Delays by kind; empty if the bus carries another protocol.
    pub kinds: Vec<KindDelays>,
    /// Answers to joints, if the bus carries this project's protocol.
    pub replies: Option<Replies>,
    /// The largest number of waiting frames.
    pub queue: Peak,
    /// The largest number of waiting frames of one 11-bit identifier.
    pub queue_of_one: Peak,
    /// That identifier.
    pub queue_of_one_id: u32,
}

/// Counts of a bus' frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Counts {
    /// Frames that were sent in the model.
    pub sent: u64,
    /// Frames that only a bench sends.
    pub bench: BenchFrames,
    /// True if these are omitted.
    pub bench_omitted: bool,
    /// The driver's error frames, which were never on a wire.
    pub error_frames: u64,
    /// Frames that the recorder lost: the load is too low by these.
    pub missing: u64,
    /// Frames with an earlier time than the previous one, which were sorted.
    pub out_of_order: u64,
    /// Frames that were so far out of order that they count at a later time.
    pub too_late_to_sort: u64,
    /// Frames that were refused because the queue was full.
    pub no_room: u64,
    /// Damaged transmissions.
    pub damaged: u64,
}

/// The start-up, in which cells claim node ids, are configured and build the tree.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct StartUp {
    /// Frames.
    pub frames: u64,
    /// Its duration.
    pub duration_s: f64,
    /// The requested load of the bus.
    pub load: Loads,
    /// Stretches without a pause.
    pub stretches: Stretches,
    /// Delays from the request of a frame to the end of its intermission, in µs.
    pub delay_us: Delays,
}

/// The shares of the bus' time that frames request, including stuff bits and intermissions; above 1 the bus cannot
/// carry them.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Loads {
    /// Mean over the whole time; `None` with fewer than two different times.
    pub mean: Option<f64>,
    /// The highest load within any 16 ms.
    pub worst_16_ms: Peak,
    /// The highest load within any second, or within the whole time if that is shorter.
    pub worst_1_s: Peak,
    /// The share of time in which the bus was busy.
    pub busy: Option<f64>,
}

/// The maximum of a quantity, and its time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Peak {
    /// The maximum.
    pub value: f64,
    /// The time or the start of the maximum, in ns of the capture's clock.
    pub at_ns: u64,
}

impl Peak {
    /// Records a value if it exceeds the maximum.
    pub(super) fn raise(&mut self, value: f64, at_ns: u64) {
        if value > self.value {
            *self = Self { value, at_ns };
        }
    }
}

/// Stretches in which the bus had no pause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Stretches {
    /// Number of stretches of at least 16 ms.
    pub count: u64,
    /// Their total duration.
    pub total_s: f64,
    /// The longest stretch of all.
    pub longest_s: Peak,
}

/// Quantiles of a duration, in µs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Delays {
    /// Number of values.
    pub count: u64,
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

/// The delays of one kind.
#[derive(Clone, Debug, Serialize)]
pub struct KindDelays {
    /// Its name.
    pub kind: &'static str,
    /// The delays.
    pub delay_us: Delays,
}

/// The number of cells that answered, over epochs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Answering {
    /// Number of joints that were sent while cells were not halted.
    pub epochs: u64,
    /// Number of joints that were sent while cells were halted.
    pub epochs_halted: u64,
    /// The mean number of cells that answered joints; absent without joints.
    pub mean: Option<f64>,
    /// The largest number of cells that answered the same joints.
    pub most: u32,
    /// Number of cells on the bus: the skin's, or else those that sent something.
    pub cells: u32,
    /// True if that number is the skin's.
    pub described: bool,
}

impl Answering {
    /// Returns the figures in the form of [`crate::fit::verdict`].
    #[must_use]
    pub const fn cells(&self) -> Cells {
        Cells::Some { most: self.most, cells: self.cells, described: self.described }
    }
}

/// Answers to joints.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Replies {
    /// Number of answers.
    pub count: u64,
    /// Answers that were already later than the next joints in the recording.
    pub late_before: u64,
    /// Answers that ended after the next joints were to be sent, without being late in the recording.
    pub late: u64,
    /// Late answers that were ready only in the last eighth of the period: the bus is not the cause.
    pub late_when_ready: u64,
    /// Times from the request of joints to the end of each answer, in µs.
    pub after_joints_us: Delays,
}

impl Delays {
    pub(super) fn from_times(times: &Times) -> Self {
        let (histogram, most) = (times.histogram(), times.longest());
        let micros = |nanos: u64| nanos as f64 / 1e3;
        let quantile = |share| micros(histogram.value_at_quantile(share).min(most));
        Self { count: histogram.len(), p50: quantile(0.5), p99: quantile(0.99), max: micros(most) }
    }
}

fn as_text<S: Serializer>(rates: &BitRates, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(rates)
}
