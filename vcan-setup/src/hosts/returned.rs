//! Frames of other hosts that come back: from a second link of the bus, an adapter or a bridge that makes a circle.
//!
//! A bus gives a sender's own frames to all others. So a frame that this link has put on the bus, and that it then
//! receives from there, was sent once more by somebody else.

use std::collections::{HashMap, VecDeque};
use std::hash::{BuildHasher, RandomState};

use protocol::can::Frame;

/// How long after a frame was put on the bus the same one counts as returned, in ns.
pub const WITHIN_NS: u64 = 100_000_000;
/// Frames that are remembered at most.
const REMEMBERED: usize = 16_384;

/// The frames that were put on the bus of late.
#[derive(Debug, Default)]
pub struct Returned {
    hasher: RandomState,
    /// In order, and when.
    order: VecDeque<(u64, u64)>,
    /// How often each of them is in it.
    times: HashMap<u64, u32>,
    count: u64,
}

impl Returned {
    /// A frame was put on the bus, at a time of a clock that only goes forward.
    pub fn put(&mut self, now: u64, frame: &Frame) {
        self.forget(now);
        if self.order.len() >= REMEMBERED {
            self.forget_one();
        }
        let hash = self.hash(frame);
        self.order.push_back((now, hash));
        *self.times.entry(hash).or_default() += 1;
    }

    /// Whether a frame that came from the bus is one that was put there.
    pub fn is_returned(&mut self, now: u64, frame: &Frame) -> bool {
        self.forget(now);
        // Most of the time nothing is remembered of a bus that only sends.
        let is_returned = !self.times.is_empty() && self.times.contains_key(&self.hash(frame));
        self.count += u64::from(is_returned);
        is_returned
    }

    /// How many were.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    fn hash(&self, frame: &Frame) -> u64 {
        self.hasher.hash_one((frame.to_bytes(), frame.format()))
    }

    fn forget(&mut self, now: u64) {
        while self.order.front().is_some_and(|&(at, _)| now.saturating_sub(at) > WITHIN_NS) {
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
        let mut returned = Returned::default();
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
        assert_eq!((returned.count(), returned.times.len()), (2, 0));
    }

    #[test]
    fn no_more_is_remembered_than_may() {
        let mut returned = Returned::default();
        for number in 0..2 * REMEMBERED as u64 {
            returned.put(0, &frame(0x201, &(number / 3).to_le_bytes()));
        }
        assert_eq!(returned.order.len(), REMEMBERED);
        let sum: u32 = returned.times.values().sum();
        assert_eq!(sum as usize, REMEMBERED);
    }
}
