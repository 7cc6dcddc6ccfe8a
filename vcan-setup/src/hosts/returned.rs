//! Detects frames of other hosts that come back from the local bus, because a second link, an adapter or a bridge joins
//! the buses in a circle.
//!
//! A bus delivers a frame to all clients except the sender. If this link receives a frame that it has itself put on the
//! bus, another program must have sent it again: there is a circle. The link at the other end of the circle does not
//! see such a frame. Therefore, for a second after a frame has returned, equal frames pass this link only once in 100
//! ms in each direction.

use std::collections::{HashMap, VecDeque};
use std::hash::{BuildHasher, RandomState};

use protocol::can::Frame;

/// The time after a frame has passed in which an equal frame counts as returned, in ns.
pub const RETURN_WINDOW_NS: u64 = 100_000_000;
/// The time after a frame has returned for which a circle is assumed, in ns.
const CIRCLE_TIMEOUT_NS: u64 = 1_000_000_000;
/// The maximum number of frames that are stored for comparison in each direction.
const MAX_REMEMBERED_FRAMES: usize = 16_384;

/// The frames that passed the link recently, by direction.
#[derive(Debug, Default)]
pub struct ReturnedFrameDetector {
    hasher: RandomState,
    put: RecentFrames,
    /// Frames that were received from the bus. They are stored only while a circle is assumed.
    taken: RecentFrames,
    /// The time at which a frame that this link had put on the bus last returned.
    noticed: Option<u64>,
    count: u64,
}

impl ReturnedFrameDetector {
    /// Stores a frame that the link puts on the bus. `now` is the time of a monotonic clock in ns.
    pub fn record_sent(&mut self, now: u64, frame: &Frame) {
        let hash = self.hash(frame);
        self.put.insert(now, hash);
    }

    /// Returns true if a frame from another host must not be put on the bus, because it has gone around a circle.
    pub fn is_circled_copy(&mut self, now: u64, frame: &Frame) -> bool {
        self.is_circle_assumed(now) && self.put.contains(now, self.hash(frame))
    }

    /// Returns true if the link put this frame from the bus there itself, or, while a circle is assumed, if an equal
    /// frame was received before.
    pub fn is_returned(&mut self, now: u64, frame: &Frame) -> bool {
        let is_circle = self.is_circle_assumed(now);
        // Usually there is nothing to compare, namely if this link puts no frames on the bus.
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

    /// Returns the number of frames from the bus that were recognised as returned.
    #[must_use]
    pub const fn returned_frame_count(&self) -> u64 {
        self.count
    }

    fn is_circle_assumed(&self, now: u64) -> bool {
        self.noticed.is_some_and(|at| now.saturating_sub(at) <= CIRCLE_TIMEOUT_NS)
    }

    fn hash(&self, frame: &Frame) -> u64 {
        self.hasher.hash_one((frame.to_bytes(), frame.format()))
    }
}

/// Hashes of the frames that passed in the last 100 ms.
#[derive(Debug, Default)]
struct RecentFrames {
    /// The time and the hash of each frame, oldest first.
    order: VecDeque<(u64, u64)>,
    /// The number of occurrences of each hash.
    times: HashMap<u64, u32>,
}

impl RecentFrames {
    fn insert(&mut self, now: u64, hash: u64) {
        self.remove_expired(now);
        if self.order.len() >= MAX_REMEMBERED_FRAMES {
            self.remove_oldest();
        }
        self.order.push_back((now, hash));
        *self.times.entry(hash).or_default() += 1;
    }

    fn contains(&mut self, now: u64, hash: u64) -> bool {
        self.remove_expired(now);
        self.times.contains_key(&hash)
    }

    fn is_empty(&mut self, now: u64) -> bool {
        self.remove_expired(now);
        self.order.is_empty()
    }

    fn remove_expired(&mut self, now: u64) {
        while self.order.front().is_some_and(|&(at, _)| now.saturating_sub(at) > RETURN_WINDOW_NS) {
            self.remove_oldest();
        }
    }

    fn remove_oldest(&mut self) {
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
        let mut returned = ReturnedFrameDetector::default();
        let it = frame(0x201, &[1, 2]);
        assert!(!returned.is_returned(0, &it));
        returned.record_sent(MS, &it);
        let others = [frame(0x202, &[1, 2]), frame(0x201, &[1]), Frame::fd(0x201, 0, &[1, 2]).unwrap()];
        assert!(others.iter().all(|other| !returned.is_returned(2 * MS, other)));
        assert!(
            returned.is_returned(3 * MS, &it) && returned.is_returned(101 * MS, &it),
            "as often as it goes around"
        );
        assert!(!returned.is_returned(102 * MS, &it), "a torque may be the same again");
        assert_eq!((returned.returned_frame_count(), returned.put.times.len()), (2, 0));
    }

    #[test]
    fn no_more_is_remembered_than_may() {
        let mut returned = ReturnedFrameDetector::default();
        for number in 0..2 * MAX_REMEMBERED_FRAMES as u64 {
            returned.record_sent(0, &frame(0x201, &(number / 3).to_le_bytes()));
        }
        assert_eq!(returned.put.order.len(), MAX_REMEMBERED_FRAMES);
        let sum: u32 = returned.put.times.values().sum();
        assert_eq!(sum as usize, MAX_REMEMBERED_FRAMES);
    }

    /// A bridge copies frames from the second bus to the first. Frames of the first bus go around the circle unnoticed,
    /// because no link receives a frame that it has put on its bus itself, until a frame of the second bus goes around.
    #[test]
    fn in_a_circle_that_was_noticed_a_frame_passes_once_in_100_ms() {
        let (it, other) = (frame(0x201, &[1]), frame(0x202, &[2]));
        let mut first = ReturnedFrameDetector::default();
        for at in 0..50 {
            assert!(!first.is_returned(at * MS, &it), "it could be sent again and again");
        }
        first.record_sent(50 * MS, &other);
        assert!(first.is_returned(51 * MS, &other));
        assert!(!first.is_returned(52 * MS, &it));
        assert!(first.is_returned(53 * MS, &it) && first.is_returned(152 * MS, &it));
        assert!(!first.is_returned(153 * MS, &it), "whoever sends it means it");

        let mut second = ReturnedFrameDetector::default();
        second.record_sent(0, &it);
        assert!(!second.is_circled_copy(MS, &it), "no circle");
        assert!(second.is_returned(2 * MS, &it));
        assert!(second.is_circled_copy(3 * MS, &it) && !second.is_circled_copy(3 * MS, &other));
        assert!(!second.is_circled_copy(101 * MS, &it));
        second.record_sent(2_000 * MS, &it);
        assert!(!second.is_circled_copy(2_001 * MS, &it), "the circle is gone");
    }
}
