//! The state of a recorded skin at a position in time, computed from the frames of the recording up to there.
//!
//! ```text
//!   entries of the capture ──> push ──> Order, by time ──> advance(until) ──> Live
//! ```
//!
//! The state depends only on the position and on the entries of the recording, not on the way in which the player got
//! there: the same entries up to the same position give the same [`LiveState`].

mod events;

use std::collections::VecDeque;

use protocol::can::Frame;
use protocol::skin::Skin;
use protocol::time::Micros;
use trace::capture::{CaptureEntry, CaptureError, NoteKind, Reader, RecordingExtras};
use trace::order::{BusMerger, ReleasedFrame};

pub use self::events::{Event, EventDetector, EventKind, MAX_EVENTS};
use crate::live::LiveState;

/// The interval in ns at which the passing of time is applied to the state: cells become silent, and loads are
/// measured.
const UPDATE_INTERVAL_NS: u64 = 20_000_000;
/// The time in ns after which the rest of a pause in the recording is skipped.
const MAX_PAUSE_NS: u64 = 60_000_000_000;
/// The number of epochs whose times are stored.
const MAX_EPOCH_TIMES: usize = 256;

/// The result of a step on the tape.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum PlaybackStep {
    /// A frame was applied.
    Applied {
        /// True if the frame begins an epoch.
        epoch: bool,
    },
    /// The passing of time was applied to the state.
    Updated,
    /// The tape needs more entries from the reader.
    NeedsEntries,
    /// All frames up to the requested time were applied.
    Reached,
    /// All frames of the recording were applied.
    Over,
}

/// The state of a recording up to a position, and the entries after it that were already read.
#[derive(Clone, Debug)]
pub struct PlaybackState {
    live: LiveState,
    names: Vec<String>,
    order: BusMerger<QueuedFrame>,
    next: Option<ReleasedFrame<QueuedFrame>>,
    /// True if the reader has reached the end of the recording.
    ended: bool,
    /// The frames that were latched when the recording began. They are applied before the first frame and then removed.
    latched: Vec<QueuedFrame>,
    /// The time of the first frame, in ns since 1970.
    first: Option<u64>,
    /// The position in ns since 1970: all frames up to it were applied.
    at: u64,
    /// The time in ns since 1970 at which the passing of time is applied to the state next.
    next_update: u64,
    epochs: VecDeque<u64>,
    /// The number of frames that the recorder lost on each bus.
    dropped: Vec<u64>,
    /// The number of frames on buses that the skin does not have.
    foreign_frames: u64,
}

#[derive(Clone, Copy, Debug)]
struct QueuedFrame {
    bus: usize,
    frame: Frame,
}

impl PlaybackState {
    /// Creates a tape at the beginning of a recording. Seconds count from `zero`, in ns since 1970.
    #[must_use]
    pub fn new(skin: Skin, zero: u64) -> Self {
        let names: Vec<_> = skin.buses.iter().map(|bus| bus.name.clone()).collect();
        let mut live = LiveState::with_start_time(skin, Micros(zero / 1_000));
        (0..names.len()).for_each(|bus| live.set_bus_state(bus, true, 0));
        Self {
            live,
            dropped: vec![0; names.len()],
            names,
            order: BusMerger::default(),
            next: None,
            ended: false,
            latched: Vec::new(),
            first: None,
            at: 0,
            next_update: 0,
            epochs: VecDeque::new(),
            foreign_frames: 0,
        }
    }

    /// Reads the next entry of the recording into the tape. At the end of the recording, marks the tape as ended.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the capture cannot be read or is damaged. The tape then ends there.
    pub fn read_entry(&mut self, reader: &mut Reader) -> Result<(), CaptureError> {
        match reader.next() {
            Ok(Some(entry)) => self.push(&entry),
            Ok(None) => self.end(),
            Err(error) => {
                self.end();
                return Err(error);
            }
        }
        Ok(())
    }

    /// Marks the tape as ended: the recording has no further entries.
    pub const fn end(&mut self) {
        self.ended = true;
    }

    /// Stores the frames that were latched when the recording began. Must be called before the first entry is added.
    pub fn set_latched_frames(&mut self, extras: &RecordingExtras) {
        for bus in extras.timed_buses().filter_map(|bus| self.bus_index(bus)).collect::<Vec<_>>() {
            self.live.set_bus_timed(bus, true);
        }
        let latched = extras.latched.iter();
        self.latched = latched
            .filter_map(|it| Some(QueuedFrame { bus: self.bus_index(&it.bus)?, frame: it.frame }))
            .collect();
    }

    /// Adds the next entry of the recording.
    pub fn push(&mut self, entry: &CaptureEntry<'_>) {
        match entry {
            CaptureEntry::Frame(record) => {
                let nanos = record.time.nanos;
                match self.bus_index(record.interface) {
                    Some(bus) => self.order.push(bus, nanos, QueuedFrame { bus, frame: record.frame }),
                    None => self.foreign_frames += 1,
                }
            }
            CaptureEntry::Note(note) => {
                if let NoteKind::Dropped(frames) = note.kind {
                    for (bus, dropped) in self.dropped.iter_mut().enumerate() {
                        let of_it = self.names.get(bus).is_some_and(|name| name == note.interface);
                        if of_it || (note.interface.is_empty() && bus == 0) {
                            *dropped = dropped.saturating_add(frames);
                            self.live.set_bus_state(bus, true, *dropped);
                        }
                    }
                }
            }
        }
    }

    /// Advances by one frame, or by one interval of time without a frame, but not beyond `until`, in ns since 1970.
    pub fn step_until(&mut self, until: u64) -> PlaybackStep {
        if self.next.is_none() {
            self.next = if self.ended { self.order.pop_without_waiting() } else { self.order.pop() };
        }
        let Some(next) = self.next else {
            return match self.ended {
                false => PlaybackStep::NeedsEntries,
                true if self.first.is_none() => PlaybackStep::Over,
                true => self.apply_time_until(until).unwrap_or(PlaybackStep::Over),
            };
        };
        if self.first.is_none() {
            self.first = Some(next.send_nanos);
            (self.at, self.next_update) =
                (next.send_nanos, next.send_nanos.saturating_add(UPDATE_INTERVAL_NS));
            let latched = std::mem::take(&mut self.latched);
            self.live.apply_latched_frames(
                Micros(next.send_nanos / 1_000),
                latched.iter().map(|it| (it.bus, &it.frame)),
            );
        }
        if let Some(looked) = self.apply_time_until(until.min(next.send_nanos.saturating_sub(1))) {
            return looked;
        }
        if next.send_nanos > until {
            self.at = self.at.max(until);
            return PlaybackStep::Reached;
        }
        self.next = None;
        self.at = next.send_nanos;
        let QueuedFrame { bus, frame } = next.item;
        let epoch = self.live.apply_frame(bus, Micros(next.send_nanos / 1_000), &frame);
        if epoch {
            if self.epochs.len() == MAX_EPOCH_TIMES {
                self.epochs.pop_front();
            }
            self.epochs.push_back(next.send_nanos);
        }
        PlaybackStep::Applied { epoch }
    }

    /// Applies the passing of time to the state, if the next time to do so is not after `until`.
    fn apply_time_until(&mut self, until: u64) -> Option<PlaybackStep> {
        // Times in 64 bits of ns end in the year 2554, so there is no later time.
        if self.next_update > until || self.next_update == u64::MAX {
            return None;
        }
        self.live.handle_time(Micros(self.next_update / 1_000));
        self.at = self.next_update;
        self.next_update = self.next_update.saturating_add(UPDATE_INTERVAL_NS);
        // The rest of a long pause is skipped, because the state does not change any more.
        if until.saturating_sub(self.next_update) > MAX_PAUSE_NS {
            self.next_update = until - MAX_PAUSE_NS;
        }
        Some(PlaybackStep::Updated)
    }

    /// Returns the state at the position.
    #[must_use]
    pub const fn live(&self) -> &LiveState {
        &self.live
    }

    /// Returns the state at the position for changes, which snapshots need to count themselves.
    pub const fn live_mut(&mut self) -> &mut LiveState {
        &mut self.live
    }

    /// Returns the position in ns since 1970: all frames up to it were applied.
    #[must_use]
    pub const fn position_ns(&self) -> u64 {
        self.at
    }

    /// Returns true if all frames of the recording were applied.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.ended && self.next.is_none() && self.order.is_empty()
    }

    /// Returns the time of the last epoch before `moment`, both in ns since 1970. Returns `None` if it is no longer
    /// stored.
    #[must_use]
    pub fn epoch_time_before(&self, moment: u64) -> Option<u64> {
        self.epochs.iter().rev().copied().find(|&at| at < moment)
    }

    /// Drops the frames of the last seconds, so that the tape takes less memory in the index.
    pub fn forget_recent_frames(&mut self) {
        self.live.forget_recent_frames();
    }

    /// Returns the number of frames on buses that the skin does not have.
    #[must_use]
    pub const fn foreign_frame_count(&self) -> u64 {
        self.foreign_frames
    }

    /// Returns the index of the bus with this name.
    #[must_use]
    pub fn bus_index(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|bus| bus == name)
    }
}
