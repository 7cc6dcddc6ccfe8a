//! The player of a recording: the present position, the state of the skin there, and moves to other positions.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use protocol::skin::Skin;
use protocol::time::Micros;
use serde::Serialize;
use trace::capture::{CaptureEntry, CaptureError, Reader, SeekIndex, SeekPoint, seconds_since};

use crate::index::{Checkpoint, RecordingIndex};
use crate::live::LiveState;
use crate::tape::{EventKind, PlaybackState, PlaybackStep};

/// The time before a position for which the plots get values, in ns.
const PLOT_HISTORY_NS: u64 = 10_000_000_000;
/// The time before a position for which the plots get values if the index has not passed the position yet, in ns.
const PLOT_PREVIEW_NS: u64 = 3_000_000_000;
/// The time between two values of a plot, in ns.
const PLOT_INTERVAL_NS: u64 = 20_000_000;
/// The minimum and the maximum playback speed, in s of the recording per s.
const SPEED_RANGE: [f64; 2] = [0.01, 100.0];

/// A time in ns since 1970, and the distributed and the central torque of each joint at that time.
type TorqueSample = (u64, Vec<[f64; 2]>);

/// A recording that is played, with its present position.
#[derive(Debug)]
pub struct Player {
    skin: Skin,
    places: SeekIndex,
    index: Arc<RecordingIndex>,
    reader: Reader,
    tape: PlaybackState,
    /// The time of the first frame, in ns since 1970.
    first: u64,
    /// The time from which seconds count, in ns since 1970.
    zero: u64,
    /// The present position, in ns since 1970.
    at: u64,
    /// True if the counts of the present state include everything since the beginning of the recording.
    is_exact: bool,
    playing: bool,
    speed: f64,
    history: VecDeque<TorqueSample>,
    /// The number of jumps so far. After each jump the page clears its plots.
    jumps: u64,
    /// The error because of which the last requested position cannot be shown.
    failed: Option<String>,
}

/// The state of the player that pages show.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlayerStatus {
    /// The position in s of the run, or in s since the first frame if there is no run.
    pub at_s: f64,
    /// The position in ns since 1970.
    pub at_ns: String,
    /// The time of the first frame, in the same s as the position. It is negative if the control loop began later.
    pub from_s: f64,
    /// The time of the end of the recording, in the same s as the position.
    pub of_s: f64,
    /// True while the recording plays; false while it is paused.
    pub playing: bool,
    /// The playback speed in s of the recording per s.
    pub speed: f64,
    /// True if the counts of the shown state include everything since the beginning of the recording.
    pub exact: bool,
    /// The share of the recording that is indexed, 0 to 1.
    pub read: f64,
    /// The halt at the position, if the recording contains its reason.
    pub halt: Option<RecordedHalt>,
    /// The error because of which the recording cannot be read further.
    pub failed: Option<String>,
    /// A description of what is missing at the end of the recording, if it was never finished.
    pub unfinished: Option<String>,
    /// The number of frames on buses that the skin does not have.
    pub others: u64,
    /// The number of events found so far.
    pub events: usize,
    /// By kind of event: the numbers of those of 600 equal parts of the recording in which such events occur.
    pub marks: BTreeMap<EventKind, Vec<u16>>,
}

/// A halt in a recording.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RecordedHalt {
    /// The time at which the halt began, in the same s as the position.
    pub since_s: f64,
    /// The reason of the halt.
    pub reason: String,
}

impl PlayerStatus {
    /// Returns the same playback state with these marks.
    #[must_use]
    pub fn with_event_marks(self, marks: BTreeMap<EventKind, Vec<u16>>) -> Self {
        Self { marks, ..self }
    }
}

/// The reason why a recording cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum PlayError {
    /// The capture cannot be read.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The recording is damaged. The part before the damage was shown.
    #[error("{0}")]
    Damaged(String),
    /// The recording has no frames.
    #[error("{0}: the recording contains no frames")]
    Empty(String),
}

impl Player {
    /// Opens a recording and moves to its first frame.
    ///
    /// # Errors
    /// Returns [`PlayError`] if the recording cannot be read, is not seekable, or has no frame.
    pub fn open(paths: &[PathBuf], skin: Skin) -> Result<Self, PlayError> {
        let mut beginning = Reader::open_all(paths)?;
        let first = loop {
            match beginning.next()? {
                Some(CaptureEntry::Frame(record)) => break record.time.nanos,
                Some(CaptureEntry::Note(_)) => {}
                None => return Err(PlayError::Empty(beginning.name().to_owned())),
            }
        };
        let zero = beginning.extras().run_began().unwrap_or(first);
        let places = SeekIndex::open(paths)?;
        let reader = Reader::open_all(paths)?;
        let mut tape = PlaybackState::new(skin.clone(), zero);
        tape.set_latched_frames(reader.extras());
        Ok(Self {
            skin,
            places,
            index: Arc::default(),
            reader,
            tape,
            first,
            zero,
            at: first,
            is_exact: true,
            playing: false,
            speed: 1.0,
            history: VecDeque::new(),
            jumps: 0,
            failed: None,
        })
    }

    /// Returns the index of the recording, which the caller builds in another thread.
    #[must_use]
    pub fn index(&self) -> Arc<RecordingIndex> {
        Arc::clone(&self.index)
    }

    /// Returns the time of the first frame, in ns since 1970.
    #[must_use]
    pub const fn first_frame_ns(&self) -> u64 {
        self.first
    }

    /// Returns the time from which seconds count, in ns since 1970.
    #[must_use]
    pub const fn time_origin_ns(&self) -> u64 {
        self.zero
    }

    /// Returns the state of the skin at the present position.
    pub const fn live(&mut self) -> &mut LiveState {
        self.tape.live_mut()
    }

    /// Returns the present position.
    #[must_use]
    pub const fn now(&self) -> Micros {
        Micros(self.at / 1_000)
    }

    /// Returns the present position, in ns since 1970.
    #[must_use]
    pub const fn position_ns(&self) -> u64 {
        self.at
    }

    /// Returns true if the position is the end of the recording, and that is known.
    #[must_use]
    pub fn is_at_end(&self) -> bool {
        self.index.progress().is_over && self.at >= self.end_ns()
    }

    /// Returns the number of jumps so far.
    #[must_use]
    pub const fn jump_count(&self) -> u64 {
        self.jumps
    }

    /// Returns the time of the recording's end in ns since 1970, as far as it is known.
    fn end_ns(&self) -> u64 {
        let progress = self.index.progress();
        let last = if progress.is_over { progress.at } else { self.places.latest_ns().max(progress.at) };
        last.max(self.first)
    }

    /// Plays the recording from now on. `speed` is in s of the recording per s, limited to 0.01 to 100; a speed that is
    /// not finite counts as 1.
    pub fn play(&mut self, speed: f64) {
        let [min, max] = SPEED_RANGE;
        self.speed = if speed.is_finite() { speed.clamp(min, max) } else { 1.0 };
        self.playing = true;
    }

    /// Pauses, and stores the error because of which the recording cannot be read further.
    pub fn pause_with_error(&mut self, why: String) {
        self.playing = false;
        self.failed = Some(why);
    }

    /// Pauses.
    pub const fn pause(&mut self) {
        self.playing = false;
    }

    /// Advances the position by the elapsed time, if the recording plays. Returns true if the state has changed.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read further.
    pub fn advance_time(&mut self, elapsed: Duration) -> Result<bool, CaptureError> {
        if !self.is_exact && self.is_indexed_until(self.at) {
            self.go_to_time(self.at)?;
            return Ok(true);
        }
        if !self.playing {
            return Ok(false);
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few seconds")]
        let passed = (elapsed.as_secs_f64() * self.speed * 1e9) as u64;
        let until = self.at.saturating_add(passed);
        let last = self.end_ns();
        self.advance_until(until.min(last), false)?;
        self.playing &= until < last;
        Ok(true)
    }

    /// Moves to a position in s of the run, or in s since the first frame. Positions outside of the recording are moved
    /// to its beginning or end.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read there.
    pub fn seek(&mut self, at_s: f64) -> Result<(), CaptureError> {
        #[expect(clippy::cast_possible_truncation, reason = "saturates")]
        let since = (at_s * 1e9).round() as i64;
        self.go_to_time(self.zero.saturating_add_signed(since))
    }

    /// Moves to the beginning of the next or the previous epoch, and pauses.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read there.
    pub fn step_epoch(&mut self, forward: bool) -> Result<(), CaptureError> {
        self.playing = false;
        if forward {
            return self.advance_until(self.end_ns(), true);
        }
        if self.tape.epoch_time_before(self.at).is_none() {
            // The time before the position is read again, because only its epochs are known that were read.
            self.seek_from_checkpoint(self.at)?;
        }
        let before = self.tape.epoch_time_before(self.at);
        before.map_or(Ok(()), |before| self.go_to_time(before))
    }

    /// Moves to the next or the previous event of a kind, and pauses. Returns false if there is none.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read there.
    pub fn jump_to_event(&mut self, kind: EventKind, forward: bool) -> Result<bool, CaptureError> {
        let Some(at) = self.index.find_event(kind, self.at, forward) else { return Ok(false) };
        self.playing = false;
        self.go_to_time(at)?;
        Ok(true)
    }

    fn is_indexed_until(&self, at: u64) -> bool {
        let progress = self.index.progress();
        progress.is_over || progress.at >= at
    }

    fn go_to_time(&mut self, at: u64) -> Result<(), CaptureError> {
        let at = at.clamp(self.first, self.end_ns());
        let near = self.tape.position_ns() <= at && at - self.tape.position_ns() <= PLOT_HISTORY_NS;
        if near && self.is_exact {
            return self.advance_until(at, false);
        }
        self.seek_from_checkpoint(at)
    }

    /// Moves to a position by reading on from the last stored state before it.
    fn seek_from_checkpoint(&mut self, at: u64) -> Result<(), CaptureError> {
        self.is_exact = self.is_indexed_until(at) || at <= self.first.saturating_add(PLOT_HISTORY_NS);
        let kept = self.index.checkpoint_before(at.saturating_sub(PLOT_HISTORY_NS)).filter(|_| self.is_exact);
        let place = match kept.as_deref() {
            Some(Checkpoint { tape, place }) => {
                self.tape.clone_from(tape);
                *place
            }
            None => {
                self.tape = PlaybackState::new(self.skin.clone(), self.zero);
                match self.is_exact {
                    true => SeekPoint::default(),
                    false => self.places.point_before(at.saturating_sub(PLOT_PREVIEW_NS)),
                }
            }
        };
        self.reader.seek(&self.places, place)?;
        if place == SeekPoint::default() {
            self.tape.set_latched_frames(self.reader.extras());
        }
        self.history.clear();
        self.failed = None;
        self.jumps += 1;
        self.advance_until(at, false)
    }

    /// Advances to a position, or with `to_epoch` only to the next epoch.
    fn advance_until(&mut self, until: u64, to_epoch: bool) -> Result<(), CaptureError> {
        loop {
            match self.tape.step_until(until) {
                PlaybackStep::NeedsEntries => self.tape.read_entry(&mut self.reader)?,
                PlaybackStep::Updated => {}
                PlaybackStep::Applied { epoch } => {
                    let at = self.tape.position_ns();
                    let is_due = |(last, _): &(u64, _)| at.saturating_sub(*last) >= PLOT_INTERVAL_NS;
                    if epoch && self.history.back().is_none_or(is_due) {
                        self.history.push_back((at, self.tape.live().joint_torques()));
                    }
                    if epoch && to_epoch && self.tape.position_ns() > self.at {
                        break;
                    }
                }
                PlaybackStep::Reached | PlaybackStep::Over => break,
            }
        }
        self.at = if to_epoch { self.tape.position_ns().min(until) } else { until };
        let old = self.at.saturating_sub(PLOT_HISTORY_NS);
        while self.history.front().is_some_and(|(at, _)| *at < old) {
            self.history.pop_front();
        }
        Ok(())
    }

    /// Encodes the torques of the last seconds for the plots, little-endian:
    ///
    /// | bytes | content |
    /// |---|---|
    /// | 4 | number of jumps, u32 |
    /// | 4 | joints J of the robot, u32 |
    /// | 4 | moments, u32 |
    /// | 4 | 1: a history |
    /// | 8 + 8 J for each moment | s of the run, or since the first frame, f64; distributed and central torque of each joint (NaN while unknown), f32 |
    #[must_use]
    pub fn encode_torque_history(&self) -> Vec<u8> {
        let joints = self.skin.robot.joints.len();
        let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
        let mut bytes = Vec::with_capacity(16 + self.history.len() * (8 + 8 * joints));
        let jumps = u32::try_from(self.jumps & 0xFFFF_FFFF).unwrap_or_default();
        for word in [jumps, count(joints), count(self.history.len()), 1] {
            bytes.extend(word.to_le_bytes());
        }
        for (at, torques) in &self.history {
            bytes.extend(self.seconds_since_origin(*at).to_le_bytes());
            for value in torques.iter().flatten() {
                #[expect(clippy::cast_possible_truncation, reason = "to be drawn")]
                bytes.extend((*value as f32).to_le_bytes());
            }
        }
        bytes
    }

    /// Converts a time in ns since 1970 to s of the run, or to s since the first frame.
    fn seconds_since_origin(&self, at: u64) -> f64 {
        seconds_since(self.zero, at)
    }

    /// Returns the state of the player for the pages.
    #[must_use]
    pub fn status(&self) -> PlayerStatus {
        let progress = self.index.progress();
        let (of, read) = (self.end_ns() - self.first, progress.at.saturating_sub(self.first));
        PlayerStatus {
            at_s: self.seconds_since_origin(self.at),
            at_ns: self.at.to_string(),
            from_s: self.seconds_since_origin(self.first),
            of_s: self.seconds_since_origin(self.end_ns()),
            playing: self.playing,
            speed: self.speed,
            exact: self.is_exact,
            read: if progress.is_over {
                1.0
            } else {
                (nanos_to_seconds(read) / nanos_to_seconds(of.max(1))).min(1.0)
            },
            halt: self
                .index
                .halt_reason(self.at)
                .map(|(since, reason)| RecordedHalt { since_s: self.seconds_since_origin(since), reason }),
            failed: self.failed.clone().or(progress.failed),
            unfinished: progress.unfinished,
            others: progress.others,
            events: progress.events,
            marks: BTreeMap::new(),
        }
    }

    /// Divides the recording into `parts` equal parts. Returns the numbers of the parts in which events of a kind
    /// occur.
    #[must_use]
    pub fn parts_with_events(&self, kind: EventKind, parts: u16) -> Vec<u16> {
        self.index.parts_with_events(kind, (self.first, self.end_ns()), parts)
    }
}

#[expect(clippy::cast_precision_loss, reason = "to be shown: some µs of a year")]
fn nanos_to_seconds(nanos: u64) -> f64 {
    nanos as f64 / 1e9
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "the same sums give the same numbers")]
mod tests;
