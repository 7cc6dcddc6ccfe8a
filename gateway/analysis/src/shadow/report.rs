//! The figures of a timing model: loads, delays, replies and queues of each bus.

use protocol::quantiles::{Quantiles, TimeHistogram};
use protocol::wire_time::BitRates;
use serde::{Serialize, Serializer};

use crate::fit::verdict::{AnsweringCells, FitSummary};
use bus_model::traffic::BenchFrames;

/// The figures of all buses of a capture.
#[derive(Clone, Debug, Serialize)]
pub struct ShadowReport {
    /// Frames of any kind, on all buses.
    pub frames: u64,
    /// Frames of buses beyond the first 64. These buses are not modelled.
    pub frames_of_other_buses: u64,
    /// Share of bits that the model damaged on purpose.
    pub bit_error_rate: f64,
    /// True if the frames have times; otherwise loads and delays are unknown.
    pub has_times: bool,
    /// The buses, in order of appearance.
    pub buses: Vec<BusShadow>,
}

/// The figures of one bus.
#[derive(Clone, Debug, Serialize)]
pub struct BusShadow {
    /// Name of the bus.
    pub bus: String,
    /// Format and bit rates of the bus, as text.
    pub name: String,
    /// Bit rates of the bus.
    #[serde(serialize_with = "as_text")]
    pub rates: BitRates,
    /// True if the time stamps are the ends of frames on a timed bus, so that no delays and queues are known.
    pub is_timed: bool,
    /// Frames of any kind.
    pub frames: u64,
    /// The time of the first frame, in ns of the capture's clock.
    pub first_ns: u64,
    /// The time that counts as 0 s, in ns of the capture's clock; by default that of the first frame.
    #[serde(skip)]
    pub zero_ns: u64,
    /// The time from the first frame to the last, in s.
    pub duration_s: f64,
    /// The duration of operation in s. Load, stretches, delays and queues are computed for this phase.
    pub operation_s: f64,
    /// Load and verdict of the worst case, with all cells of the skin answering; `None` without a skin.
    pub worst_case: Option<FitSummary>,
    /// Load and verdict of the captured traffic; `None` without operation.
    pub this_run: Option<FitSummary>,
    /// The numbers of cells that answered, if the bus carries this project's protocol.
    pub answering: Option<AnsweringCounts>,
    /// The figures of the start-up: the traffic before the first joints, and after a second without joints.
    pub start_up: Option<StartUpFigures>,
    /// The counts of frames.
    #[serde(flatten)]
    pub counts: FrameCounts,
    /// The requested load of the bus.
    pub load: Loads,
    /// Stretches in which the bus carries frames without a pause.
    pub stretches: BusyStretches,
    /// Delays from the request of a frame to the end of its intermission, in µs, over all frames.
    pub delay_us: DelayQuantiles,
    /// Delays by kind; empty if the bus carries another protocol.
    pub kinds: Vec<KindDelays>,
    /// Counts and times of answers to joints, if the bus carries this project's protocol.
    pub replies: Option<ReplyStatistics>,
    /// The largest number of frames that waited to be sent.
    pub queue: Peak,
    /// The largest number of frames of one 11-bit identifier that waited to be sent.
    pub queue_of_one: Peak,
    /// The identifier of which the most frames waited.
    pub queue_of_one_id: u32,
}

/// Counts of the frames of a bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FrameCounts {
    /// Frames that were sent in the model.
    pub sent: u64,
    /// Frames that only a bench sends, by kind.
    pub bench: BenchFrames,
    /// True if the frames that only a bench sends are omitted from the model.
    pub bench_omitted: bool,
    /// The driver's error frames, which were never on a wire.
    pub error_frames: u64,
    /// Frames that the recorder lost. The real load is higher by these frames.
    pub missing: u64,
    /// Frames with an earlier time than the frame before, which were sorted in.
    pub out_of_order: u64,
    /// Frames so far out of order that they could not be sorted in, and count at a later time.
    pub too_late_to_sort: u64,
    /// Frames that were refused because the transmit queue was full.
    pub no_room: u64,
    /// Transmissions that the model damaged; each is repeated.
    pub damaged: u64,
}

/// The figures of a bus's start-up, in which cells claim node ids, are configured and build the tree.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct StartUpFigures {
    /// Number of frames in the start-up.
    pub frames: u64,
    /// Duration of the start-up in s.
    pub duration_s: f64,
    /// The requested load of the bus.
    pub load: Loads,
    /// Stretches in which the bus carries frames without a pause.
    pub stretches: BusyStretches,
    /// Delays from the request of a frame to the end of its intermission, in µs.
    pub delay_us: DelayQuantiles,
}

/// The shares of the bus's time that frames request, including stuff bits and intermissions. A bus cannot carry a load
/// above 1.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Loads {
    /// Mean load over the whole time; `None` with fewer than two different times.
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
    /// The time at which the maximum occurred, or the window with it begins, in ns of the capture's clock.
    pub at_ns: u64,
}

impl Peak {
    /// Replaces the maximum if a value exceeds it.
    pub(super) fn raise_to(&mut self, value: f64, at_ns: u64) {
        if value > self.value {
            *self = Self { value, at_ns };
        }
    }
}

/// Counts and times of stretches in which the bus had no pause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct BusyStretches {
    /// Number of stretches of at least 16 ms.
    pub count: u64,
    /// Total duration of these stretches in s.
    pub total_s: f64,
    /// The longest stretch of all.
    pub longest_s: Peak,
}

/// Quantiles of a duration, in µs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct DelayQuantiles {
    /// Number of values.
    pub count: u64,
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

/// The delays of one kind of frame.
#[derive(Clone, Debug, Serialize)]
pub struct KindDelays {
    /// Name of the kind.
    pub kind: &'static str,
    /// Delays of its frames from request to end, in µs.
    pub delay_us: DelayQuantiles,
}

/// The number of cells that answered joints, over all epochs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct AnsweringCounts {
    /// Number of joints that were sent while cells were not halted.
    pub epochs: u64,
    /// Number of joints that were sent while cells were halted.
    pub epochs_halted: u64,
    /// The mean number of cells that answered joints; absent without joints.
    pub mean: Option<f64>,
    /// The largest number of cells that answered the same joints packet.
    pub most: u32,
    /// Number of cells on the bus: the skin's, or else those that sent something.
    pub cells: u32,
    /// True if `cells` is the number in the skin.
    pub described: bool,
}

impl AnsweringCounts {
    /// Returns the numbers in the form that a verdict uses.
    #[must_use]
    pub const fn cells(&self) -> AnsweringCells {
        AnsweringCells::Some { most: self.most, cells: self.cells, described: self.described }
    }
}

/// Counts and times of answers to joints.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct ReplyStatistics {
    /// Number of answers.
    pub count: u64,
    /// Answers that came after the next joints in the recording itself.
    pub late_before: u64,
    /// Answers that the model sent too late: they ended after the next joints should have been sent. Answers in
    /// `late_before` do not count.
    pub late: u64,
    /// Late answers that cells began to send only in the last eighth of the period, so that the bus is not the cause.
    pub late_when_ready: u64,
    /// Times from the request of joints to the end of each answer, in µs.
    pub after_joints_us: DelayQuantiles,
}

impl DelayQuantiles {
    pub(super) fn from_times(times: &TimeHistogram) -> Self {
        let Quantiles { p50, p99, max, count, .. } = times.quantiles();
        Self { count, p50, p99, max }
    }
}

fn as_text<S: Serializer>(rates: &BitRates, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(rates)
}
