//! The transmission of each frame, returned in the order of the input.

use std::collections::VecDeque;

use protocol::wire_time::FrameBits;

/// The transmission of a frame on a real bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct FrameTiming {
    /// Time of the frame in the capture, in ns.
    pub nanos: u64,
    /// Number of the frame's bus, for [`super::Shadow::bus`]; `None` for a bus that is not modelled.
    pub bus: Option<usize>,
    /// Identifier of the frame; with the error flag for a driver's error frame.
    pub id: u32,
    /// True if the identifier has more than 11 bits.
    pub extended: bool,
    /// Bits of the frame, including the intermission. `None` for a frame that real buses do not carry: one that only a
    /// bench sends, or the driver's error frame.
    pub bits: Option<FrameBits>,
    /// Start of the first bit and end of the intermission of the successful transmission, in ns of the capture's clock;
    /// `None` if the frame was not sent.
    pub sent: Option<(u64, u64)>,
}

#[derive(Clone, Copy, Debug)]
struct FrameEntry {
    shaded: FrameTiming,
    is_open: bool,
}

/// Frames whose transmission, or that of an earlier frame, is still unknown.
#[derive(Debug, Default)]
pub(super) struct FrameTimings {
    entries: VecDeque<FrameEntry>,
    /// Index in the input of the first entry.
    first: u64,
}

impl FrameTimings {
    /// Adds a frame. If it has bits, its transmission is still unknown.
    pub(super) fn add_frame(&mut self, shaded: FrameTiming) {
        self.entries.push_back(FrameEntry { shaded, is_open: shaded.bits.is_some() });
    }

    /// Marks a frame as one that a real bus does not carry.
    pub(super) fn mark_omitted(&mut self, place: u64) {
        self.complete_frame(place, |shaded| shaded.bits = None);
    }

    /// Records when a frame was sent; `None` if it was not sent.
    pub(super) fn record_sent(&mut self, place: u64, sent: Option<(u64, u64)>) {
        self.complete_frame(place, |shaded| shaded.sent = sent);
    }

    fn complete_frame(&mut self, place: u64, change: impl FnOnce(&mut FrameTiming)) {
        let index = usize::try_from(place - self.first).ok();
        if let Some(entry) = index.and_then(|index| self.entries.get_mut(index)) {
            change(&mut entry.shaded);
            entry.is_open = false;
        }
    }

    pub(super) fn finish(&mut self) {
        self.entries.iter_mut().for_each(|entry| entry.is_open = false);
    }

    pub(super) fn poll_frame(&mut self) -> Option<FrameTiming> {
        let shaded = self.entries.front().filter(|entry| !entry.is_open)?.shaded;
        self.entries.pop_front();
        self.first += 1;
        Some(shaded)
    }
}
