//! Random bit errors.

use protocol::wire_time::FrameBits;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use thiserror::Error;

/// Number of nominal bits of an error frame and the following intermission: two consecutive flags of 6 bits, a
/// delimiter of 8 and an intermission of 3.
pub const ERROR_FRAME_BITS: u32 = 12 + 8 + 3;
/// Number of bits of the intermission. Errors in these bits do not damage a frame.
const INTERMISSION_BITS: u32 = 3;
/// Number of bits at the end of an FD frame that are sent at the nominal bit rate, including the intermission.
const FD_TAIL_BITS: u32 = 12;

/// The error for a bit-error rate that is not a number, negative, or above [`BitErrors::MAX_RATE`].
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error("the bit error rate {got} is out of range: use 0 to {}", BitErrors::MAX_RATE)]
pub struct BitErrorsError {
    /// The rejected rate.
    pub got: f64,
}

/// Independent bit errors with a constant probability, drawn from a seed.
#[derive(Clone, Debug)]
pub struct BitErrors {
    dice: Pcg64Mcg,
    /// Logarithm of the probability that a bit is undamaged.
    log_undamaged: f64,
    /// Number of undamaged bits before the next damaged one.
    undamaged_bits: u64,
}

impl BitErrors {
    /// Maximum bit-error rate. At this rate, one of seven attempts to send a frame of 200 bits succeeds.
    pub const MAX_RATE: f64 = 0.01;

    /// Creates bit errors with a rate (probability per bit) in the range 0 to [`BitErrors::MAX_RATE`].
    ///
    /// # Errors
    /// Returns an error if the rate is outside that range.
    pub fn new(rate: f64, seed: u64) -> Result<Self, BitErrorsError> {
        if !(0.0..=Self::MAX_RATE).contains(&rate) {
            return Err(BitErrorsError { got: rate });
        }
        let mut errors =
            Self { dice: Pcg64Mcg::seed_from_u64(seed), log_undamaged: (-rate).ln_1p(), undamaged_bits: 0 };
        errors.draw_next_error();
        Ok(errors)
    }

    /// Draws the number of undamaged bits before the next damaged one, from a geometric distribution.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "above 0; larger values saturate"
    )]
    fn draw_next_error(&mut self) {
        let uniform: f64 = self.dice.random();
        // `1 - uniform` is in (0, 1]. Without errors the distance is unlimited.
        self.undamaged_bits = if self.log_undamaged < 0.0 {
            ((1.0 - uniform).ln() / self.log_undamaged) as u64
        } else {
            u64::MAX
        };
    }

    /// Counts the bits of one attempt to send a frame. Returns the bits sent up to the first damaged one, plus the
    /// error frame; `None` if no bit is damaged.
    pub(super) fn damage_frame(&mut self, bits: FrameBits) -> Option<FrameBits> {
        let exposed = bits.total_bits().saturating_sub(INTERMISSION_BITS);
        if self.undamaged_bits >= u64::from(exposed) {
            self.undamaged_bits = self.undamaged_bits.saturating_sub(u64::from(exposed));
            return None;
        }
        let sent = u32::try_from(self.undamaged_bits).unwrap_or(exposed) + 1;
        self.draw_next_error();
        let head = if bits.data > 0 { bits.nominal.saturating_sub(FD_TAIL_BITS) } else { bits.nominal };
        let data = sent.saturating_sub(head).min(bits.data);
        Some(FrameBits { nominal: sent - data + ERROR_FRAME_BITS, data })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME: FrameBits = FrameBits { nominal: 30, data: 170 };

    #[test]
    fn frames_are_damaged_as_often_as_the_rate_says() {
        const FRAMES: u32 = 200_000;
        let rate = 1e-3;
        let mut errors = BitErrors::new(rate, 7).unwrap();
        let damaged = (0..FRAMES).filter(|_| errors.damage_frame(FRAME).is_some()).count();
        // A frame is damaged if one of its first 197 bits is. Six standard deviations: one failure in 500
        // million seeds.
        let (frames, one) = (f64::from(FRAMES), 1.0 - (1.0 - rate).powi(197));
        let deviation = (frames * one * (1.0 - one)).sqrt();
        assert!((damaged as f64 - frames * one).abs() < 6.0 * deviation, "{damaged}");
    }

    #[test]
    fn what_was_sent_of_a_damaged_frame_takes_its_bits_at_their_rates() {
        let mut errors = BitErrors::new(0.01, 1).unwrap();
        let mut seen = [false; 3];
        for _ in 0..10_000 {
            let Some(FrameBits { nominal, data }) = errors.damage_frame(FRAME) else { continue };
            let sent = nominal - ERROR_FRAME_BITS;
            // Head: 18 nominal bits. Tail: 9 bits before the intermission.
            match (sent, data) {
                (1..=18, 0) => seen[0] = true,
                (18, 1..170) => seen[1] = true,
                (18..=27, 170) => seen[2] = true,
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(seen, [true; 3]);
    }

    #[test]
    fn without_a_rate_nothing_is_damaged_and_no_other_rate_is_taken() {
        let mut errors = BitErrors::new(0.0, 3).unwrap();
        assert!((0..1_000).all(|_| errors.damage_frame(FRAME).is_none()));
        for got in [-1e-9, 0.011, f64::NAN, f64::INFINITY] {
            assert!(BitErrors::new(got, 0).is_err(), "{got}");
        }
        let error = BitErrors::new(0.5, 0).unwrap_err();
        assert_eq!(error.to_string(), "the bit error rate 0.5 is out of range: use 0 to 0.01");
    }
}
