//! Merges the frames of several buses by time, in bounded memory.
//!
//! ```text
//! frames in the capture's order ──> push ──> [ window ] ──> pop ──> frames in the order in which they are sent
//! ```
//!
//! A recorder of several buses reads them in turn. In a capture the frames of one bus are therefore in the order of the
//! bus, but those of two buses may not be in the order of their times. The merge is by time, and it never changes the
//! order of one bus: frames that a cell received before the joints must come before the joints again, whatever their
//! time stamps are. Frames of the same time keep the capture's order.

use std::collections::BTreeMap;

/// The time for which a frame waits for older ones, in ns: it is released when a frame newer by this much has been
/// read.
pub const REORDER_WINDOW_NS: u64 = 1_000_000_000;
/// The maximum number of waiting frames.
pub const MAX_WAITING_FRAMES: usize = 8_192;

/// A frame that is released for sending.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ReleasedFrame<T> {
    /// The time to send the frame, by the capture's clock. It is never before the time of the preceding frame.
    pub send_nanos: u64,
    /// The frame's own time.
    pub nanos: u64,
    /// True if a newer frame was already released, so that the frame is out of order and is sent at once.
    pub is_late: bool,
    /// The frame.
    pub item: T,
}

/// Merges buses by time.
#[derive(Clone, Debug)]
pub struct BusMerger<T> {
    /// The waiting frames, each with its own time. A frame is sorted by its time, but never before an earlier frame of
    /// its bus; frames with equal times are sorted by their position in the capture.
    waiting: BTreeMap<(u64, u64), (u64, T)>,
    /// The latest time so far on each bus.
    buses: Vec<u64>,
    places: u64,
    newest: u64,
    /// The time of the frame that was released last.
    released: u64,
}

impl<T> Default for BusMerger<T> {
    fn default() -> Self {
        Self { waiting: BTreeMap::new(), buses: Vec::new(), places: 0, newest: 0, released: 0 }
    }
}

impl<T> BusMerger<T> {
    /// Adds the capture's next frame.
    pub fn push(&mut self, bus: usize, nanos: u64, item: T) {
        if self.buses.len() <= bus {
            self.buses.resize(bus + 1, 0);
        }
        let key = self.buses.get_mut(bus).map_or(nanos, |max| {
            *max = nanos.max(*max);
            *max
        });
        self.waiting.insert((key, self.places), (nanos, item));
        self.places += 1;
        self.newest = self.newest.max(nanos);
    }

    /// Returns the next frame in order of time. Returns `None` if an older frame may still be read from the capture.
    pub fn pop(&mut self) -> Option<ReleasedFrame<T>> {
        let (&(key, _), _) = self.waiting.first_key_value()?;
        let waits =
            self.newest.saturating_sub(key) <= REORDER_WINDOW_NS && self.waiting.len() <= MAX_WAITING_FRAMES;
        if waits { None } else { self.pop_without_waiting() }
    }

    /// Returns true if no frame waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Returns the next frame without waiting, at the end of the capture.
    pub fn pop_without_waiting(&mut self) -> Option<ReleasedFrame<T>> {
        let ((key, _), (nanos, item)) = self.waiting.pop_first()?;
        let is_late = nanos < self.released;
        self.released = self.released.max(key);
        Some(ReleasedFrame { send_nanos: self.released, nanos, is_late, item })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Returns all frames in the order of their release, each with its bus and its position in the capture.
    fn merged(frames: &[(usize, u64)]) -> Vec<ReleasedFrame<(usize, usize)>> {
        let mut order = BusMerger::default();
        let mut out = Vec::new();
        for (place, &(bus, nanos)) in frames.iter().enumerate() {
            order.push(bus, nanos, (bus, place));
            out.extend(std::iter::from_fn(|| order.pop()));
        }
        out.extend(std::iter::from_fn(|| order.pop_without_waiting()));
        out
    }

    const MS: u64 = 1_000_000;

    #[test]
    fn buses_that_were_read_in_turn_are_merged() {
        let frames = [(0, 10), (0, 30), (0, 50), (1, 20), (1, 30), (1, 40)].map(|(bus, at)| (bus, at * MS));
        let places: Vec<_> = merged(&frames).iter().map(|it| it.item.1).collect();
        assert_eq!(places, [0, 3, 1, 4, 5, 2], "of the same time, the capture's order");
    }

    #[test]
    fn the_order_of_one_bus_is_never_changed() {
        let frames = [(0, 20 * MS), (0, 10 * MS), (1, 15 * MS)];
        let out = merged(&frames);
        let seen: Vec<_> = out.iter().map(|it| (it.item.1, it.send_nanos / MS, it.is_late)).collect();
        assert_eq!(seen, [(2, 15, false), (0, 20, false), (1, 20, true)]);
    }

    #[test]
    fn what_is_older_than_the_window_comes_at_once() {
        let frames = [(0, 1_000 * MS), (0, 5_000 * MS), (1, 500 * MS), (0, 9_000 * MS)];
        let out = merged(&frames);
        let seen: Vec<_> = out.iter().map(|it| (it.item.1, it.send_nanos / MS, it.is_late)).collect();
        assert_eq!(seen, [(0, 1_000, false), (2, 1_000, true), (1, 5_000, false), (3, 9_000, false)]);
    }

    #[test]
    fn no_more_frames_wait_than_are_said_to() {
        let mut order = BusMerger::default();
        for place in 0..3 * MAX_WAITING_FRAMES {
            order.push(0, 7, place);
            while order.pop().is_some() {}
            assert!(order.waiting.len() <= MAX_WAITING_FRAMES);
        }
    }

    proptest! {
        #[test]
        fn all_come_out_once_in_each_bus_order_and_times_never_run_backwards(
            frames in proptest::collection::vec((0_usize..3, 0_u64..4_000), 0..200),
        ) {
            let frames: Vec<_> = frames.into_iter().map(|(bus, at)| (bus, at * MS)).collect();
            let out = merged(&frames);
            prop_assert_eq!(out.len(), frames.len());
            prop_assert!(out.is_sorted_by_key(|it| it.send_nanos));
            for bus in 0..3 {
                let places: Vec<_> =
                    out.iter().filter(|it| it.item.0 == bus).map(|it| it.item.1).collect();
                let expected: Vec<_> = (0..frames.len()).filter(|&place| frames[place].0 == bus).collect();
                prop_assert_eq!(places, expected);
            }
            for it in &out {
                prop_assert_eq!(it.is_late, it.nanos < it.send_nanos, "at once is when it is late, and only then");
            }
        }

        #[test]
        fn disorder_within_the_window_is_repaired(
            steps in proptest::collection::vec((0_usize..3, 1_u64..50, 0_u64..900), 1..200),
        ) {
            // The frames of each bus are in order. Each bus is read up to 0.9 s late.
            let mut buses = [Vec::new(), Vec::new(), Vec::new()];
            let mut now = 0;
            for (bus, step, late) in steps {
                now += step * MS;
                let read = buses[bus].last().map_or(0, |&(_, read)| read).max(now + late * MS);
                buses[bus].push((now, read));
            }
            let mut frames: Vec<_> =
                buses.iter().enumerate().flat_map(|(bus, of)| of.iter().map(move |&(at, read)| (read, bus, at))).collect();
            frames.sort_unstable();
            let frames: Vec<_> = frames.into_iter().map(|(_, bus, at)| (bus, at)).collect();
            let out = merged(&frames);
            prop_assert!(out.is_sorted_by_key(|it| it.nanos));
            prop_assert!(out.iter().all(|it| !it.is_late && it.send_nanos == it.nanos));
        }
    }
}
