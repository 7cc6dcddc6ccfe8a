//! The minimum and maximum number of bits of a frame, given its kind and its length.
//!
//! For FD frames the algorithm walks over the bits of a frame and follows both values of each free bit. For each of the
//! eight states of stuffing, it keeps only the minimum and maximum number of stuff bits. The bits after the data follow
//! a separate rule. In classic CAN the CRC is also stuffed and depends on the data, so a table is used; the test
//! `every_frame` computes the table from all possible frames. The maxima in the table are one to four bits below the
//! usual formula, which treats the CRC as free.

use super::{CLASSIC_TAIL_BITS, FrameBits, fd_bits_from_counts, stuffing};
use crate::can::{BIT_RATE_SWITCH, Format, Frame, fd_dlc, rounded_fd_len};

/// The kind of a frame, as far as the number of bits depends on it.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum FrameCoding {
    /// A classic data frame.
    Classic,
    /// A classic remote frame.
    Remote,
    /// A CAN FD frame with one bit rate.
    Fd,
    /// A CAN FD frame that switches to the data bit rate.
    FdSwitched,
}

/// The kind and length of a frame, without the values of identifier and data.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct FrameShape {
    /// The kind of frame.
    pub coding: FrameCoding,
    /// True for a 29-bit identifier.
    pub extended: bool,
    /// Number of data bytes, at most 8 (FD: 64). Greater values are clamped, and FD lengths are rounded up to the next
    /// length that CAN FD allows.
    pub len: u8,
}

impl FrameShape {
    /// Returns the shape of a frame.
    #[must_use]
    pub const fn from_frame(frame: &Frame) -> Self {
        let coding = match frame.format() {
            Format::Classic if frame.is_remote() => FrameCoding::Remote,
            Format::Classic => FrameCoding::Classic,
            Format::Fd if frame.flags() & BIT_RATE_SWITCH != 0 => FrameCoding::FdSwitched,
            Format::Fd => FrameCoding::Fd,
        };
        Self { coding, extended: frame.is_extended(), len: frame.len() }
    }

    /// Returns the minimum number of bits of a frame of this shape.
    #[must_use]
    pub fn min_bits(self) -> FrameBits {
        self.count_bits(|range| range.0)
    }

    /// Returns the maximum number of bits of a frame of this shape.
    #[must_use]
    pub fn max_bits(self) -> FrameBits {
        self.count_bits(|range| range.1)
    }

    fn count_bits(self, pick: fn(BitRange) -> u32) -> FrameBits {
        match self.coding {
            FrameCoding::Classic => self.classic_frame_bits(false, pick),
            FrameCoding::Remote => self.classic_frame_bits(true, pick),
            FrameCoding::Fd => self.fd_frame_bits(false, pick),
            FrameCoding::FdSwitched => self.fd_frame_bits(true, pick),
        }
    }

    fn classic_frame_bits(self, remote: bool, pick: fn(BitRange) -> u32) -> FrameBits {
        let table = match (remote, self.extended) {
            (false, false) => &CLASSIC_STUFF_BITS,
            (false, true) => &CLASSIC_EXTENDED_STUFF_BITS,
            (true, false) => &REMOTE,
            (true, true) => &REMOTE_EXTENDED_STUFF_BITS,
        };
        let len = self.len.min(8);
        let stuffed = table.get(usize::from(len)).copied().unwrap_or_default();
        let head = if self.extended { 39 } else { 19 };
        let data = if remote { 0 } else { 8 * u32::from(len) };
        FrameBits { nominal: head + data + 15 + pick(stuffed) + CLASSIC_TAIL_BITS, data: 0 }
    }

    fn fd_frame_bits(self, switched: bool, pick: fn(BitRange) -> u32) -> FrameBits {
        let len = rounded_fd_len(usize::from(self.len));
        // RRS 0, IDE 0, or RRS 0 alone; then FDF 1, res 0, BRS.
        let fdf_res_brs = 0b100 | u64::from(switched);
        let sof_id = StuffBits::IDLE_BUS.push_known_bits(0, 1).push_unknown_bits(11);
        let (ways, head) = if self.extended {
            (sof_id.push_known_bits(0b11, 2).push_unknown_bits(18).push_known_bits(fdf_res_brs, 4), 36)
        } else {
            (sof_id.push_known_bits(fdf_res_brs, 5), 17)
        };
        // After BRS only one state is possible for every identifier, so the rest is independent of it.
        let head = head + pick(ways.total_range());
        let dlc = u64::from(fd_dlc(len));
        let ways = ways.with_reset_counts().push_unknown_bits(1);
        // A stuff bit after the last bit is the first fixed stuff bit, and is not counted here.
        let ways = match u32::try_from(len) {
            Ok(0) | Err(_) => ways.push_known_bits(dlc >> 1, 3),
            Ok(len) => ways.push_known_bits(dlc, 4).push_unknown_bits(8 * len - 1),
        };
        fd_bits_from_counts(switched, head, len, pick(ways.total_range()))
    }
}

/// The minimum and maximum number of stuff bits.
type BitRange = (u32, u32);

/// Ranges for classic data frames with 11-bit identifiers, by number of data bytes.
const CLASSIC_STUFF_BITS: [BitRange; 9] =
    [(1, 6), (1, 7), (1, 9), (1, 12), (0, 14), (0, 15), (0, 18), (0, 21), (0, 22)];
/// Ranges for classic data frames with 29-bit identifiers, by number of data bytes.
const CLASSIC_EXTENDED_STUFF_BITS: [BitRange; 9] =
    [(1, 11), (1, 13), (1, 15), (1, 17), (0, 19), (0, 21), (0, 23), (0, 25), (0, 27)];
/// Ranges for remote frames with 11-bit identifiers, by requested number of bytes.
const REMOTE: [BitRange; 9] = [(1, 5), (1, 6), (0, 5), (0, 6), (0, 4), (0, 4), (0, 4), (0, 5), (0, 5)];
/// Ranges for remote frames with 29-bit identifiers, by requested number of bytes.
const REMOTE_EXTENDED_STUFF_BITS: [BitRange; 9] =
    [(1, 10), (1, 11), (0, 10), (0, 11), (0, 10), (0, 10), (0, 9), (0, 10), (0, 10)];

/// For each state of stuffing, the minimum and maximum number of stuff bits in any sequence of bits that ends in it.
#[derive(Clone, Copy)]
struct StuffBits([Option<BitRange>; stuffing::STATE_COUNT]);

impl StuffBits {
    /// The idle bus before SOF: only state 4 is possible, as in [`stuffing::BitRun::IDLE_BUS`].
    const IDLE_BUS: Self = Self([None, None, None, None, Some((0, 0)), None, None, None]);

    /// Appends the lowest `count` bits of a word with their values.
    fn push_known_bits(self, word: u64, count: u32) -> Self {
        (0..count).rev().fold(self, |ways, place| {
            let bit = (word >> place) & 1 == 1;
            ways.push_possible_bit(!bit, bit)
        })
    }

    /// Appends `count` bits that can have any value.
    fn push_unknown_bits(self, count: u32) -> Self {
        (0..count).fold(self, |ways, _| ways.push_possible_bit(true, true))
    }

    /// Keeps the reachable states but sets the numbers of stuff bits to 0.
    fn with_reset_counts(self) -> Self {
        Self(self.0.map(|range| range.map(|_| (0, 0))))
    }

    /// Returns the minimum and maximum number of stuff bits over all states.
    fn total_range(self) -> BitRange {
        self.0.into_iter().flatten().reduce(enclosing_range).unwrap_or((0, 0))
    }

    fn push_possible_bit(self, zero: bool, one: bool) -> Self {
        let mut then = [None; stuffing::STATE_COUNT];
        for (state, range) in (0..).zip(self.0) {
            for (bit, _) in [(0, zero), (1, one)].into_iter().filter(|&(_, may)| may) {
                let (next, more) = stuffing::next_state(state, bit);
                let range = range.map(|(min, most)| (min + u32::from(more), most + u32::from(more)));
                if let Some(slot) = then.get_mut(usize::from(next)) {
                    *slot =
                        slot.map_or(range, |old| Some(range.map_or(old, |new| enclosing_range(old, new))));
                }
            }
        }
        Self(then)
    }
}

fn enclosing_range(a: BitRange, b: BitRange) -> BitRange {
    (a.0.min(b.0), a.1.max(b.1))
}
