//! The result for each frame, in input order.

use std::collections::VecDeque;

use protocol::wire_time::Bits;

/// The transmission of a frame on a real bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct FrameTiming {
    /// Its time in the capture, in ns.
    pub nanos: u64,
    /// Its bus, for [`super::Shadow::bus`]; `None` for buses that are not modelled.
    pub bus: Option<usize>,
    /// Its identifier; with the error flag for a driver's error frame.
    pub id: u32,
    /// True if the identifier has more than 11 bits.
    pub extended: bool,
    /// Its bits, including the intermission; `None` for frames that real buses do not carry: frames that only a bench
    /// sends, and the driver's error frames.
    pub bits: Option<Bits>,
    /// The first bit and the end of the intermission of the successful attempt, in ns of the capture's clock; `None` if
    /// it was not sent.
    pub sent: Option<(u64, u64)>,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    shaded: FrameTiming,
    is_open: bool,
}

/// Frames that wait for earlier ones.
#[derive(Debug, Default)]
pub(super) struct FrameTimings {
    entries: VecDeque<Entry>,
    /// The index of the first entry.
    first: u64,
}

impl FrameTimings {
    /// Adds a frame; with bits, its transmission is still unknown.
    pub(super) fn enter(&mut self, shaded: FrameTiming) {
        self.entries.push_back(Entry { shaded, is_open: shaded.bits.is_some() });
    }

    /// Marks a frame as not carried by a real bus.
    pub(super) fn omitted(&mut self, place: u64) {
        self.settle(place, |shaded| shaded.bits = None);
    }

    /// Records the transmission of a frame; `None` if it was not sent.
    pub(super) fn sent(&mut self, place: u64, sent: Option<(u64, u64)>) {
        self.settle(place, |shaded| shaded.sent = sent);
    }

    fn settle(&mut self, place: u64, change: impl FnOnce(&mut FrameTiming)) {
        let index = usize::try_from(place - self.first).ok();
        if let Some(entry) = index.and_then(|index| self.entries.get_mut(index)) {
            change(&mut entry.shaded);
            entry.is_open = false;
        }
    }

    pub(super) fn finish(&mut self) {
        self.entries.iter_mut().for_each(|entry| entry.is_open = false);
    }

    pub(super) fn poll(&mut self) -> Option<FrameTiming> {
        let shaded = self.entries.front().filter(|entry| !entry.is_open)?.shaded;
        self.entries.pop_front();
        self.first += 1;
        Some(shaded)
    }
}
