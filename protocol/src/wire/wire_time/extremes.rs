//! The fewest and the most bits that any frame of a kind and length can have.
//!
//! For FD they are worked out: bits that are the same in all such frames are walked through, free ones both ways, and of all ways
//! to one of the eight states of stuffing only the one with the fewest and the one with the most stuff bits matter. What follows the
//! data stuffs by a rule of its own. In classic CAN the CRC is stuffed too, and the data decides it, so there is a table, which the
//! test `every_frame` computes from all frames there are. It is one to four bits below the usual formula, which takes the CRC for free.

use super::{Bits, CLASSIC_TAIL, parts, stuffing};
use crate::can::{BIT_RATE_SWITCH, Format, Frame, fd_dlc, fd_len};

/// Which bits a frame consists of, beside its identifier and its data.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Coding {
    /// Classic CAN, with data.
    Classic,
    /// Classic CAN, a request.
    Remote,
    /// CAN FD at one bit rate.
    Fd,
    /// CAN FD that switches to the data bit rate.
    FdSwitched,
}

/// A kind of frame and its length: what is known of a frame before its identifier and its data are.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct Shape {
    /// What it consists of.
    pub coding: Coding,
    /// Whether its identifier has 29 bits.
    pub extended: bool,
    /// Bytes, up to 8 (FD: 64); more count as the most there can be, and an FD length that is none as the next one.
    pub len: u8,
}

impl Shape {
    /// The shape of a frame.
    #[must_use]
    pub const fn of(frame: &Frame) -> Self {
        let coding = match frame.format() {
            Format::Classic if frame.is_remote() => Coding::Remote,
            Format::Classic => Coding::Classic,
            Format::Fd if frame.flags() & BIT_RATE_SWITCH != 0 => Coding::FdSwitched,
            Format::Fd => Coding::Fd,
        };
        Self { coding, extended: frame.is_extended(), len: frame.len() }
    }

    /// The fewest bits that a frame of this shape can have.
    #[must_use]
    pub fn best(self) -> Bits {
        self.bits(|range| range.0)
    }

    /// The most bits that a frame of this shape can have.
    #[must_use]
    pub fn worst(self) -> Bits {
        self.bits(|range| range.1)
    }

    fn bits(self, pick: fn(Range) -> u32) -> Bits {
        match self.coding {
            Coding::Classic => self.classic(false, pick),
            Coding::Remote => self.classic(true, pick),
            Coding::Fd => self.fd(false, pick),
            Coding::FdSwitched => self.fd(true, pick),
        }
    }

    fn classic(self, remote: bool, pick: fn(Range) -> u32) -> Bits {
        let table = match (remote, self.extended) {
            (false, false) => &CLASSIC,
            (false, true) => &CLASSIC_EXTENDED,
            (true, false) => &REMOTE,
            (true, true) => &REMOTE_EXTENDED,
        };
        let len = self.len.min(8);
        let stuffed = table.get(usize::from(len)).copied().unwrap_or_default();
        let head = if self.extended { 39 } else { 19 };
        let data = if remote { 0 } else { 8 * u32::from(len) };
        Bits { nominal: head + data + 15 + pick(stuffed) + CLASSIC_TAIL, data: 0 }
    }

    fn fd(self, switched: bool, pick: fn(Range) -> u32) -> Bits {
        let len = fd_len(usize::from(self.len));
        // RRS 0, IDE 0, or RRS 0 alone; then FDF 1, res 0, BRS.
        let fdf_res_brs = 0b100 | u64::from(switched);
        let sof_id = Ways::IDLE.fixed(0, 1).free(11);
        let (ways, head) = if self.extended {
            (sof_id.fixed(0b11, 2).free(18).fixed(fdf_res_brs, 4), 36)
        } else {
            (sof_id.fixed(fdf_res_brs, 5), 17)
        };
        // Behind BRS there is one state only, whatever the identifier was: what follows can be taken by itself.
        let head = head + pick(ways.stuffed());
        let dlc = u64::from(fd_dlc(len));
        let ways = ways.restarted().free(1);
        // What the last bit makes is a fixed stuff bit.
        let ways = match u32::try_from(len) {
            Ok(0) | Err(_) => ways.fixed(dlc >> 1, 3),
            Ok(len) => ways.fixed(dlc, 4).free(8 * len - 1),
        };
        parts(switched, head, len, pick(ways.stuffed()))
    }
}

/// The fewest and the most stuff bits.
type Range = (u32, u32);

/// Of classic data frames, by length.
const CLASSIC: [Range; 9] = [(1, 6), (1, 7), (1, 9), (1, 12), (0, 14), (0, 15), (0, 18), (0, 21), (0, 22)];
/// The same with an identifier of 29 bits.
const CLASSIC_EXTENDED: [Range; 9] =
    [(1, 11), (1, 13), (1, 15), (1, 17), (0, 19), (0, 21), (0, 23), (0, 25), (0, 27)];
/// Of remote requests, by the requested length.
const REMOTE: [Range; 9] = [(1, 5), (1, 6), (0, 5), (0, 6), (0, 4), (0, 4), (0, 4), (0, 5), (0, 5)];
/// The same with an identifier of 29 bits.
const REMOTE_EXTENDED: [Range; 9] =
    [(1, 10), (1, 11), (0, 10), (0, 11), (0, 10), (0, 10), (0, 9), (0, 10), (0, 10)];

/// Of all ways to each state of stuffing: the fewest and the most stuff bits.
#[derive(Clone, Copy)]
struct Ways([Option<Range>; stuffing::STATES]);

impl Ways {
    /// The bus before SOF: state 4, as [`stuffing::Run::IDLE`].
    const IDLE: Self = Self([None, None, None, None, Some((0, 0)), None, None, None]);

    /// Goes on with the lowest `count` bits of a word.
    fn fixed(self, word: u64, count: u32) -> Self {
        (0..count).rev().fold(self, |ways, place| {
            let bit = (word >> place) & 1 == 1;
            ways.step(!bit, bit)
        })
    }

    /// Goes on with bits that may be anything.
    fn free(self, count: u32) -> Self {
        (0..count).fold(self, |ways, _| ways.step(true, true))
    }

    /// The same states, and no stuff bits yet.
    fn restarted(self) -> Self {
        Self(self.0.map(|range| range.map(|_| (0, 0))))
    }

    /// Over all states.
    fn stuffed(self) -> Range {
        self.0.into_iter().flatten().reduce(wider).unwrap_or((0, 0))
    }

    fn step(self, zero: bool, one: bool) -> Self {
        let mut then = [None; stuffing::STATES];
        for (state, range) in (0..).zip(self.0) {
            for (bit, _) in [(0, zero), (1, one)].into_iter().filter(|&(_, may)| may) {
                let (next, more) = stuffing::next(state, bit);
                let range = range.map(|(min, most)| (min + u32::from(more), most + u32::from(more)));
                if let Some(slot) = then.get_mut(usize::from(next)) {
                    *slot = slot.map_or(range, |old| Some(range.map_or(old, |new| wider(old, new))));
                }
            }
        }
        Self(then)
    }
}

fn wider(a: Range, b: Range) -> Range {
    (a.0.min(b.0), a.1.max(b.1))
}
