//! Bit stuffing: after five equal bits a sender inserts one of the opposite value, which starts the next run.
//!
//! A run of equal bits has one of eight states: the value of the bit, and its number of repetitions, one to four. The
//! fifth repetition causes a stuff bit, after which the opposite value has occurred once. A table holds the effect of
//! up to eight bits on a state.

/// Number of states. A state consists of three bits: the value of the repeated bit, and the number of repetitions minus
/// one.
pub(super) const STATE_COUNT: usize = 8;
/// Number of sequences of up to eight bits. A sequence is encoded with a leading one.
const SEQUENCE_COUNT: usize = 512;
/// For each state and sequence, the next state in the lowest three bits and the number of stuff bits above them.
static STATE_TRANSITIONS: [u8; STATE_COUNT * SEQUENCE_COUNT] = compute_transitions();

/// The current run of equal bits, and the number of stuff bits so far.
#[derive(Clone, Copy, Debug)]
pub(super) struct BitRun {
    state: u8,
    /// Number of stuff bits so far.
    pub(super) stuffed: u32,
}

impl BitRun {
    /// The state of the idle bus: recessive bits, before the dominant first bit of a frame.
    pub(super) const IDLE_BUS: Self = Self { state: 0b100, stuffed: 0 };

    /// Appends eight bits, most significant first.
    #[inline]
    pub(super) fn push_byte(self, byte: u8) -> Self {
        self.push_sequence(0x100 | usize::from(byte))
    }

    /// Appends the lowest `count` bits of a word, most significant first.
    #[inline]
    pub(super) fn push_bits(mut self, word: u64, count: u32) -> Self {
        let mut left = count;
        while left > 0 {
            let some = if left.is_multiple_of(8) { 8 } else { left % 8 };
            left -= some;
            let bits = (word >> left) & ((1 << some) - 1);
            self = self.push_sequence((1 << some) | usize::try_from(bits).unwrap_or(0));
        }
        self
    }

    /// Returns true if `last`, the last bit of a sequence, caused a stuff bit.
    #[inline]
    pub(super) const fn ended_with_stuff_bit(self, last: u8) -> bool {
        self.state >> 2 != last & 1
    }

    #[inline]
    fn push_sequence(self, word: usize) -> Self {
        let at = (usize::from(self.state) * SEQUENCE_COUNT + word) % STATE_TRANSITIONS.len();
        let step = STATE_TRANSITIONS.get(at).copied().unwrap_or(0);
        Self { state: step & 7, stuffed: self.stuffed + u32::from(step >> 3) }
    }
}

/// Appends one bit. Returns the next state, and 1 if a stuff bit was inserted.
pub(super) const fn next_state(state: u8, bit: u8) -> (u8, u8) {
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
const fn compute_transitions() -> [u8; STATE_COUNT * SEQUENCE_COUNT] {
    let mut steps = [0; STATE_COUNT * SEQUENCE_COUNT];
    let mut state = 0;
    while state < STATE_COUNT {
        let mut word = 1;
        while word < SEQUENCE_COUNT {
            let (mut now, mut stuffed) = (state as u8, 0);
            let mut left = word.ilog2();
            while left > 0 {
                left -= 1;
                let (then, more) = next_state(now, ((word >> left) & 1) as u8);
                now = then;
                stuffed += more;
            }
            steps[state * SEQUENCE_COUNT + word] = (stuffed << 3) | now;
            word += 1;
        }
        state += 1;
    }
    steps
}
