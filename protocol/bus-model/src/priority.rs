//! Priorities of frames in arbitration.

use protocol::can::{Format, Frame};

/// The bits of a frame that arbitration compares, in their order on the wire. A 0 wins, so the lower value
/// has priority.
///
/// ```text
///   bit       31 .. 21        20        19       18 .. 1          0
///   11-bit    identifier      RTR       IDE 0    0                0
///   29-bit    its upper 11    SRR 1     IDE 1    its lower 18     RTR
/// ```
///
/// An 11-bit identifier wins over a longer one with the same first 11 bits, and a data frame wins over a remote
/// frame.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct Priority(u32);

impl Priority {
    /// Returns the priority of a frame.
    #[must_use]
    pub const fn from_frame(frame: &Frame) -> Self {
        let id = frame.id();
        let remote = matches!(frame.format(), Format::Classic) && frame.is_remote();
        if frame.is_extended() {
            Self((id >> 18) << 21 | 0b11 << 19 | (id & 0x3_FFFF) << 1 | remote as u32)
        } else {
            Self(id << 21 | (remote as u32) << 20)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use protocol::can::{BIT_RATE_SWITCH, EXTENDED};

    /// Returns the arbitration bits in their order on the wire: the first 11 bits of the identifier, RTR or SRR, and
    /// IDE; for a 29-bit identifier also its other 18 bits and RTR.
    fn bits(frame: &Frame) -> Vec<bool> {
        let (id, remote) = (frame.id(), frame.is_remote());
        let of = |word: u32, count: u32| (0..count).rev().map(move |place| word >> place & 1 == 1);
        if frame.is_extended() {
            of(id >> 18, 11).chain([true, true]).chain(of(id, 18)).chain([remote]).collect()
        } else {
            of(id, 11).chain([remote, false]).collect()
        }
    }

    /// Returns true if `one` wins the arbitration: at the first bit that differs, it sends the dominant 0.
    fn wins(one: &Frame, other: &Frame) -> bool {
        let unlike = bits(one).into_iter().zip(bits(other)).find(|(one, other)| one != other);
        unlike.is_some_and(|(one, _)| !one)
    }

    fn any_frame() -> impl Strategy<Value = Frame> {
        // A small range, so that many identifiers begin alike.
        let id = prop_oneof![
            0..4_u32,
            (0..4_u32, 0..4_u32).prop_map(|(upper, lower)| EXTENDED | upper << 18 | lower)
        ];
        (id, 0..3).prop_map(|(id, kind)| match kind {
            0 => Frame::classic(id, &[]).unwrap(),
            1 => Frame::remote(id, 0).unwrap(),
            _ => Frame::fd(id, BIT_RATE_SWITCH, &[]).unwrap(),
        })
    }

    proptest! {
        #[test]
        fn priority_is_what_the_wire_makes_of_the_bits(one in any_frame(), other in any_frame()) {
            prop_assert_eq!(Priority::from_frame(&one) < Priority::from_frame(&other), wins(&one, &other));
        }
    }

    #[test]
    fn eleven_bits_win_over_twenty_nine_that_begin_alike() {
        let short = Frame::classic(0x123, &[]).unwrap();
        let requested = Frame::remote(0x123, 0).unwrap();
        let long = Frame::classic(EXTENDED | 0x123 << 18, &[]).unwrap();
        let below = Frame::classic(EXTENDED | 0x122 << 18 | 0x3_FFFF, &[]).unwrap();
        let order = [below, short, requested, long].map(|frame| Priority::from_frame(&frame));
        assert!(order.is_sorted() && order[0] < order[1] && order[2] < order[3]);
    }
}
