//! Classifies frames in order of arrival, each as soon as its class is certain.
//!
//! ```text
//!   frames ──> OrderedDecoder ──> the same frames in the same order, each with its class
//!                    └ pending frames, from the oldest segment of an open packet
//! ```
//!
//! A classic frame is a segment of a packet or foreign. The next frame of its identifier, or the timeout of its packet,
//! decides. Until then it is pending, and all later frames wait behind it.

use std::collections::VecDeque;

use protocol::can::{Format, Frame};
use protocol::id::Id;
use protocol::packet::Reassembler;
use protocol::time::{Micros, Span};

use super::{Decoded, Decoder};

/// Maximum number of pending frames. Beyond it, the oldest frame is classified without the rest of its packet.
const MAX_PENDING_FRAMES: usize = 1 << 16;
/// Time that is added to the timeout of segments, because the frames of several buses may be out of order by this much.
const REORDER_TOLERANCE: Span = Span::from_millis(100);

/// Classifies frames in order of arrival. A `T` is passed in with each frame and returned with its class.
#[derive(Debug)]
pub struct OrderedDecoder<T> {
    decoder: Decoder,
    waiting: VecDeque<FrameEntry<T>>,
    /// Number of the oldest pending frame.
    oldest: u64,
    /// The current time: the arrival time of the last frame, or later.
    now: Micros,
    is_at_end: bool,
}

#[derive(Debug)]
struct FrameEntry<T> {
    item: T,
    at: Micros,
    state: EntryState,
}

#[derive(Debug)]
enum EntryState {
    Settled(Decoded),
    /// The frame is pending; holds the number of its bus and its identifier.
    Pending(u64, Id),
}

impl<T> OrderedDecoder<T> {
    /// Creates a settler for buses of one frame format; with `None`, the format of each frame is used.
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

    /// Adds the next frame. Call [`OrderedDecoder::pop`] until it returns `None` before adding another.
    pub fn push(&mut self, at: Micros, bus: &str, frame: &Frame, item: T) {
        let number = self.oldest + self.waiting.len() as u64;
        let (bus, (decoded, settled)) = self.decoder.classify(number, at, bus, frame);
        for (older, decoded) in settled {
            let older = older.checked_sub(self.oldest).and_then(|index| usize::try_from(index).ok());
            if let Some(entry) = older.and_then(|index| self.waiting.get_mut(index)) {
                entry.state = EntryState::Settled(decoded);
            }
        }
        let state = if let Decoded::Segment { id } = decoded {
            EntryState::Pending(bus, id)
        } else {
            EntryState::Settled(decoded)
        };
        self.now = at;
        self.is_at_end = false;
        self.waiting.push_back(FrameEntry { item, at, state });
    }

    /// Advances the current time while no frame arrives, so that pending segments can time out.
    pub const fn handle_time(&mut self, now: Micros) {
        self.now = now;
    }

    /// Marks the end of input: pending segments are classified at once.
    pub const fn finish(&mut self) {
        self.is_at_end = true;
    }

    /// Returns true if the class of a frame is still open.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Removes and returns the oldest frame with its class; `None` if that class is still open.
    pub fn pop(&mut self) -> Option<(T, Decoded)> {
        if let FrameEntry { at, state: EntryState::Pending(bus, id), .. } = *self.waiting.front()? {
            let is_in_time =
                self.now.elapsed_since(at) <= Span(Reassembler::max_gap(id).0 + REORDER_TOLERANCE.0);
            if is_in_time && !self.is_at_end && self.waiting.len() < MAX_PENDING_FRAMES {
                return None;
            }
            let decoded = self.decoder.classify_incomplete(self.oldest, bus, id);
            self.waiting.front_mut()?.state = EntryState::Settled(decoded);
        }
        let FrameEntry { item, state, .. } = self.waiting.pop_front()?;
        self.oldest += 1;
        match state {
            EntryState::Settled(decoded) => Some((item, decoded)),
            EntryState::Pending(..) => None,
        }
    }
}
