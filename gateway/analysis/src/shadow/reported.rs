//! What became of each frame, in the order in which they came.

use std::collections::VecDeque;

use protocol::wire_time::Bits;

/// What a real bus would have made of a frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Shaded {
    /// Its time in the capture, in ns.
    pub nanos: u64,
    /// Its bus, for [`super::Shadow::bus`]; none of a bus beyond those that are modelled.
    pub bus: Option<usize>,
    /// Its identifier; of a driver's error frame with its flag.
    pub id: u32,
    /// Whether that is more than 11 bits.
    pub extended: bool,
    /// Its bits, intermission included; none when it is on no real bus: what only a bench sends, a driver's error frame.
    pub bits: Option<Bits>,
    /// The first bit and the end of the intermission of the attempt that came through, in ns on the capture's clock; none
    /// when it never went out.
    pub sent: Option<(u64, u64)>,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    shaded: Shaded,
    is_open: bool,
}

/// Frames that wait for those before them.
#[derive(Debug, Default)]
pub(super) struct Reported {
    entries: VecDeque<Entry>,
    /// The place of the first one.
    first: u64,
}

impl Reported {
    /// A frame came; of one with bits it is not known yet when it goes out.
    pub(super) fn enter(&mut self, shaded: Shaded) {
        self.entries.push_back(Entry { shaded, is_open: shaded.bits.is_some() });
    }

    /// No real bus carries it.
    pub(super) fn omitted(&mut self, place: u64) {
        self.settle(place, |shaded| shaded.bits = None);
    }

    /// When it went out; none if never.
    pub(super) fn sent(&mut self, place: u64, sent: Option<(u64, u64)>) {
        self.settle(place, |shaded| shaded.sent = sent);
    }

    fn settle(&mut self, place: u64, change: impl FnOnce(&mut Shaded)) {
        let index = usize::try_from(place - self.first).ok();
        if let Some(entry) = index.and_then(|index| self.entries.get_mut(index)) {
            change(&mut entry.shaded);
            entry.is_open = false;
        }
    }

    pub(super) fn finish(&mut self) {
        self.entries.iter_mut().for_each(|entry| entry.is_open = false);
    }

    pub(super) fn poll(&mut self) -> Option<Shaded> {
        let shaded = self.entries.front().filter(|entry| !entry.is_open)?.shaded;
        self.entries.pop_front();
        self.first += 1;
        Some(shaded)
    }
}
