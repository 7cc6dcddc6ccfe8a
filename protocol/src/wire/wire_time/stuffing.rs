//! Stuff bits: after five equal bits a sender puts in one of the other kind, which is the first of the next run.
//!
//! A run is one of eight states: which bit, and how often it has come, one to four times; the fifth makes a stuff bit,
//! and so the state in which the other bit came once. What up to eight bits do to a state stands in a table.

/// The states, three bits wide: the bit, then how often it came less one.
pub(super) const STATES: usize = 8;
/// Up to eight bits behind a leading one, which says how many they are.
const WORDS: usize = 512;
/// By state and bits: how many stuff bits came, above the three bits of the state that follows.
static STEPS: [u8; STATES * WORDS] = steps();

/// A run of equal bits, and the stuff bits on the way to it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Run {
    state: u8,
    /// Stuff bits so far.
    pub(super) stuffed: u32,
}

impl Run {
    /// The idle bus before the first bit of a frame, which is the other one.
    pub(super) const IDLE: Self = Self { state: 0b100, stuffed: 0 };

    /// Goes on with eight bits, the most significant first.
    #[inline]
    pub(super) fn byte(self, byte: u8) -> Self {
        self.step(0x100 | usize::from(byte))
    }

    /// Goes on with the lowest `count` bits of a word, the most significant of them first.
    #[inline]
    pub(super) fn bits(mut self, word: u64, count: u32) -> Self {
        let mut left = count;
        while left > 0 {
            let some = if left.is_multiple_of(8) { 8 } else { left % 8 };
            left -= some;
            let bits = (word >> left) & ((1 << some) - 1);
            self = self.step((1 << some) | usize::try_from(bits).unwrap_or(0));
        }
        self
    }

    /// Whether the last bit of a sequence made a stuff bit: then the run is of the other one.
    #[inline]
    pub(super) const fn ended_on(self, last: u8) -> bool {
        self.state >> 2 != last & 1
    }

    #[inline]
    fn step(self, word: usize) -> Self {
        let at = (usize::from(self.state) * WORDS + word) % STEPS.len();
        let step = STEPS.get(at).copied().unwrap_or(0);
        Self { state: step & 7, stuffed: self.stuffed + u32::from(step >> 3) }
    }
}

/// One bit more: the state that follows, and 1 when a stuff bit came.
pub(super) const fn next(state: u8, bit: u8) -> (u8, u8) {
    let (same, run) = (state >> 2 == bit, state & 3);
    match (same, run) {
        (true, 3) => ((bit ^ 1) << 2, 1),
        (true, _) => (state + 1, 0),
        (false, _) => (bit << 2, 0),
    }
}

#[expect(
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    reason = "worked out by the compiler, which would stop; a state has three bits"
)]
const fn steps() -> [u8; STATES * WORDS] {
    let mut steps = [0; STATES * WORDS];
    let mut state = 0;
    while state < STATES {
        let mut word = 1;
        while word < WORDS {
            let (mut now, mut stuffed) = (state as u8, 0);
            let mut left = word.ilog2();
            while left > 0 {
                left -= 1;
                let (then, more) = next(now, ((word >> left) & 1) as u8);
                now = then;
                stuffed += more;
            }
            steps[state * WORDS + word] = (stuffed << 3) | now;
            word += 1;
        }
        state += 1;
    }
    steps
}
