//! Detects frames of other hosts that come back: from a second link of the bus, or from an adapter or a bridge that
//! makes a circle.
//!
//! A bus delivers a sender's frames to all others. If this link receives a frame from the bus that it has put there
//! itself, another program sent it again: there is a circle. The link of the other side would never see a frame of its
//! own in it. For a second after that, a frame therefore passes this link in either direction only once in 100 ms.

use std::collections::{HashMap, VecDeque};
use std::hash::{BuildHasher, RandomState};

use protocol::can::Frame;

/// The time after a frame has passed during which the same frame counts as returned, in ns.
pub const RETURN_WINDOW_NS: u64 = 100_000_000;
/// The time after a frame of this link has returned during which a circle is assumed, in ns.
const CIRCLE_NS: u64 = 1_000_000_000;
/// The maximum number of frames that are remembered in each direction.
const REMEMBERED: usize = 16_384;

/// The frames that passed recently.
#[derive(Debug, Default)]
pub struct CircleDetector {
    hasher: RandomState,
    put: Recent,
    /// Frames received from the bus. Recorded only while a circle is assumed.
    taken: Recent,
    /// The time at which a frame of this link last returned.
    noticed: Option<u64>,
    count: u64,
}

impl CircleDetector {
    /// Records a frame that was put on the bus, at a time of a monotonic clock.
    pub fn put(&mut self, now: u64, frame: &Frame) {
        let hash = self.hash(frame);
        self.put.insert(now, hash);
    }

    /// Returns true if a frame that is to be put on the bus is a copy that went around a circle.
    pub fn is_copy(&mut self, now: u64, frame: &Frame) -> bool {
        self.is_circle(now) && self.put.contains(now, self.hash(frame))
    }

    /// Returns true if a frame from the bus is one that this link put there, or in a circle one that was received
    /// before.
    pub fn is_returned(&mut self, now: u64, frame: &Frame) -> bool {
        let is_circle = self.is_circle(now);
        // Usually no frames are remembered, if the bus only sends.
        if self.put.is_empty(now) && !is_circle {
            return false;
        }
        let hash = self.hash(frame);
        let was_put = self.put.contains(now, hash);
        if was_put {
            self.noticed = Some(now);
        }
        let is_returned = was_put || is_circle && self.taken.contains(now, hash);
        if is_circle && !is_returned {
            self.taken.insert(now, hash);
        }
        self.count += u64::from(is_returned);
        is_returned
    }

    /// Returns the number of frames from the bus that had returned.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    fn is_circle(&self, now: u64) -> bool {
        self.noticed.is_some_and(|at| now.saturating_sub(at) <= CIRCLE_NS)
    }

    fn hash(&self, frame: &Frame) -> u64 {
        self.hasher.hash_one((frame.to_bytes(), frame.format()))
    }
}

/// Frames of the last 100 ms, by their hashes.
#[derive(Debug, Default)]
struct Recent {
    /// Times and hashes in order.
    order: VecDeque<(u64, u64)>,
    /// The number of occurrences of each hash.
    times: HashMap<u64, u32>,
}

impl Recent {
    fn insert(&mut self, now: u64, hash: u64) {
        self.forget(now);
        if self.order.len() >= REMEMBERED {
            self.forget_one();
        }
        self.order.push_back((now, hash));
        *self.times.entry(hash).or_default() += 1;
    }

    fn contains(&mut self, now: u64, hash: u64) -> bool {
        self.forget(now);
        self.times.contains_key(&hash)
    }

    fn is_empty(&mut self, now: u64) -> bool {
        self.forget(now);
        self.order.is_empty()
    }

    fn forget(&mut self, now: u64) {
        while self.order.front().is_some_and(|&(at, _)| now.saturating_sub(at) > RETURN_WINDOW_NS) {
            self.forget_one();
        }
    }

    fn forget_one(&mut self) {
        let Some((_, hash)) = self.order.pop_front() else { return };
        if let Some(times) = self.times.get_mut(&hash) {
            *times -= 1;
            if *times == 0 {
                self.times.remove(&hash);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn frame(id: u32, data: &[u8]) -> Frame {
        Frame::classic(id, data).unwrap()
    }

    #[test]
    fn a_frame_that_was_put_there_comes_back_and_others_do_not() {
        let mut returned = CircleDetector::default();
        let it = frame(0x201, &[1, 2]);
        assert!(!returned.is_returned(0, &it));
        returned.put(MS, &it);
        let others = [frame(0x202, &[1, 2]), frame(0x201, &[1]), Frame::fd(0x201, 0, &[1, 2]).unwrap()];
        assert!(others.iter().all(|other| !returned.is_returned(2 * MS, other)));
        assert!(
            returned.is_returned(3 * MS, &it) && returned.is_returned(101 * MS, &it),
            "as often as it goes around"
        );
        assert!(!returned.is_returned(102 * MS, &it), "a torque may be the same again");
        assert_eq!((returned.count(), returned.put.times.len()), (2, 0));
    }

    #[test]
    fn no_more_is_remembered_than_may() {
        let mut returned = CircleDetector::default();
        for number in 0..2 * REMEMBERED as u64 {
            returned.put(0, &frame(0x201, &(number / 3).to_le_bytes()));
        }
        assert_eq!(returned.put.order.len(), REMEMBERED);
        let sum: u32 = returned.put.times.values().sum();
        assert_eq!(sum as usize, REMEMBERED);
    }

    /// A bridge sends on the first bus what arrives on the second. Frames of the first bus go around a circle in which
    /// no link sees a frame that it has put on its bus, until a frame of the second bus goes around.
    #[test]
    fn in_a_circle_that_was_noticed_a_frame_passes_once_in_100_ms() {
        let (it, other) = (frame(0x201, &[1]), frame(0x202, &[2]));
        let mut first = CircleDetector::default();
        for at in 0..50 {
            assert!(!first.is_returned(at * MS, &it), "it could be sent again and again");
        }
        first.put(50 * MS, &other);
        assert!(first.is_returned(51 * MS, &other));
        assert!(!first.is_returned(52 * MS, &it));
        assert!(first.is_returned(53 * MS, &it) && first.is_returned(152 * MS, &it));
        assert!(!first.is_returned(153 * MS, &it), "whoever sends it means it");

        let mut second = CircleDetector::default();
        second.put(0, &it);
        assert!(!second.is_copy(MS, &it), "no circle");
        assert!(second.is_returned(2 * MS, &it));
        assert!(second.is_copy(3 * MS, &it) && !second.is_copy(3 * MS, &other));
        assert!(!second.is_copy(101 * MS, &it));
        second.put(2_000 * MS, &it);
        assert!(!second.is_copy(2_001 * MS, &it), "the circle is gone");
    }
}
