//! Splits the traffic of a bus into start-up and operation, and keeps the figures of each phase.

use protocol::id::{Id, Kind};
use protocol::quantiles::TimeHistogram;

use super::load::{BusyTime, LoadWindow};
use super::report::{DelayQuantiles, KindDelays, Loads, Peak, StartUpFigures};
use super::{SATURATED_NS, SECOND_NS};
use bus_model::traffic::RunEvent;

/// Time without joints after which operation ends, in ns.
pub const OPERATION_PAUSE_NS: u64 = SECOND_NS;
/// Maximum time to the first joints of a capture that begins in the middle of a run, in ns: some periods of joints, and
/// less than cells need to start.
const MAX_FIRST_JOINTS_NS: u64 = 100_000_000;

/// The phase in which a bus is.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum BusPhase {
    /// Cells claim node ids, are configured and build the tree. This phase lasts until the first joints, and begins
    /// again when no joints were sent for [`OPERATION_PAUSE_NS`].
    StartUp,
    /// Joints are sent, or the bus carries another protocol.
    Operation,
}

/// One value for each phase.
#[derive(Debug, Default)]
pub(super) struct ByPhase<T> {
    pub(super) start_up: T,
    pub(super) operation: T,
}

impl<T> ByPhase<T> {
    pub(super) const fn get_mut(&mut self, phase: BusPhase) -> &mut T {
        match phase {
            BusPhase::StartUp => &mut self.start_up,
            BusPhase::Operation => &mut self.operation,
        }
    }
}

/// The traffic at the start of a capture, which decides whether the capture begins in the middle of a run.
#[derive(Debug, Default)]
pub(super) struct CaptureStart {
    first: Option<u64>,
    joints: Option<u64>,
    is_prepared: bool,
    is_answered: bool,
    /// True if joints were sent before the capture.
    pub(super) is_mid_run: bool,
}

impl CaptureStart {
    pub(super) fn record_event(&mut self, at: u64, says: RunEvent) {
        let first = self.first.unwrap_or(at).min(at);
        self.first = Some(first);
        if self.joints.is_some() {
            return;
        }
        match says {
            RunEvent::Joints(_) => self.joints = Some(at),
            RunEvent::Answer(_) => self.is_answered = true,
            RunEvent::Preparation | RunEvent::Resume => self.is_prepared = true,
            RunEvent::Halt | RunEvent::Other => {}
        }
    }

    fn phase(&self, is_ours: bool) -> BusPhase {
        let soon =
            self.joints.zip(self.first).is_some_and(|(joints, first)| joints - first < MAX_FIRST_JOINTS_NS);
        let in_the_middle = self.is_mid_run || self.is_answered || soon && !self.is_prepared;
        if in_the_middle || !is_ours { BusPhase::Operation } else { BusPhase::StartUp }
    }
}

/// The present phase of a bus, and the duration of each phase so far.
#[derive(Debug, Default)]
pub(super) struct PhaseTracker {
    pub(super) beginning: CaptureStart,
    now: Option<BusPhase>,
    /// The time in ns up to which the durations are counted.
    until: u64,
    joints: Option<u64>,
    /// Duration of each phase in ns.
    pub(super) spans: ByPhase<u64>,
}

impl PhaseTracker {
    /// Returns the phase to which a frame belongs; `says` is the role of the frame in the run. Times never decrease.
    pub(super) fn phase_at(&mut self, at: u64, says: RunEvent, is_ours: bool) -> BusPhase {
        let mut now = *self.now.get_or_insert_with(|| {
            self.until = at;
            self.beginning.phase(is_ours)
        });
        let over =
            self.joints.map(|joints| joints.saturating_add(OPERATION_PAUSE_NS)).filter(|&over| over < at);
        if let (BusPhase::Operation, Some(over)) = (now, over) {
            self.count_duration(now, over.max(self.until));
            now = BusPhase::StartUp;
        }
        self.count_duration(now, at);
        if matches!(says, RunEvent::Joints(_)) {
            now = BusPhase::Operation;
            self.joints = Some(at);
        }
        self.now = Some(now);
        now
    }

    fn count_duration(&mut self, phase: BusPhase, at: u64) {
        *self.spans.get_mut(phase) += at - self.until;
        self.until = at;
    }

    pub(super) fn current_phase(&self) -> BusPhase {
        self.now.unwrap_or(BusPhase::StartUp)
    }
}

/// The load, delays and queues in one phase.
#[derive(Debug, Default)]
pub(super) struct PhaseFigures {
    pub(super) frames: u64,
    requested: u64,
    in_16_ms: LoadWindow<SATURATED_NS>,
    in_1_s: LoadWindow<SECOND_NS>,
    pub(super) busy: BusyTime,
    pub(super) all: TimeHistogram,
    kinds: [TimeHistogram; 8],
    /// The largest number of waiting frames in all; in the next field, of one identifier.
    pub(super) queue: Peak,
    pub(super) queue_of_one: Peak,
    pub(super) queue_of_one_id: u16,
}

impl PhaseFigures {
    /// Records a frame that is requested at `at` and takes `took` ns of the bus.
    pub(super) fn record_request(&mut self, at: u64, took: u64) {
        self.frames += 1;
        self.requested += took;
        self.in_16_ms.record_request(at, took);
        self.in_1_s.record_request(at, took);
    }

    /// Records the number of frames that wait at `at`, in all and of one identifier.
    pub(super) fn record_queue(&mut self, at: u64, waiting: usize, of_one: Option<(u32, u16)>) {
        self.queue.raise_to(waiting as f64, at);
        if let Some((queued, id)) = of_one.filter(|(queued, _)| f64::from(*queued) > self.queue_of_one.value)
        {
            self.queue_of_one.raise_to(f64::from(queued), at);
            self.queue_of_one_id = id;
        }
    }

    /// Records a frame that was sent `nanos` ns after its request.
    pub(super) fn record_sent(&mut self, id: Option<u16>, nanos: u64) {
        self.all.record(nanos);
        let kind = id.and_then(|id| self.kinds.get_mut(Id::from_bits(id).kind as usize));
        kind.into_iter().for_each(|kind| kind.record(nanos));
    }

    pub(super) fn kind_delays(&self) -> Vec<KindDelays> {
        let kinds = Kind::ALL.into_iter().zip(&self.kinds).filter(|(_, delay)| !delay.histogram().is_empty());
        kinds
            .map(|(kind, delay)| KindDelays {
                kind: kind.name(),
                delay_us: DelayQuantiles::from_times(delay),
            })
            .collect()
    }

    /// Returns the loads of a phase that lasted `span` ns; transmissions continued for `overrun` ns after its end.
    pub(super) fn loads(&self, span: u64, overrun: u64) -> Loads {
        let share = |part: u64, whole: u64| (whole > 0).then(|| part as f64 / whole as f64);
        let worst_1_s = self.in_1_s.most;
        let worst_1_s = match span {
            // A phase of less than a second counts as a whole; but not less than 16 ms, so that a few frames are no
            // high load.
            0..SECOND_NS => {
                let all = self.requested as f64 / span.max(SATURATED_NS) as f64;
                Peak { value: worst_1_s.value.max(all), ..worst_1_s }
            }
            _ => worst_1_s,
        };
        let (mean, busy) =
            (share(self.requested, span), share(self.busy.total, span.saturating_add(overrun)));
        Loads { mean, worst_16_ms: self.in_16_ms.most, worst_1_s, busy }
    }

    /// Returns the figures of the start-up, which lasted `span` ns; `None` if it had no frames.
    pub(super) fn start_up(&self, span: u64) -> Option<StartUpFigures> {
        (self.frames > 0).then(|| StartUpFigures {
            frames: self.frames,
            duration_s: span as f64 / 1e9,
            load: self.loads(span, 0),
            stretches: self.busy.stretches(SATURATED_NS),
            delay_us: DelayQuantiles::from_times(&self.all),
        })
    }
}
