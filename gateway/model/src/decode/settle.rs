//! Classifies frames once that is certain, in the order in which they came.
//!
//! ```text
//!   frames ──> Settler ──> the same frames in the same order, each with what it is
//!                └ those since the oldest of whose packet segments may still come
//! ```
//!
//! A classic frame is a segment of a packet or foreign. Which of them is known with the next frame of its identifier,
//! or when its packet's other segments time out. Until then it waits, and so do all frames that came after it.

use std::collections::VecDeque;

use protocol::can::{Format, Frame};
use protocol::id::Id;
use protocol::packet::Segment;
use protocol::time::{Micros, Span};

use super::{Decoded, Decoder};

/// Frames that wait at most; beyond them the oldest is given out without the others of its packet.
const FRAMES: usize = 1 << 16;
/// Added to the timeout of segments: frames of several buses may be out of order by that much.
const SLACK: Span = Span::from_millis(100);

/// Classifies frames in the order in which they came; `T` is given out with each.
#[derive(Debug)]
pub struct Settler<T> {
    decoder: Decoder,
    waiting: VecDeque<Entry<T>>,
    /// The number of the oldest frame that waits.
    oldest: u64,
    /// When the last frame came, or what time it is.
    now: Micros,
    is_at_end: bool,
}

#[derive(Debug)]
struct Entry<T> {
    item: T,
    at: Micros,
    state: State,
}

#[derive(Debug)]
enum State {
    Settled(Decoded),
    /// On a bus, under an identifier.
    Waits(u64, Id),
}

impl<T> Settler<T> {
    /// For buses of one format; with `None` each frame is taken for what it is.
    #[must_use]
    pub const fn new(format: Option<Format>) -> Self {
        Self {
            decoder: Decoder::new(format),
            waiting: VecDeque::new(),
            oldest: 0,
            now: Micros(0),
            is_at_end: false,
        }
    }

    /// Takes the next frame; [`Settler::pop`] until there is none before the next one.
    pub fn push(&mut self, at: Micros, bus: &str, frame: &Frame, item: T) {
        let number = self.oldest + self.waiting.len() as u64;
        let (bus, (decoded, settled)) = self.decoder.take(number, at, bus, frame);
        for (older, decoded) in settled {
            let older = older.checked_sub(self.oldest).and_then(|index| usize::try_from(index).ok());
            if let Some(entry) = older.and_then(|index| self.waiting.get_mut(index)) {
                entry.state = State::Settled(decoded);
            }
        }
        let state = match decoded {
            Decoded::Segment { id } => State::Waits(bus, id),
            decoded => State::Settled(decoded),
        };
        self.now = at;
        self.is_at_end = false;
        self.waiting.push_back(Entry { item, at, state });
    }

    /// It is that late, and no frame came.
    pub const fn handle_time(&mut self, now: Micros) {
        self.now = now;
    }

    /// No more frames follow.
    pub const fn finish(&mut self) {
        self.is_at_end = true;
    }

    /// Whether frames wait.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// The oldest frame, if it is known what it is.
    pub fn pop(&mut self) -> Option<(T, Decoded)> {
        if let Entry { at, state: State::Waits(bus, id), .. } = *self.waiting.front()? {
            let is_in_time = self.now.since(at) <= Span(Segment::within(id).0 + SLACK.0);
            if is_in_time && !self.is_at_end && self.waiting.len() < FRAMES {
                return None;
            }
            let decoded = self.decoder.give_up(self.oldest, bus, id);
            self.waiting.front_mut()?.state = State::Settled(decoded);
        }
        let Entry { item, state, .. } = self.waiting.pop_front()?;
        self.oldest += 1;
        match state {
            State::Settled(decoded) => Some((item, decoded)),
            State::Waits(..) => None,
        }
    }
}
