//! What a recording says at some of its moments, and what happens in it: worked out once, from its beginning to its end.
//!
//! A moment is shown from the [`Kept`] state before it. Until the index has come to a moment, nobody knows what was
//! counted before it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use protocol::skin::Skin;
use trace::capture::{CaptureError, Place, Reader};

use crate::locked;
use crate::tape::{Event, EventKind, Step, Tape, Watcher};

/// Bytes that the kept states may take in all, about.
const BYTES: usize = 256 << 20;
/// What a state takes for each bus and each cell, about.
const BUS_BYTES: usize = 1 << 20;
const CELL_BYTES: usize = 4 << 10;
/// From one kept state to the next in a short recording, in ns.
const SPACING_NS: u64 = 2_000_000_000;

/// A recording up to a moment, and where it goes on.
#[derive(Debug)]
pub struct Kept {
    /// What is known.
    pub tape: Tape,
    /// Where the next entry is.
    pub place: Place,
}

/// The index of a recording, which grows in one thread and is read in another.
#[derive(Debug, Default)]
pub struct Index(Mutex<Inner>);

#[derive(Debug, Default)]
struct Inner {
    kept: Vec<Arc<Kept>>,
    events: Vec<Event>,
    at: u64,
    is_over: bool,
    failed: Option<String>,
    unfinished: Option<String>,
    others: u64,
}

/// How far an index is.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// Up to this moment it is known, in ns since 1970.
    pub at: u64,
    /// Whether that is the end.
    pub is_over: bool,
    /// Why nothing more can be read.
    pub failed: Option<String>,
    /// What is missing at its end.
    pub unfinished: Option<String>,
    /// Frames of buses that are not the skin's.
    pub others: u64,
    /// Events so far.
    pub events: usize,
}

impl Index {
    /// Goes through a recording from its first frame, until `stop`. Times are said since `zero`.
    pub fn build(&self, mut reader: Reader, skin: Skin, (first, zero): (u64, u64), stop: &AtomicBool) {
        let count = BYTES / (skin.buses.len() * BUS_BYTES + skin.cells.len() * CELL_BYTES).max(1);
        let mut spacing = SPACING_NS;
        let mut next = first.saturating_add(spacing);
        let mut tape = Tape::new(skin, zero);
        tape.begin(reader.extras());
        let mut watcher = Watcher::default();
        while !tape.is_over() && !stop.load(Ordering::Relaxed) {
            match tape.step(u64::MAX) {
                Step::Hungry => {
                    if let Err(error) = tape.feed(&mut reader) {
                        self.fail(&error);
                    }
                }
                Step::Looked => {
                    let events = watcher.look(tape.at(), tape.live());
                    let kept = (tape.at() >= next).then(|| {
                        let mut kept = Kept { tape: tape.clone(), place: reader.place() };
                        kept.tape.forget_recent();
                        Arc::new(kept)
                    });
                    let mut inner = locked(&self.0);
                    (inner.at, inner.others) = (tape.at(), tape.others());
                    inner.events.extend(events);
                    if let Some(kept) = kept {
                        inner.kept.push(kept);
                        if inner.kept.len() > count.max(4) {
                            let mut number = 0;
                            inner.kept.retain(|_| {
                                number += 1;
                                number % 2 == 0
                            });
                            spacing *= 2;
                        }
                        next = tape.at().saturating_add(spacing);
                    }
                }
                Step::Applied { .. } | Step::There | Step::Over => {}
            }
        }
        let mut inner = locked(&self.0);
        inner.unfinished.clone_from(&reader.extras().unfinished);
        (inner.at, inner.others, inner.is_over) = (tape.at(), tape.others(), true);
        inner.events.extend(watcher.look(tape.at(), tape.live()));
    }

    fn fail(&self, error: &CaptureError) {
        locked(&self.0).failed = Some(error.to_string());
    }

    /// How far it is.
    #[must_use]
    pub fn progress(&self) -> Progress {
        let inner = locked(&self.0);
        let Inner { at, is_over, others, .. } = *inner;
        let (failed, unfinished) = (inner.failed.clone(), inner.unfinished.clone());
        Progress { at, is_over, failed, unfinished, others, events: inner.events.len() }
    }

    /// The last kept state at or before a moment.
    #[must_use]
    pub fn before(&self, at: u64) -> Option<Arc<Kept>> {
        let inner = locked(&self.0);
        let place = inner.kept.partition_point(|kept| kept.tape.at() <= at).checked_sub(1)?;
        inner.kept.get(place).cloned()
    }

    /// The next event of a kind after a moment, or the last one before it.
    #[must_use]
    pub fn event(&self, kind: EventKind, from: u64, forward: bool) -> Option<u64> {
        let inner = locked(&self.0);
        let mut of_kind = inner.events.iter().filter(|event| event.kind == kind).map(|event| event.at);
        if forward { of_kind.find(|at| *at > from) } else { of_kind.rev().find(|at| *at < from) }
    }

    /// In which of so many equal parts of the time between two moments there are events of a kind.
    #[must_use]
    pub fn marks(&self, kind: EventKind, (from, to): (u64, u64), parts: u16) -> Vec<u16> {
        let inner = locked(&self.0);
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
