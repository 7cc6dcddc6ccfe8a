//! The index of a recording: the state of the skin at intervals, and the recording's events. It is built in one pass
//! over the recording.
//!
//! To show a position, the player continues from the last [`Checkpoint`] state before it. Counts, such as those of
//! losses, are exact only at positions that the index has already passed.

mod halts;
pub mod series;

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use protocol::id::CellId;
use protocol::skin::Skin;
use protocol::time::Micros;
use trace::capture::{CaptureEntry, CaptureError, OtherMessage, Reader, RecordingItem, SeekPoint};
use trace::ros2::Message as _;
use trace::ros2::read::decode_loop_timing;
use trace::ros2::skin::LoopTiming;

use self::halts::HaltReasons;
use self::series::{Series, SeriesPart};
use crate::live::LiveState;
use crate::lock_ignoring_poison;
use crate::tape::{Event, EventDetector, EventKind, MAX_EVENTS, PlaybackState, PlaybackStep};

/// The approximate maximum memory for all stored states, in bytes.
const MEMORY_LIMIT_BYTES: usize = 256 << 20;
/// The approximate size of a stored state in bytes: this much for each bus, and `STATE_BYTES_PER_CELL` for each cell.
const STATE_BYTES_PER_BUS: usize = 1 << 20;
const STATE_BYTES_PER_CELL: usize = 4 << 10;
/// The interval between stored states at first, in ns. It doubles whenever the memory limit is reached.
const CHECKPOINT_SPACING_NS: u64 = 2_000_000_000;
/// The maximum memory for the values of plots, in bytes: once for cells, and once for everything else.
const SERIES_LIMIT_BYTES: usize = 48 << 20;
/// The interval of the values of plots at first, in ns.
const SERIES_INTERVAL_NS: u64 = 20_000_000;
/// The minimum time between two torques of a plot, in ns.
const MIN_TORQUE_INTERVAL_NS: u64 = 10_000_000;

/// The state of the skin at a position of a recording, and the place in the file where reading continues.
#[derive(Debug)]
pub struct Checkpoint {
    /// The tape with the state at this position.
    pub tape: PlaybackState,
    /// The place in the file of the next entry.
    pub place: SeekPoint,
}

/// The index of a recording. One thread builds it while another one reads it.
#[derive(Debug, Default)]
pub struct RecordingIndex(Mutex<IndexContents>);

#[derive(Debug, Default)]
struct IndexContents {
    checkpoints: Vec<Arc<Checkpoint>>,
    events: Vec<Event>,
    curves: Curves,
    halts: HaltReasons,
    at: u64,
    is_over: bool,
    failed: Option<String>,
    unfinished: Option<String>,
    others: u64,
}

/// The values of a recording over time.
#[derive(Debug, Default)]
struct Curves {
    /// For each joint the distributed torque, the central one, and their difference.
    torques: Series,
    /// The load of each bus.
    loads: Series,
    /// For each timed bus, the longest time from joints to a reply to them, in ms.
    replies: Series,
    /// The lateness of the loop's ticks in µs.
    lateness: Series,
    /// The force on each cell in N, in the order of `cells`.
    forces: Series,
    cells: Vec<(usize, CellId)>,
}

/// Values of a recording that a page plots.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Curve {
    /// The distributed and the central torque of each joint, and their difference.
    Torques,
    /// The load of each bus.
    Loads,
    /// The longest time from joints to a reply on each bus, in ms; no value on a bus on which frames take no time.
    Replies,
    /// The lateness of the control loop in µs.
    Lateness,
    /// The force on a cell of a bus, in N.
    Force(usize, CellId),
}

impl Curves {
    fn new(skin: &Skin, first: u64) -> Self {
        let series = |quantities, bytes| {
            Series::new(quantities, first, SERIES_INTERVAL_NS, SERIES_LIMIT_BYTES / bytes)
        };
        Self {
            torques: series(3 * skin.robot.joints.len(), 2),
            loads: series(skin.buses.len(), 6),
            replies: series(skin.buses.len(), 6),
            lateness: series(1, 6),
            forces: series(skin.cells.len(), 1),
            cells: Vec::new(),
        }
    }

    #[expect(clippy::cast_possible_truncation, reason = "to be drawn")]
    fn add_epoch(&mut self, at: u64, live: &LiveState) {
        let torques = live.joint_torques().into_iter();
        let values = torques.flat_map(|[cells, central]| [cells, central, cells - central]);
        self.torques.add(at, values.map(|value| value as f32));
        let replies = live.longest_reply_ms_by_bus();
        self.replies.add(at, replies.map(|value| value.map_or(f32::NAN, |value| value as f32)));
    }

    /// Returns the values that belong to a curve.
    fn series_and_quantities(&self, curve: Curve) -> (&Series, Range<usize>) {
        match curve {
            Curve::Torques => (&self.torques, 0..self.torques.quantity_count()),
            Curve::Loads => (&self.loads, 0..self.loads.quantity_count()),
            Curve::Replies => (&self.replies, 0..self.replies.quantity_count()),
            Curve::Lateness => (&self.lateness, 0..1),
            Curve::Force(bus, node) => match self.cells.iter().position(|cell| *cell == (bus, node)) {
                Some(place) => (&self.forces, place..place + 1),
                None => (&self.forces, 0..0),
            },
        }
    }
}

/// The progress of building an index.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// The position up to which the recording is indexed, in ns since 1970.
    pub at: u64,
    /// True if the whole recording is indexed.
    pub is_over: bool,
    /// The error because of which the index ends early.
    pub failed: Option<String>,
    /// A description of what is missing at the end of the recording, if it was never finished.
    pub unfinished: Option<String>,
    /// The number of frames on buses that the skin does not have.
    pub others: u64,
    /// The number of events found so far.
    pub events: usize,
}

impl RecordingIndex {
    /// Indexes a recording from its first frame to its end, or until `stop` is set. `first` is the time of the first
    /// frame and `zero` the one from which seconds count, both in ns since 1970.
    pub fn build(&self, mut reader: Reader, skin: Skin, (first, zero): (u64, u64), stop: &AtomicBool) {
        let count = MEMORY_LIMIT_BYTES
            / (skin.buses.len() * STATE_BYTES_PER_BUS + skin.cells.len() * STATE_BYTES_PER_CELL).max(1);
        let mut spacing = CHECKPOINT_SPACING_NS;
        let mut next = first.saturating_add(spacing);
        let mut next_torques = 0;
        *lock_ignoring_poison(&self.0) =
            IndexContents { curves: Curves::new(&skin, first), ..IndexContents::default() };
        let mut tape = PlaybackState::new(skin, zero);
        tape.set_latched_frames(reader.extras());
        let mut watcher = EventDetector::default();
        while !tape.has_ended() && !stop.load(Ordering::Relaxed) {
            match tape.step_until(u64::MAX) {
                PlaybackStep::NeedsEntries => {
                    if let Err(error) = self.read_item(&mut reader, &mut tape) {
                        self.store_error(&error);
                    }
                }
                PlaybackStep::Updated => {
                    let kept = (tape.position_ns() >= next).then(|| {
                        let mut kept = Checkpoint { tape: tape.clone(), place: reader.seek_point() };
                        kept.tape.forget_recent_frames();
                        Arc::new(kept)
                    });
                    let mut inner = self.store_state(&tape, &mut watcher);
                    if let Some(kept) = kept {
                        inner.checkpoints.push(kept);
                        if inner.checkpoints.len() > count.max(4) {
                            let mut number = 0;
                            inner.checkpoints.retain(|_| {
                                number += 1;
                                number % 2 == 0
                            });
                            spacing *= 2;
                        }
                        next = tape.position_ns().saturating_add(spacing);
                    }
                }
                PlaybackStep::Applied { epoch: true } if tape.position_ns() >= next_torques => {
                    lock_ignoring_poison(&self.0).curves.add_epoch(tape.position_ns(), tape.live());
                    next_torques = tape.position_ns().saturating_add(MIN_TORQUE_INTERVAL_NS);
                }
                PlaybackStep::Applied { .. } | PlaybackStep::Reached | PlaybackStep::Over => {}
            }
        }
        let mut inner = self.store_state(&tape, &mut watcher);
        inner.unfinished.clone_from(&reader.extras().unfinished);
        inner.is_over = true;
    }

    /// Reads the next frame, note or message into the tape or the index.
    fn read_item(&self, reader: &mut Reader, tape: &mut PlaybackState) -> Result<(), CaptureError> {
        match reader.next_item() {
            Ok(Some(RecordingItem::Entry(entry))) => {
                if let CaptureEntry::Note(note) = &entry {
                    let mut inner = lock_ignoring_poison(&self.0);
                    if inner.events.len() < MAX_EVENTS {
                        inner.events.extend(Event::from_note(note, |name| tape.bus_index(name)));
                    }
                }
                tape.push(&entry);
            }
            Ok(Some(RecordingItem::Other(other))) => self.store_timing(&other),
            Ok(None) => tape.end(),
            Err(error) => {
                tape.end();
                return Err(error);
            }
        }
        Ok(())
    }

    fn store_timing(&self, other: &OtherMessage<'_>) {
        if other.schema != LoopTiming::TYPE {
            return;
        }
        if let Ok(timing) = decode_loop_timing(other.message) {
            let mut inner = lock_ignoring_poison(&self.0);
            #[expect(clippy::cast_possible_truncation, reason = "to be drawn")]
            inner.curves.lateness.add(other.nanos, [timing.late_us as f32]);
            if let Some(reason) = inner.halts.add_tick(other.nanos, &timing) {
                let (at, kind) = (other.nanos, EventKind::Halt);
                inner.events.push(Event { at, kind, bus: None, node: None, text: Some(reason) });
            }
        }
    }

    /// Stores the events and the values at the position of a tape.
    fn store_state(
        &self,
        tape: &PlaybackState,
        watcher: &mut EventDetector,
    ) -> MutexGuard<'_, IndexContents> {
        let (at, live) = (tape.position_ns(), tape.live());
        let contacts: Vec<_> = live.cell_contacts(Micros(at / 1_000)).collect();
        let events = watcher.detect(at, live, &contacts);
        let mut inner = lock_ignoring_poison(&self.0);
        (inner.at, inner.others) = (at, tape.foreign_frame_count());
        // A halt of which the loop tells is no other event for its frames.
        let known = inner.halts.are_known();
        inner.events.extend(events.into_iter().filter(|event| !known || event.kind != EventKind::Halt));
        let Curves { loads, forces, cells, .. } = &mut inner.curves;
        if cells.is_empty() {
            cells.extend(contacts.iter().map(|cell| (cell.bus, cell.node)));
        }
        #[expect(clippy::cast_possible_truncation, reason = "to be drawn")]
        let value = |value: Option<f64>| value.map_or(f32::NAN, |value| value as f32);
        loads.add(at, live.bus_loads().map(value));
        forces.add(at, contacts.iter().map(|cell| value(cell.force_n)));
        inner
    }

    fn store_error(&self, error: &CaptureError) {
        lock_ignoring_poison(&self.0).failed = Some(error.to_string());
    }

    /// Returns how much of the recording is indexed, and what was found so far.
    #[must_use]
    pub fn progress(&self) -> Progress {
        let inner = lock_ignoring_poison(&self.0);
        let IndexContents { at, is_over, others, .. } = *inner;
        let (failed, unfinished) = (inner.failed.clone(), inner.unfinished.clone());
        Progress { at, is_over, failed, unfinished, others, events: inner.events.len() }
    }

    /// Returns the last stored state at or before the time `at`, in ns since 1970.
    #[must_use]
    pub fn checkpoint_before(&self, at: u64) -> Option<Arc<Checkpoint>> {
        let inner = lock_ignoring_poison(&self.0);
        let place = inner.checkpoints.partition_point(|kept| kept.tape.position_ns() <= at).checked_sub(1)?;
        inner.checkpoints.get(place).cloned()
    }

    /// Returns the time of the first event of a kind after `from`, or with `forward` false that of the last one before
    /// it.
    #[must_use]
    pub fn find_event(&self, kind: EventKind, from: u64, forward: bool) -> Option<u64> {
        let inner = lock_ignoring_poison(&self.0);
        let mut of_kind = inner.events.iter().filter(|event| event.kind == kind).map(|event| event.at);
        if forward { of_kind.find(|at| *at > from) } else { of_kind.rev().find(|at| *at < from) }
    }

    /// Returns the events from `from` to `to`, in ns since 1970, at most about `max` of each kind. Of a kind with more,
    /// some are left out evenly.
    #[must_use]
    pub fn events_between(&self, (from, to): (u64, u64), max: usize) -> Vec<Event> {
        let inner = lock_ignoring_poison(&self.0);
        let within = |event: &&Event| (from..=to).contains(&event.at);
        let of_kinds = EventKind::ALL.into_iter().flat_map(|kind| {
            let of_kind = || inner.events.iter().filter(move |event| event.kind == kind).filter(within);
            let step = of_kind().count().div_ceil(max.max(1)).max(1);
            of_kind().step_by(step).cloned()
        });
        of_kinds.collect()
    }

    /// Returns values from `from` to `to`, in ns since 1970, in about `count` intervals or fewer.
    #[must_use]
    pub fn curve(&self, curve: Curve, times: (u64, u64), count: u64) -> SeriesPart {
        let inner = lock_ignoring_poison(&self.0);
        let (series, quantities) = inner.curves.series_and_quantities(curve);
        series.part(quantities, times, count)
    }

    /// Returns the reason of the halt at a time in ns since 1970, and when it began. Returns `None` if the robot was not
    /// halted, or if the recording does not contain the reason.
    #[must_use]
    pub fn halt_reason(&self, at: u64) -> Option<(u64, String)> {
        lock_ignoring_poison(&self.0).halts.reason_at(at)
    }

    /// Divides the time from `from` to `to` into `parts` equal parts. Returns the numbers of the parts in which events
    /// of a kind occur.
    #[must_use]
    pub fn parts_with_events(&self, kind: EventKind, (from, to): (u64, u64), parts: u16) -> Vec<u16> {
        let inner = lock_ignoring_poison(&self.0);
        let length = u128::from(to.saturating_sub(from).max(1));
        let part = |event: &Event| {
            let part = u128::from(event.at.saturating_sub(from)) * u128::from(parts) / length;
            u16::try_from(part).map_or(parts - 1, |part| part.min(parts - 1))
        };
        let mut all: Vec<_> = inner.events.iter().filter(|event| event.kind == kind).map(part).collect();
        all.dedup();
        all
    }
}
