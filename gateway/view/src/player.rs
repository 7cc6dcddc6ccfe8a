//! The player of a recording: a position in it, and the state there.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use protocol::skin::Skin;
use protocol::time::Micros;
use serde::Serialize;
use trace::capture::{CaptureError, Entry, SeekPoint, SeekIndex, Reader, seconds_since};

use crate::index::{Index, Checkpoint};
use crate::live::Live;
use crate::tape::{EventKind, TapeStep, Tape};

/// The time before a position for which the plots have values, in ns.
const HISTORY_NS: u64 = 10_000_000_000;
/// The same where the index has not reached the position yet.
const PREVIEW_NS: u64 = 3_000_000_000;
/// The interval between two values of a plot, in ns.
const SAMPLE_NS: u64 = 20_000_000;
/// The minimum and the maximum speed.
const SPEED_RANGE: [f64; 2] = [0.01, 100.0];

/// The time, and the distributed and the central torque of each joint.
type Sample = (u64, Vec<[f64; 2]>);

/// A recording at a position.
#[derive(Debug)]
pub struct Player {
    skin: Skin,
    places: SeekIndex,
    index: Arc<Index>,
    reader: Reader,
    tape: Tape,
    /// The time of the first frame, in ns since 1970.
    first: u64,
    /// The time that seconds count from, in ns since 1970.
    zero: u64,
    /// The position, in ns since 1970.
    at: u64,
    /// True if all counts start at the beginning of the recording.
    is_exact: bool,
    playing: bool,
    speed: f64,
    history: VecDeque<Sample>,
    /// The number of jumps so far; the page clears its plots after each one.
    jumps: u64,
    /// The reason why the last position cannot be shown.
    failed: Option<String>,
}

/// The player's state, as a page shows it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Playback {
    /// The position, in s of the run, or since the first frame if there is no run.
    pub at_s: f64,
    /// The position in ns since 1970.
    pub at_ns: String,
    /// The time of the first frame on the same scale: negative if the control loop began later.
    pub from_s: f64,
    /// The time of the end on the same scale.
    pub of_s: f64,
    /// True while it plays.
    pub playing: bool,
    /// Seconds of the recording per second.
    pub speed: f64,
    /// True if all counts start at the beginning of the recording.
    pub exact: bool,
    /// The share of the recording that is indexed, 0 to 1.
    pub read: f64,
    /// The reason why the recording cannot be read further.
    pub failed: Option<String>,
    /// The part that is missing at its end.
    pub unfinished: Option<String>,
    /// The number of frames on buses that the skin does not have.
    pub others: u64,
    /// The number of events so far.
    pub events: usize,
    /// For each kind of event, those of 600 equal parts of the recording that contain one.
    pub marks: BTreeMap<EventKind, Vec<u16>>,
}

impl Playback {
    /// Returns the same state with these marks.
    #[must_use]
    pub fn with_marks(self, marks: BTreeMap<EventKind, Vec<u16>>) -> Self {
        Self { marks, ..self }
    }
}

/// The error for a recording that cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum PlayError {
    /// The capture cannot be read.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The recording is damaged; the part before the damage was shown.
    #[error("{0}")]
    Damaged(String),
    /// The recording has no frames.
    #[error("{0}: there is no frame in it")]
    Empty(String),
}

impl Player {
    /// Opens a recording at its first frame.
    ///
    /// # Errors
    /// Returns [`PlayError`] if it cannot be read, does not support seeking, or has no frame.
    pub fn open(paths: &[PathBuf], skin: Skin) -> Result<Self, PlayError> {
        let mut beginning = Reader::open_all(paths)?;
        let first = loop {
            match beginning.next()? {
                Some(Entry::Frame(record)) => break record.time.nanos,
                Some(Entry::Note(_)) => {}
                None => return Err(PlayError::Empty(beginning.name().to_owned())),
            }
        };
        let zero = beginning.extras().run_began().unwrap_or(first);
        let places = SeekIndex::open(paths)?;
        let reader = Reader::open_all(paths)?;
        let mut tape = Tape::new(skin.clone(), zero);
        tape.begin(reader.extras());
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

    /// Returns the index, which another thread builds.
    #[must_use]
    pub fn index(&self) -> Arc<Index> {
        Arc::clone(&self.index)
    }

    /// Returns the time of the first frame, in ns since 1970.
    #[must_use]
    pub const fn first(&self) -> u64 {
        self.first
    }

    /// Returns the time that seconds count from, in ns since 1970.
    #[must_use]
    pub const fn zero(&self) -> u64 {
        self.zero
    }

    /// Returns the state at the position.
    pub const fn live(&mut self) -> &mut Live {
        self.tape.live_mut()
    }

    /// Returns the position.
    #[must_use]
    pub const fn now(&self) -> Micros {
        Micros(self.at / 1_000)
    }

    /// Returns the number of jumps so far.
    #[must_use]
    pub const fn jumps(&self) -> u64 {
        self.jumps
    }

    /// Returns the end, as far as it is known.
    fn last(&self) -> u64 {
        let progress = self.index.progress();
        let last = if progress.is_over { progress.at } else { self.places.latest().max(progress.at) };
        last.max(self.first)
    }

    /// Plays at a speed from now on, clamped to 0.01 to 100; 1 if it is not finite.
    pub fn play(&mut self, speed: f64) {
        let [min, max] = SPEED_RANGE;
        self.speed = if speed.is_finite() { speed.clamp(min, max) } else { 1.0 };
        self.playing = true;
    }

    /// Pauses and reports why the recording cannot be read there.
    pub fn fail(&mut self, why: String) {
        self.playing = false;
        self.failed = Some(why);
    }

    /// Pauses.
    pub const fn pause(&mut self) {
        self.playing = false;
    }

    /// Advances by the elapsed time. Returns true if the state has changed.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read further.
    pub fn advance_time(&mut self, elapsed: Duration) -> Result<bool, CaptureError> {
        if !self.is_exact && self.is_indexed(self.at) {
            self.go_to(self.at)?;
            return Ok(true);
        }
        if !self.playing {
            return Ok(false);
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few seconds")]
        let passed = (elapsed.as_secs_f64() * self.speed * 1e9) as u64;
        let until = self.at.saturating_add(passed);
        let last = self.last();
        self.advance(until.min(last), false)?;
        self.playing &= until < last;
        Ok(true)
    }

    /// Seeks to a position, in s of the run, or since the first frame, clamped to the recording.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read there.
    pub fn seek(&mut self, at_s: f64) -> Result<(), CaptureError> {
        #[expect(clippy::cast_possible_truncation, reason = "saturates")]
        let since = (at_s * 1e9).round() as i64;
        self.go_to(self.zero.saturating_add_signed(since))
    }

    /// Steps to the next or the previous epoch, and pauses.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read there.
    pub fn step(&mut self, forward: bool) -> Result<(), CaptureError> {
        self.playing = false;
        if forward {
            return self.advance(self.last(), true);
        }
        if self.tape.epoch_before(self.at).is_none() {
            // Reads the time before the position, to find its epochs.
            self.restart_before(self.at)?;
        }
        let before = self.tape.epoch_before(self.at);
        before.map_or(Ok(()), |before| self.go_to(before))
    }

    /// Jumps to the next or the previous event of a kind, and pauses. Returns true if there is one.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the recording cannot be read there.
    pub fn jump(&mut self, kind: EventKind, forward: bool) -> Result<bool, CaptureError> {
        let Some(at) = self.index.find_event(kind, self.at, forward) else { return Ok(false) };
        self.playing = false;
        self.go_to(at)?;
        Ok(true)
    }

    fn is_indexed(&self, at: u64) -> bool {
        let progress = self.index.progress();
        progress.is_over || progress.at >= at
    }

    fn go_to(&mut self, at: u64) -> Result<(), CaptureError> {
        let at = at.clamp(self.first, self.last());
        let near = self.tape.position() <= at && at - self.tape.position() <= HISTORY_NS;
        if near && self.is_exact {
            return self.advance(at, false);
        }
        self.restart_before(at)
    }

    /// Seeks to a position from the last kept state before it.
    fn restart_before(&mut self, at: u64) -> Result<(), CaptureError> {
        self.is_exact = self.is_indexed(at) || at <= self.first.saturating_add(HISTORY_NS);
        let kept = self.index.checkpoint_before(at.saturating_sub(HISTORY_NS)).filter(|_| self.is_exact);
        let place = match kept.as_deref() {
            Some(Checkpoint { tape, place }) => {
                self.tape.clone_from(tape);
                *place
            }
            None => {
                self.tape = Tape::new(self.skin.clone(), self.zero);
                match self.is_exact {
                    true => SeekPoint::default(),
                    false => self.places.before(at.saturating_sub(PREVIEW_NS)),
                }
            }
        };
        self.reader.go_to(&self.places, place)?;
        if place == SeekPoint::default() {
            self.tape.begin(self.reader.extras());
        }
        self.history.clear();
        self.failed = None;
        self.jumps += 1;
        self.advance(at, false)
    }

    /// Advances to a position, or to the first epoch before it.
    fn advance(&mut self, until: u64, to_epoch: bool) -> Result<(), CaptureError> {
        loop {
            match self.tape.step(until) {
                TapeStep::NeedsEntries => self.tape.feed(&mut self.reader)?,
                TapeStep::Updated => {}
                TapeStep::Applied { epoch } => {
                    let at = self.tape.position();
                    let is_due = |(last, _): &(u64, _)| at.saturating_sub(*last) >= SAMPLE_NS;
                    if epoch && self.history.back().is_none_or(is_due) {
                        self.history.push_back((at, self.tape.live().torques()));
                    }
                    if epoch && to_epoch && self.tape.position() > self.at {
                        break;
                    }
                }
                TapeStep::Reached | TapeStep::Over => break,
            }
        }
        self.at = if to_epoch { self.tape.position().min(until) } else { until };
        let old = self.at.saturating_sub(HISTORY_NS);
        while self.history.front().is_some_and(|(at, _)| *at < old) {
            self.history.pop_front();
        }
        Ok(())
    }

    /// Encodes the torques of the last seconds, little-endian:
    ///
    /// | bytes | content |
    /// |---|---|
    /// | 4 | number of jumps, u32 |
    /// | 4 | joints J of the robot, u32 |
    /// | 4 | moments, u32 |
    /// | 4 | 1: a history |
    /// | 8 + 8 J for each moment | s of the run, or since the first frame, f64; distributed and central torque of each joint, f32 |
    #[must_use]
    pub fn history(&self) -> Vec<u8> {
        let joints = self.skin.robot.joints.len();
        let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
        let mut bytes = Vec::with_capacity(16 + self.history.len() * (8 + 8 * joints));
        let jumps = u32::try_from(self.jumps & 0xFFFF_FFFF).unwrap_or_default();
        for word in [jumps, count(joints), count(self.history.len()), 1] {
            bytes.extend(word.to_le_bytes());
        }
        for (at, torques) in &self.history {
            bytes.extend(self.seconds(*at).to_le_bytes());
            for value in torques.iter().flatten() {
                #[expect(clippy::cast_possible_truncation, reason = "to be drawn")]
                bytes.extend((*value as f32).to_le_bytes());
            }
        }
        bytes
    }

    /// Converts a time to s of the run, or since the first frame.
    fn seconds(&self, at: u64) -> f64 {
        seconds_since(self.zero, at)
    }

    /// Returns the state for the page.
    #[must_use]
    pub fn playback(&self) -> Playback {
        let progress = self.index.progress();
        let (of, read) = (self.last() - self.first, progress.at.saturating_sub(self.first));
        Playback {
            at_s: self.seconds(self.at),
            at_ns: self.at.to_string(),
            from_s: self.seconds(self.first),
            of_s: self.seconds(self.last()),
            playing: self.playing,
            speed: self.speed,
            exact: self.is_exact,
            read: if progress.is_over { 1.0 } else { (seconds(read) / seconds(of.max(1))).min(1.0) },
            failed: self.failed.clone().or(progress.failed),
            unfinished: progress.unfinished,
            others: progress.others,
            events: progress.events,
            marks: BTreeMap::new(),
        }
    }

    /// Divides the recording into equal parts, and returns the numbers of the parts with events of a kind.
    #[must_use]
    pub fn marks(&self, kind: EventKind, parts: u16) -> Vec<u16> {
        self.index.marks(kind, (self.first, self.last()), parts)
    }
}

#[expect(clippy::cast_precision_loss, reason = "to be shown: some µs of a year")]
fn seconds(nanos: u64) -> f64 {
    nanos as f64 / 1e9
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "the same sums give the same numbers")]
mod tests;
