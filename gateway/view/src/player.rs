//! A recording that is played: a position in it, and what is known there.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use protocol::skin::Skin;
use protocol::time::Micros;
use serde::Serialize;
use trace::capture::{CaptureError, Entry, Place, Places, Reader, seconds_since};

use crate::index::{Index, Kept};
use crate::live::Live;
use crate::tape::{EventKind, Step, Tape};

/// What is known of the time before a position: the plots show so much.
const HISTORY_NS: u64 = 10_000_000_000;
/// The same where the index has not come to the position yet.
const GLANCE_NS: u64 = 3_000_000_000;
/// From one value of a plot to the next.
const SAMPLE_NS: u64 = 20_000_000;
/// The slowest and the fastest speed.
const SPEEDS: [f64; 2] = [0.01, 100.0];

/// The torques of all joints at a moment: distributed and central.
type Sample = (u64, Vec<[f64; 2]>);

/// A recording at a position.
#[derive(Debug)]
pub struct Player {
    skin: Skin,
    places: Places,
    index: Arc<Index>,
    reader: Reader,
    tape: Tape,
    /// The time of the first frame, in ns since 1970.
    first: u64,
    /// The time that seconds count from, in ns since 1970.
    zero: u64,
    /// The position, in ns since 1970.
    at: u64,
    /// Whether all counts are those since the beginning.
    is_exact: bool,
    playing: bool,
    speed: f64,
    history: VecDeque<Sample>,
    /// Counts positions that were gone to: then plots begin again.
    jumps: u64,
    /// Why the last position cannot be shown.
    failed: Option<String>,
}

/// What a page shows of a player.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Playback {
    /// The position, in s of the run, or since the first frame where there is no run.
    pub at_s: f64,
    /// The position as ns since 1970.
    pub at_ns: String,
    /// The first frame, in the same s: before 0 where the loop began later.
    pub from_s: f64,
    /// The end, in the same s.
    pub of_s: f64,
    /// Whether it plays.
    pub playing: bool,
    /// How many s of the recording pass in one.
    pub speed: f64,
    /// Whether all counts are those since the beginning.
    pub exact: bool,
    /// How much of it has been read, 0 to 1.
    pub read: f64,
    /// Why it cannot be read further.
    pub failed: Option<String>,
    /// What is missing at its end.
    pub unfinished: Option<String>,
    /// Frames of buses that are not the skin's.
    pub others: u64,
    /// Events so far.
    pub events: usize,
    /// In which of 600 equal parts of the recording there are events, by kind.
    pub marks: BTreeMap<EventKind, Vec<u16>>,
}

impl Playback {
    /// With its marks.
    #[must_use]
    pub fn marked(self, marks: BTreeMap<EventKind, Vec<u16>>) -> Self {
        Self { marks, ..self }
    }
}

/// Why a recording cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum PlayError {
    /// It cannot be read.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// From a place on it cannot be read; what is before that was shown.
    #[error("{0}")]
    Damaged(String),
    /// There is nothing in it.
    #[error("{0}: there is no frame in it")]
    Empty(String),
}

impl Player {
    /// Opens a recording at its first frame.
    ///
    /// # Errors
    /// When it cannot be read or gone back in, or has no frame.
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
        let places = Places::of(paths)?;
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

    /// The index, to be built in another thread.
    #[must_use]
    pub fn index(&self) -> Arc<Index> {
        Arc::clone(&self.index)
    }

    /// The time of the first frame, in ns since 1970.
    #[must_use]
    pub const fn first(&self) -> u64 {
        self.first
    }

    /// The time that seconds count from, in ns since 1970.
    #[must_use]
    pub const fn zero(&self) -> u64 {
        self.zero
    }

    /// What is known at the position.
    pub const fn live(&mut self) -> &mut Live {
        self.tape.live_mut()
    }

    /// The position.
    #[must_use]
    pub const fn now(&self) -> Micros {
        Micros(self.at / 1_000)
    }

    /// Counts the positions that were gone to.
    #[must_use]
    pub const fn jumps(&self) -> u64 {
        self.jumps
    }

    /// The end, as far as it is known.
    fn last(&self) -> u64 {
        let progress = self.index.progress();
        let last = if progress.is_over { progress.at } else { self.places.latest().max(progress.at) };
        last.max(self.first)
    }

    /// Plays at a speed from now on; what is no speed is held within the limits.
    pub fn play(&mut self, speed: f64) {
        let [min, max] = SPEEDS;
        self.speed = if speed.is_finite() { speed.clamp(min, max) } else { 1.0 };
        self.playing = true;
    }

    /// The recording cannot be read there; it stays.
    pub fn fail(&mut self, why: String) {
        self.playing = false;
        self.failed = Some(why);
    }

    /// Stays where it is.
    pub const fn pause(&mut self) {
        self.playing = false;
    }

    /// Time has passed; whether anything has changed.
    ///
    /// # Errors
    /// When the recording cannot be read further.
    pub fn pass(&mut self, elapsed: Duration) -> Result<bool, CaptureError> {
        if !self.is_exact && self.index_is_at(self.at) {
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

    /// Goes to a position, in s of the run, or since the first frame, within the recording.
    ///
    /// # Errors
    /// When it cannot be read there.
    pub fn seek(&mut self, at_s: f64) -> Result<(), CaptureError> {
        #[expect(clippy::cast_possible_truncation, reason = "saturates")]
        let since = (at_s * 1e9).round() as i64;
        self.go_to(self.zero.saturating_add_signed(since))
    }

    /// Goes to the next epoch, or the one before, and stays there.
    ///
    /// # Errors
    /// When it cannot be read there.
    pub fn step(&mut self, forward: bool) -> Result<(), CaptureError> {
        self.playing = false;
        if forward {
            return self.advance(self.last(), true);
        }
        if self.tape.epoch_before(self.at).is_none() {
            // What is before is read.
            self.go_back(self.at)?;
        }
        let before = self.tape.epoch_before(self.at);
        before.map_or(Ok(()), |before| self.go_to(before))
    }

    /// Goes to the next event of a kind, or the last one, and stays there; whether there is one.
    ///
    /// # Errors
    /// When it cannot be read there.
    pub fn jump(&mut self, kind: EventKind, forward: bool) -> Result<bool, CaptureError> {
        let Some(at) = self.index.event(kind, self.at, forward) else { return Ok(false) };
        self.playing = false;
        self.go_to(at)?;
        Ok(true)
    }

    fn index_is_at(&self, at: u64) -> bool {
        let progress = self.index.progress();
        progress.is_over || progress.at >= at
    }

    fn go_to(&mut self, at: u64) -> Result<(), CaptureError> {
        let at = at.clamp(self.first, self.last());
        let near = self.tape.at() <= at && at - self.tape.at() <= HISTORY_NS;
        if near && self.is_exact {
            return self.advance(at, false);
        }
        self.go_back(at)
    }

    /// Goes to a position from what is kept before it.
    fn go_back(&mut self, at: u64) -> Result<(), CaptureError> {
        self.is_exact = self.index_is_at(at) || at <= self.first.saturating_add(HISTORY_NS);
        let kept = self.index.before(at.saturating_sub(HISTORY_NS)).filter(|_| self.is_exact);
        let place = match kept.as_deref() {
            Some(Kept { tape, place }) => {
                self.tape.clone_from(tape);
                *place
            }
            None => {
                self.tape = Tape::new(self.skin.clone(), self.zero);
                match self.is_exact {
                    true => Place::default(),
                    false => self.places.before(at.saturating_sub(GLANCE_NS)),
                }
            }
        };
        self.reader.go_to(&self.places, place)?;
        if place == Place::default() {
            self.tape.begin(self.reader.extras());
        }
        self.history.clear();
        self.failed = None;
        self.jumps += 1;
        self.advance(at, false)
    }

    /// Goes on to a position, or to the first epoch before it.
    fn advance(&mut self, until: u64, to_epoch: bool) -> Result<(), CaptureError> {
        loop {
            match self.tape.step(until) {
                Step::Hungry => self.tape.feed(&mut self.reader)?,
                Step::Looked => {}
                Step::Applied { epoch } => {
                    let at = self.tape.at();
                    let is_due = |(last, _): &(u64, _)| at.saturating_sub(*last) >= SAMPLE_NS;
                    if epoch && self.history.back().is_none_or(is_due) {
                        self.history.push_back((at, self.tape.live().torques()));
                    }
                    if epoch && to_epoch && self.tape.at() > self.at {
                        break;
                    }
                }
                Step::There | Step::Over => break,
            }
        }
        self.at = if to_epoch { self.tape.at().min(until) } else { until };
        let old = self.at.saturating_sub(HISTORY_NS);
        while self.history.front().is_some_and(|(at, _)| *at < old) {
            self.history.pop_front();
        }
        Ok(())
    }

    /// The torques of the last seconds, as bytes, little-endian:
    ///
    /// | bytes | what |
    /// |---|---|
    /// | 4 | how many positions were gone to, u32 |
    /// | 4 | joints J of the robot, u32 |
    /// | 4 | moments, u32 |
    /// | 4 | 1: a history |
    /// | 8 + 8 J for each moment | s of the run, or since the first frame f64; of each joint distributed and central torque f32 |
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

    /// A time in s of the run, or since the first frame.
    fn seconds(&self, at: u64) -> f64 {
        seconds_since(self.zero, at)
    }

    /// What a page shows of it.
    #[must_use]
    pub fn said(&self) -> Playback {
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

    /// In which of so many equal parts of the recording there are events of a kind.
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
