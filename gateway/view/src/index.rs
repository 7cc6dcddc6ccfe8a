//! The index of a recording: the state of the skin at intervals, and the recording's events. It is built in one pass
//! over the recording.
//!
//! To show a position, the player continues from the last [`Checkpoint`] state before it. Counts, such as those of
//! losses, are exact only at positions that the index has already passed.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use protocol::skin::Skin;
use trace::capture::{CaptureError, Reader, SeekPoint};

use crate::lock_ignoring_poison;
use crate::tape::{Event, EventDetector, EventKind, PlaybackState, PlaybackStep};

/// The approximate maximum memory for all stored states, in bytes.
const MEMORY_LIMIT_BYTES: usize = 256 << 20;
/// The approximate size of a stored state in bytes: this much for each bus, and `STATE_BYTES_PER_CELL` for each cell.
const STATE_BYTES_PER_BUS: usize = 1 << 20;
const STATE_BYTES_PER_CELL: usize = 4 << 10;
/// The interval between stored states at first, in ns. It doubles whenever the memory limit is reached.
const CHECKPOINT_SPACING_NS: u64 = 2_000_000_000;

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
    at: u64,
    is_over: bool,
    failed: Option<String>,
    unfinished: Option<String>,
    others: u64,
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
        let mut tape = PlaybackState::new(skin, zero);
        tape.set_latched_frames(reader.extras());
        let mut watcher = EventDetector::default();
        while !tape.has_ended() && !stop.load(Ordering::Relaxed) {
            match tape.step_until(u64::MAX) {
                PlaybackStep::NeedsEntries => {
                    if let Err(error) = tape.read_entry(&mut reader) {
                        self.store_error(&error);
                    }
                }
                PlaybackStep::Updated => {
                    let events = watcher.detect(tape.position_ns(), tape.live());
                    let kept = (tape.position_ns() >= next).then(|| {
                        let mut kept = Checkpoint { tape: tape.clone(), place: reader.seek_point() };
                        kept.tape.forget_recent_frames();
                        Arc::new(kept)
                    });
                    let mut inner = lock_ignoring_poison(&self.0);
                    (inner.at, inner.others) = (tape.position_ns(), tape.foreign_frame_count());
                    inner.events.extend(events);
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
                PlaybackStep::Applied { .. } | PlaybackStep::Reached | PlaybackStep::Over => {}
            }
        }
        let mut inner = lock_ignoring_poison(&self.0);
        inner.unfinished.clone_from(&reader.extras().unfinished);
        (inner.at, inner.others, inner.is_over) = (tape.position_ns(), tape.foreign_frame_count(), true);
        inner.events.extend(watcher.detect(tape.position_ns(), tape.live()));
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
