//! What a shadow adds up to.

use model::quantiles::Times;
use protocol::wire_time::BitRates;
use serde::{Serialize, Serializer};

use crate::fit::traffic::BenchFrames;
use crate::fit::verdict::{Answer, Cells};

/// All buses.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Frames of any kind, on all buses.
    pub frames: u64,
    /// Of those, frames of buses beyond the first 64, which are not modelled.
    pub frames_of_other_buses: u64,
    /// The share of bits that were damaged on purpose.
    pub bit_error_rate: f64,
    /// Set if the frames have times; without, loads and delays are unknown.
    pub has_times: bool,
    /// Each bus, in the order in which they were met.
    pub buses: Vec<BusShadow>,
}

/// One bus.
#[derive(Clone, Debug, Serialize)]
pub struct BusShadow {
    /// Its name.
    pub bus: String,
    /// Its format and bit rates, as people write them.
    pub name: String,
    /// Its bit rates.
    #[serde(serialize_with = "as_text")]
    pub rates: BitRates,
    /// Frames of any kind.
    pub frames: u64,
    /// The time of the first one, in ns of the capture's clock.
    pub first_ns: u64,
    /// The time that seconds count from, in ns of the same clock: the first frame, if nothing else is known.
    #[serde(skip)]
    pub zero_ns: u64,
    /// From the first to the last one.
    pub duration_s: f64,
    /// How long it was in operation: load, stretches, delays and queues are of that time.
    pub operation_s: f64,
    /// Whether all cells of the skin fit if all of them answer; none without a skin.
    pub worst_case: Option<Answer>,
    /// Whether what there was fits; none without operation.
    pub this_run: Option<Answer>,
    /// How many cells answered, where the bus has this project's protocol.
    pub answering: Option<Answering>,
    /// What was sent before the first joints, and when there were none for a second.
    pub start_up: Option<StartUp>,
    /// What became of the frames.
    #[serde(flatten)]
    pub counts: Counts,
    /// What was asked of the bus.
    pub load: Loads,
    /// Times without a pause.
    pub stretches: Stretches,
    /// From wanting to send to the end of the intermission, in µs: all frames.
    pub delay_us: Delays,
    /// The same by kind; empty where the bus has another protocol.
    pub kinds: Vec<KindDelays>,
    /// Answers to joints, where the bus has this project's protocol.
    pub replies: Option<Replies>,
    /// The most frames that waited at the same time.
    pub queue: Most,
    /// The most frames of one identifier of 11 bits that waited at the same time.
    pub queue_of_one: Most,
    /// That identifier.
    pub queue_of_one_id: u32,
}

/// What became of a bus' frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Counts {
    /// Frames that went through the model.
    pub sent: u64,
    /// Frames that only a bench sends.
    pub bench: BenchFrames,
    /// Whether they are left out.
    pub bench_omitted: bool,
    /// The driver's error frames, which never were on a wire.
    pub error_frames: u64,
    /// Frames that the recorder lost: the load is too low by these.
    pub missing: u64,
    /// Frames before the one before them, which were sorted.
    pub out_of_order: u64,
    /// Of those, so far out of order that they count at a later time.
    pub too_late_to_sort: u64,
    /// Frames for which no more room was to wait.
    pub no_room: u64,
    /// Attempts that were damaged.
    pub damaged: u64,
}

/// Start-up: cells claim numbers, are configured and organise themselves.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct StartUp {
    /// Frames.
    pub frames: u64,
    /// How long it lasted.
    pub duration_s: f64,
    /// What was asked of the bus.
    pub load: Loads,
    /// Times without a pause.
    pub stretches: Stretches,
    /// From wanting to send to the end of the intermission, in µs.
    pub delay_us: Delays,
}

/// Shares of the bus that frames ask for, stuff bits and intermissions included; above 1 it cannot carry them.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Loads {
    /// Over all of the time; none with less than two moments.
    pub mean: Option<f64>,
    /// Within any 16 ms.
    pub worst_16_ms: Most,
    /// Within any second; of less than a second, in all of it.
    pub worst_1_s: Most,
    /// The share of the time in which the bus was taken, by whatever.
    pub busy: Option<f64>,
}

/// The maximum of something, and when.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Most {
    /// How much.
    pub value: f64,
    /// When that was or began, in ns of the capture's clock.
    pub at_ns: u64,
}

impl Most {
    /// Takes a value of a time if it is greater than any before it.
    pub(super) fn raise(&mut self, value: f64, at_ns: u64) {
        if value > self.value {
            *self = Self { value, at_ns };
        }
    }
}

/// Times in which the bus had no pause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Stretches {
    /// How many of 16 ms and longer.
    pub count: u64,
    /// How long those are together.
    pub total_s: f64,
    /// The longest of all.
    pub longest_s: Most,
}

/// How long something took, in µs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Delays {
    /// Of how many.
    pub count: u64,
    /// Half of them at most so long.
    pub p50: f64,
    /// 99 of 100 at most so long.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

/// The delays of one kind.
#[derive(Clone, Debug, Serialize)]
pub struct KindDelays {
    /// Its name.
    pub kind: &'static str,
    /// How long it took.
    pub delay_us: Delays,
}

/// Cells that answered, epoch by epoch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Answering {
    /// Joints that were sent while cells were not halted.
    pub epochs: u64,
    /// Joints that were sent while they were.
    pub epochs_halted: u64,
    /// The mean number of cells that answered joints; absent without joints.
    pub mean: Option<f64>,
    /// The largest number of cells that answered the same joints.
    pub most: u32,
    /// Cells of the bus, by the skin, else those that were received.
    pub cells: u32,
    /// True if that number is the skin's.
    pub described: bool,
}

impl Answering {
    /// In the words of [`crate::fit::verdict`].
    #[must_use]
    pub const fn cells(&self) -> Cells {
        Cells::Some { most: self.most, cells: self.cells, described: self.described }
    }
}

/// Answers to joints.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Replies {
    /// How many were looked at.
    pub count: u64,
    /// Those that the next joints had overtaken in the recording already.
    pub late_before: u64,
    /// Those that came to their end only after the next joints were to go out, and had not been late before.
    pub late: u64,
    /// Of those, the ones that were ready only in the last eighth of the period: no bus is to blame.
    pub late_when_ready: u64,
    /// From when joints were to go out to the end of each answer, in µs.
    pub after_joints_us: Delays,
}

impl Delays {
    pub(super) fn of(times: &Times) -> Self {
        let (histogram, most) = (times.histogram(), times.longest());
        let micros = |nanos: u64| nanos as f64 / 1e3;
        let quantile = |share| micros(histogram.value_at_quantile(share).min(most));
        Self { count: histogram.len(), p50: quantile(0.5), p99: quantile(0.99), max: micros(most) }
    }
}

fn as_text<S: Serializer>(rates: &BitRates, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(rates)
}
