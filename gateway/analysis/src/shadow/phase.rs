//! The phases start-up and operation, and their figures.

use model::quantiles::Times;
use protocol::id::{Id, Kind};

use super::load::{Busy, Window};
use super::report::{Delays, KindDelays, Loads, Peak, StartUp};
use super::{SATURATED_NS, SECOND_NS};
use crate::fit::traffic::RunEvent;

/// Time without joints, in ns, after which operation ends.
pub const PAUSE_NS: u64 = SECOND_NS;
/// Maximum time, in ns, to the first joints in a capture that begins in the middle of a run: some periods, and less
/// than a start takes.
const MAX_FIRST_JOINTS_NS: u64 = 100_000_000;

/// The phase of a bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Phase {
    /// Cells claim node ids, are configured and build the tree: before joints, and when no joints were sent for
    /// [`PAUSE_NS`].
    StartUp,
    /// Joints are sent, or the bus carries another protocol.
    Operation,
}

/// A value for each phase.
#[derive(Debug, Default)]
pub(super) struct ByPhase<T> {
    pub(super) start_up: T,
    pub(super) operation: T,
}

impl<T> ByPhase<T> {
    pub(super) const fn of(&mut self, phase: Phase) -> &mut T {
        match phase {
            Phase::StartUp => &mut self.start_up,
            Phase::Operation => &mut self.operation,
        }
    }
}

/// The start of a capture: observations before the first frame enters the model.
#[derive(Debug, Default)]
pub(super) struct CaptureStart {
    first: Option<u64>,
    joints: Option<u64>,
    is_prepared: bool,
    is_answered: bool,
    /// True if joints were sent before the capture.
    pub(super) in_the_middle: bool,
}

impl CaptureStart {
    pub(super) fn record(&mut self, at: u64, says: RunEvent) {
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

    fn phase(&self, is_ours: bool) -> Phase {
        let soon = self.joints.zip(self.first).is_some_and(|(joints, first)| joints - first < MAX_FIRST_JOINTS_NS);
        let in_the_middle = self.in_the_middle || self.is_answered || soon && !self.is_prepared;
        if in_the_middle || !is_ours { Phase::Operation } else { Phase::StartUp }
    }
}

/// The current phase, and the durations of both.
#[derive(Debug, Default)]
pub(super) struct Phases {
    pub(super) beginning: CaptureStart,
    now: Option<Phase>,
    /// The time up to which durations are counted, in ns.
    until: u64,
    joints: Option<u64>,
    /// Durations in ns.
    pub(super) spans: ByPhase<u64>,
}

impl Phases {
    /// Returns the phase of a frame at a time; times never decrease.
    pub(super) fn at(&mut self, at: u64, says: RunEvent, is_ours: bool) -> Phase {
        let mut now = *self.now.get_or_insert_with(|| {
            self.until = at;
            self.beginning.phase(is_ours)
        });
        let over = self.joints.map(|joints| joints.saturating_add(PAUSE_NS)).filter(|&over| over < at);
        if let (Phase::Operation, Some(over)) = (now, over) {
            self.count(now, over.max(self.until));
            now = Phase::StartUp;
        }
        self.count(now, at);
        if matches!(says, RunEvent::Joints(_)) {
            now = Phase::Operation;
            self.joints = Some(at);
        }
        self.now = Some(now);
        now
    }

    fn count(&mut self, phase: Phase, at: u64) {
        *self.spans.of(phase) += at - self.until;
        self.until = at;
    }

    pub(super) fn now(&self) -> Phase {
        self.now.unwrap_or(Phase::StartUp)
    }
}

/// The figures of one phase.
#[derive(Debug, Default)]
pub(super) struct Figures {
    pub(super) frames: u64,
    requested: u64,
    in_16_ms: Window<SATURATED_NS>,
    in_1_s: Window<SECOND_NS>,
    pub(super) busy: Busy,
    pub(super) all: Times,
    kinds: [Times; 8],
    /// The largest number of waiting frames, of all identifiers and of one.
    pub(super) queue: Peak,
    pub(super) queue_of_one: Peak,
    pub(super) queue_of_one_id: u16,
}

impl Figures {
    /// Records a frame that needs `took` ns of the bus.
    pub(super) fn request(&mut self, at: u64, took: u64) {
        self.frames += 1;
        self.requested += took;
        self.in_16_ms.request(at, took);
        self.in_1_s.request(at, took);
    }

    /// Records the number of waiting frames, in total and of one identifier.
    pub(super) fn queue(&mut self, at: u64, waiting: usize, of_one: Option<(u32, u16)>) {
        self.queue.raise(waiting as f64, at);
        if let Some((queued, id)) = of_one.filter(|(queued, _)| f64::from(*queued) > self.queue_of_one.value)
        {
            self.queue_of_one.raise(f64::from(queued), at);
            self.queue_of_one_id = id;
        }
    }

    /// Records a sent frame and its delay.
    pub(super) fn sent(&mut self, id: Option<u16>, nanos: u64) {
        self.all.record(nanos);
        let kind = id.and_then(|id| self.kinds.get_mut(Id::from_bits(id).kind as usize));
        kind.into_iter().for_each(|kind| kind.record(nanos));
    }

    pub(super) fn kinds(&self) -> Vec<KindDelays> {
        let kinds = Kind::ALL.into_iter().zip(&self.kinds).filter(|(_, delay)| !delay.histogram().is_empty());
        kinds.map(|(kind, delay)| KindDelays { kind: kind.name(), delay_us: Delays::from_times(delay) }).collect()
    }

    /// Returns the load of a phase with this duration, and with transmissions beyond its end.
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

    /// Returns the figures of a start-up with this duration; `None` without frames.
    pub(super) fn start_up(&self, span: u64) -> Option<StartUp> {
        (self.frames > 0).then(|| StartUp {
            frames: self.frames,
            duration_s: span as f64 / 1e9,
            load: self.loads(span, 0),
            stretches: self.busy.stretches(SATURATED_NS),
            delay_us: Delays::from_times(&self.all),
        })
    }
}
