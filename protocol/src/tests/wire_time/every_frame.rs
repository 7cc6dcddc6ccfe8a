//! The longest and shortest classic frames, determined from all possible frames.
//!
//! The number of stuff bits still to come depends on the preceding bits only through the state of the run (8 states)
//! and, because of the CRC, the CRC register (2^15 values). All identifiers and data that lead to the same pair of
//! these continue alike, so they are processed together: backwards from the CRC over the data, and forwards over the
//! identifier.

use crate::can::{BIT_RATE_SWITCH, ERROR_STATE, Frame};
use crate::wire_time::{FrameBits, FrameCoding, FrameShape};

/// Number of pairs of a run state and a value of the CRC register.
const PAIRS: usize = 8 << 15;
/// The counts for a pair that no frame reaches.
const NEVER: [u8; 2] = [u8::MAX, 0];

/// The minimum and maximum number of stuff bits for each pair.
type Counts = Vec<[u8; 2]>;

/// Appends a bit to a run of one to four equal bits. Returns the next run, and 1 if a stuff bit was inserted.
fn run_on(run: usize, bit: usize) -> (usize, u8) {
    let (last, length) = (run / 4, run % 4 + 1);
    match (last == bit, length) {
        (false, _) => (bit * 4, 0),
        (true, 4) => ((1 - bit) * 4, 1),
        (true, _) => (run + 1, 0),
    }
}

/// For each pair and each value of the next bit: the next pair, and 1 if a stuff bit was inserted.
struct Steps(Vec<[(u32, u8); 2]>);

impl Steps {
    fn all() -> Self {
        let step = |pair: usize, bit: usize| {
            let (register, (run, stuffed)) = (pair / 8, run_on(pair % 8, bit));
            let shifted = (register << 1) & 0x7FFF;
            let register = if register >> 14 == bit { shifted } else { shifted ^ 0x4599 };
            (u32::try_from(register * 8 + run).unwrap(), stuffed)
        };
        Self((0..PAIRS).map(|pair| [step(pair, 0), step(pair, 1)]).collect())
    }

    fn follow(&self, pair: usize, bit: usize) -> (usize, u8) {
        let (next, stuffed) = self.0[pair][bit];
        (next as usize, stuffed)
    }

    /// Returns the counts with one more bit of any value before them.
    fn with_a_free_bit(&self, after: &Counts) -> Counts {
        let mut counts = Vec::with_capacity(PAIRS);
        for &[(zero, if_zero), (one, if_one)] in &self.0 {
            let ([min_zero, max_zero], [min_one, max_one]) = (after[zero as usize], after[one as usize]);
            let min = (min_zero + if_zero).min(min_one + if_one);
            counts.push([min, (max_zero + if_zero).max(max_one + if_one)]);
        }
        counts
    }

    /// Advances the counts over some bits: fixed ones, or bits of any value (`None`).
    fn forward(&self, mut reached: Counts, bits: impl IntoIterator<Item = Option<usize>>) -> Counts {
        for bit in bits {
            let mut then = vec![NEVER; PAIRS];
            for (pair, &counts) in reached.iter().enumerate() {
                if counts == NEVER {
                    continue;
                }
                for bit in bit.map_or(0..=1, |bit| bit..=bit) {
                    let (next, stuffed) = self.follow(pair, bit);
                    then[next] = wider(then[next], plus(counts, stuffed));
                }
            }
            reached = then;
        }
        reached
    }

    /// Returns the counts from SOF to the DLC, of remote frames and of data frames.
    fn heads(&self, extended: bool) -> [Counts; 2] {
        let mut idle = vec![NEVER; PAIRS];
        // One recessive bit, which the first bit of the frame ends.
        idle[4] = [0, 0];
        let (one, zero) = (Some(1), Some(0));
        let reached = self.forward(idle, [zero].into_iter().chain([None; 11]));
        if extended {
            let reached = self.forward(reached, [one, one].into_iter().chain([None; 18]));
            [self.forward(reached.clone(), [one, zero, zero]), self.forward(reached, [zero; 3])]
        } else {
            [self.forward(reached.clone(), [one, zero, zero]), self.forward(reached, [zero; 3])]
        }
    }

    /// Returns the minimum and maximum number of stuff bits over all identifiers and all bits after the DLC.
    fn over_all(&self, heads: &Counts, dlc: usize, rest: &Counts) -> [u32; 2] {
        let mut over_all = NEVER;
        for (pair, &[min, max]) in heads.iter().enumerate().filter(|&(_, &counts)| counts != NEVER) {
            let (pair, stuffed) = (0..4).rev().fold((pair, 0), |(pair, sum), place| {
                let (pair, stuffed) = self.follow(pair, dlc >> place & 1);
                (pair, sum + stuffed)
            });
            let [rest_min, rest_max] = rest[pair];
            over_all = wider(over_all, [min + stuffed + rest_min, max + stuffed + rest_max]);
        }
        over_all.map(u32::from)
    }
}

fn wider([min, max]: [u8; 2], [other_min, other_max]: [u8; 2]) -> [u8; 2] {
    [min.min(other_min), max.max(other_max)]
}

fn plus([min, max]: [u8; 2], stuffed: u8) -> [u8; 2] {
    [min + stuffed, max + stuffed]
}

/// Returns the counts of stuff bits within the 15 bits of the CRC.
fn of_the_crc() -> Counts {
    let count = |pair: usize| {
        let step = |(run, sum), place: usize| {
            let (run, stuffed) = run_on(run, (pair / 8) >> place & 1);
            (run, sum + stuffed)
        };
        (0..15).rev().fold((pair % 8, 0), step).1
    };
    (0..PAIRS).map(|pair| [count(pair); 2]).collect()
}

/// Returns the number of bits of a classic frame without stuff bits.
fn plain(extended: bool, bytes: usize) -> u32 {
    let head_and_tail = if extended { 67 } else { 47 };
    head_and_tail + 8 * u32::try_from(bytes).unwrap()
}

#[test]
fn no_classic_frame_is_longer_or_shorter_and_one_is_as_long_and_one_as_short() {
    let steps = Steps::all();
    let heads = [steps.heads(false), steps.heads(true)];
    let compare = |coding, extended, len: usize, bytes, [min, max]: [u32; 2]| {
        let shape = FrameShape { coding, extended, len: u8::try_from(len).unwrap() };
        let plain = plain(extended, bytes);
        assert_eq!(
            (shape.min_bits().nominal, shape.max_bits().nominal),
            (plain + min, plain + max),
            "{shape:?}"
        );
        assert_eq!((shape.min_bits().data, shape.max_bits().data), (0, 0));
    };
    let mut rest = of_the_crc();
    for ([remote, _], extended) in heads.iter().zip([false, true]) {
        for requested in 0..=8 {
            compare(FrameCoding::Remote, extended, requested, 0, steps.over_all(remote, requested, &rest));
        }
    }
    for len in 0..=8 {
        for ([_, data], extended) in heads.iter().zip([false, true]) {
            compare(FrameCoding::Classic, extended, len, len, steps.over_all(data, len, &rest));
        }
        for _ in 0..if len < 8 { 8 } else { 0 } {
            rest = steps.with_a_free_bit(&rest);
        }
    }
}

/// Returns the minimum and the maximum of nominal and data bits over some frames.
fn ends(frames: impl Iterator<Item = Frame>) -> (FrameBits, FrameBits) {
    let start = (FrameBits { nominal: u32::MAX, data: u32::MAX }, FrameBits::default());
    frames.map(|frame| FrameBits::from_frame(&frame).unwrap()).fold(start, |(best, worst), bits| {
        (
            FrameBits { nominal: best.nominal.min(bits.nominal), data: best.data.min(bits.data) },
            FrameBits { nominal: worst.nominal.max(bits.nominal), data: worst.data.max(bits.data) },
        )
    })
}

#[test]
fn short_frames_one_by_one_are_within_the_bounds_and_reach_them() {
    let flags = [0, BIT_RATE_SWITCH].map(|switch| [switch, switch | ERROR_STATE]);
    // Every identifier with every byte.
    let short = || (0..0x800_u32).flat_map(|id| (0..=u8::MAX).map(move |byte| (id, byte)));
    let classic = short().map(|(id, byte)| Frame::classic(id, &[byte]).unwrap());
    let shape = FrameShape { coding: FrameCoding::Classic, extended: false, len: 1 };
    assert_eq!(ends(classic), (shape.min_bits(), shape.max_bits()));
    for (coding, flags) in [FrameCoding::Fd, FrameCoding::FdSwitched].into_iter().zip(flags) {
        // The bits after BRS do not depend on the identifier, so vary the identifier first, then the content.
        let ids = (0..0x800).flat_map(|id| flags.map(|flags| Frame::fd(id, flags, &[0x55]).unwrap()));
        let ids = ends(ids);
        let id = (0..0x800).find(|&id| {
            let bits = FrameBits::from_frame(&Frame::fd(id, flags[0], &[0x55]).unwrap()).unwrap();
            bits.nominal == ids.1.nominal
        });
        for len in 0..=2_u8 {
            let contents = 0..=(if len == 0 { 0 } else { u16::MAX });
            let frames = contents.flat_map(|word| {
                let bytes = word.to_be_bytes();
                flags.map(|flags| Frame::fd(id.unwrap(), flags, &bytes[..usize::from(len)]).unwrap())
            });
            let shape = FrameShape { coding, extended: false, len };
            assert_eq!(ends(frames).1, shape.max_bits(), "{shape:?}");
        }
    }
}
