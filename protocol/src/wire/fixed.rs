//! Fixed-point numbers of 16 bits, and exact sums of their products.
//!
//! `Qm_n` has one sign bit, `m` integer bits and `n` fraction bits, as in the robot-skin literature: Q1.14
//! spans [-2, 2). The crate `fixed` includes the sign bit in its count and calls the same format `I2F14`.
//!
//! A format defines the resolution of a number and not the quantity: [`crate::message`] defines which word is a force
//! and which a torque. Operators are not overloaded, so that every operation that can lose bits is visible as a call of
//! [`Accumulator::round`] or of a saturating function.

use thiserror::Error;

/// A fixed-point number of 16 bits, `F` of them fractional, in steps of 2^-F.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
#[repr(transparent)]
pub struct Q<const F: u32>(i16);

/// Angles in quarter turns, unit vectors, metres: [-2, 2) in steps of 6.1e-5.
pub type Q1_14 = Q<14>;
/// Torques of one cell in Nm: [-8, 8) in steps of 2.4e-4.
pub type Q3_12 = Q<12>;
/// Forces in N: [-32, 32) in steps of 9.8e-4.
pub type Q5_10 = Q<10>;
/// Sums of torques in Nm: [-128, 128) in steps of 3.9e-3.
pub type Q7_8 = Q<8>;
/// Temperatures in degrees Celsius: [-512, 512) in steps of 1.6e-2.
pub type Q9_6 = Q<6>;

/// Returns true if a word means *saturated* in a torque or a sum. The marks are the same in all formats.
#[must_use]
pub const fn is_saturated(word: i16) -> bool {
    word == i16::MAX || word == i16::MIN
}

/// The format of the torques that the cells of a bus send on their own. A wider range has a coarser step. Sums are
/// always Q7.8.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub enum TorqueFormat {
    /// [-8, 8) Nm or N in steps of 2.4e-4.
    #[default]
    Q3_12,
    /// [-32, 32) Nm or N in steps of 9.8e-4.
    Q5_10,
    /// [-128, 128) Nm or N in steps of 3.9e-3.
    Q7_8,
}

impl TorqueFormat {
    /// All formats, the finest first. The index of a format is its number in parameter 1.
    pub const ALL: [Self; 3] = [Self::Q3_12, Self::Q5_10, Self::Q7_8];

    /// Returns the name of the format.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Q3_12 => "Q3.12",
            Self::Q5_10 => "Q5.10",
            Self::Q7_8 => "Q7.8",
        }
    }

    /// Returns the number of the format in parameter 1.
    #[must_use]
    pub const fn number(self) -> u8 {
        self as u8
    }

    /// Returns the format with this number in parameter 1; `None` for other numbers.
    #[must_use]
    pub fn from_number(number: i16) -> Option<Self> {
        usize::try_from(number).ok().and_then(|number| Self::ALL.get(number)).copied()
    }

    /// Returns the number of fraction bits of a word.
    #[must_use]
    pub const fn fraction_bits(self) -> u32 {
        match self {
            Self::Q3_12 => 12,
            Self::Q5_10 => 10,
            Self::Q7_8 => 8,
        }
    }

    /// Returns the value of one step, in Nm or N.
    #[must_use]
    pub fn step_size(self) -> f64 {
        1.0 / f64::from(1_u32 << self.fraction_bits())
    }

    /// Converts a word to Nm or N.
    #[must_use]
    pub fn to_real(self, word: i16) -> f64 {
        f64::from(word) * self.step_size()
    }

    /// Rounds a value in Nm or N to the nearest word, ties away from zero. Values out of range saturate; NaN becomes
    /// zero.
    #[must_use]
    pub fn nearest_word(self, value: f64) -> i16 {
        match self {
            Self::Q3_12 => Q::<12>::nearest(value).0,
            Self::Q5_10 => Q::<10>::nearest(value).0,
            Self::Q7_8 => Q::<8>::nearest(value).0,
        }
    }

    /// Converts a word to steps of 2^-12 Nm or N, the finest of all formats. The result is exact.
    #[must_use]
    pub fn to_finest_steps(self, word: i16) -> i32 {
        i32::from(word) << (Self::Q3_12.fraction_bits() - self.fraction_bits())
    }

    /// Returns the upper bound of the range in Nm or N, exclusive.
    #[must_use]
    pub fn upper_bound(self) -> f64 {
        -self.to_real(i16::MIN)
    }

    /// Rounds an exact torque to the nearest word, ties up. Torques out of range saturate.
    #[must_use]
    pub fn round<const F: u32>(self, exact: Accumulator<F>) -> i16 {
        match self {
            Self::Q3_12 => exact.round::<12>().to_bits(),
            Self::Q5_10 => exact.round::<10>().to_bits(),
            Self::Q7_8 => exact.round::<8>().to_bits(),
        }
    }
}

/// The error for a real number outside the range of a `Q` format.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error("{got} is outside the range [{min}, {bound})")]
pub struct OutOfRange {
    /// The number that does not fit.
    pub got: f64,
    /// The smallest number of the format.
    pub min: f64,
    /// The upper bound of the format, exclusive.
    pub bound: f64,
}

impl<const F: u32> Q<F> {
    /// Zero.
    pub const ZERO: Self = Self(0);
    /// The largest number. As a torque or a sum it means *saturated*.
    pub const MAX: Self = Self(i16::MAX);
    /// The smallest number. As a torque or a sum it means *saturated*.
    pub const MIN: Self = Self(i16::MIN);
    /// Number of steps per unit.
    const SCALE: f64 = (1_u32 << F) as f64;

    /// Creates a number from its word on the wire.
    #[must_use]
    pub const fn from_bits(bits: i16) -> Self {
        Self(bits)
    }

    /// Returns the word on the wire.
    #[must_use]
    pub const fn to_bits(self) -> i16 {
        self.0
    }

    /// Converts the number to `f64`, exactly.
    #[must_use]
    pub fn to_f64(self) -> f64 {
        f64::from(self.0) / Self::SCALE
    }

    /// Rounds to the nearest number of this format, ties away from zero. Values out of range saturate; NaN
    /// becomes zero.
    #[must_use]
    pub fn nearest(value: f64) -> Self {
        Self(saturate(round_half_away(value * Self::SCALE)))
    }

    /// Rounds to the nearest number of this format, ties away from zero.
    ///
    /// # Errors
    /// Returns an error if the result is outside the range, or `value` is NaN.
    pub fn try_nearest(value: f64) -> Result<Self, OutOfRange> {
        if value.is_nan() {
            return Err(Self::out_of_range(value));
        }
        i16::try_from(round_half_away(value * Self::SCALE)).map(Self).map_err(|_| Self::out_of_range(value))
    }

    /// Returns the smallest number of this format that is not below `value`. Thresholds are rounded this way, so that
    /// no sensor value below the requested threshold passes the rounded one.
    ///
    /// # Errors
    /// Returns an error if that number is outside the range, or `value` is NaN.
    pub fn try_round_up(value: f64) -> Result<Self, OutOfRange> {
        let nearest = Self::try_nearest(value)?;
        if nearest.to_f64() >= value {
            return Ok(nearest);
        }
        nearest.0.checked_add(1).map(Self).ok_or_else(|| Self::out_of_range(value))
    }

    fn out_of_range(got: f64) -> OutOfRange {
        OutOfRange { got, min: Self::MIN.to_f64(), bound: -Self::MIN.to_f64() }
    }

    /// Returns true if the word means *saturated* in a torque or a sum.
    #[must_use]
    pub const fn is_saturated(self) -> bool {
        is_saturated(self.0)
    }

    /// Negates the number; the smallest number becomes the largest.
    #[must_use]
    pub const fn saturating_neg(self) -> Self {
        Self(self.0.saturating_neg())
    }

    /// Adds two numbers; the result saturates.
    #[must_use]
    pub const fn saturating_add(self, rhs: Self) -> Self {
        Self(self.0.saturating_add(rhs.0))
    }

    /// Adds two numbers and wraps at the ends of the range. For angles, the range is one turn.
    #[must_use]
    pub const fn wrapping_add(self, rhs: Self) -> Self {
        Self(self.0.wrapping_add(rhs.0))
    }

    /// Converts the number to an exact sum with one term.
    #[must_use]
    pub fn to_accumulator(self) -> Accumulator<F> {
        Accumulator(i64::from(self.0))
    }

    /// Multiplies two numbers exactly. `P` must be `F + G`, which is checked at compile time.
    ///
    /// ```compile_fail
    /// # use protocol::fixed::{Acc, Q1_14, Q7_8};
    /// let _: Acc<21> = Q1_14::ZERO.mul_wide(Q7_8::ZERO); // 14 + 8 is not 21
    /// ```
    #[must_use]
    pub fn mul_wide<const G: u32, const P: u32>(self, rhs: Q<G>) -> Accumulator<P> {
        const { assert!(P == F + G, "a product has the sum of the fractional bits") }
        Accumulator(i64::from(self.0) * i64::from(rhs.0))
    }
}

impl Q1_14 {
    /// Converts an angle in radians to quarter turns, `z = angle / (pi/2)` wrapped into [-2, 2), rounded to
    /// the nearest step (ties away from zero). Returns `None` if the angle is not finite.
    ///
    /// The range of Q1.14 is one whole turn, so the addition of angles wraps correctly in 16-bit words (paper, Eq. 11;
    /// the period of its Eq. 12 is 4, not 2).
    #[must_use]
    pub fn from_radians(angle: f64) -> Option<Self> {
        if !angle.is_finite() {
            return None;
        }
        let turns = angle / core::f64::consts::TAU % 1.0; // (-1, 1), so the words below fit an i32
        let steps = round_half_away(turns * 65_536.0);
        let [low, high, ..] = steps.to_le_bytes();
        Some(Self(i16::from_le_bytes([low, high])))
    }

    /// Converts quarter turns to radians, in [-pi, pi).
    #[must_use]
    pub fn to_radians(self) -> f64 {
        self.to_f64() * core::f64::consts::FRAC_PI_2
    }
}

/// An exact sum of products of fixed-point numbers, with `F` fraction bits. It holds at least 2^33 products of two
/// words without overflow.
#[derive(Clone, Copy, Debug, Default, Eq, Ord, PartialEq, PartialOrd)]
pub struct Accumulator<const F: u32>(i64);

impl<const F: u32> Accumulator<F> {
    /// Zero.
    pub const ZERO: Self = Self(0);

    /// Creates a sum from an integer number of steps of 2^-F.
    #[must_use]
    pub const fn from_steps(steps: i64) -> Self {
        Self(steps)
    }

    /// Returns the number of steps of 2^-F.
    #[must_use]
    pub const fn steps(self) -> i64 {
        self.0
    }

    /// Adds two sums; saturates at the limits of 64 bits.
    #[must_use]
    pub const fn saturating_add(self, rhs: Self) -> Self {
        Self(self.0.saturating_add(rhs.0))
    }

    /// Converts to finer steps. `G` must be at least `F`, which is checked at compile time.
    #[must_use]
    pub const fn with_fraction_bits<const G: u32>(self) -> Accumulator<G> {
        const { assert!(G >= F, "finer means more fractional bits") }
        Accumulator(self.0.saturating_mul(1_i64 << (G - F)))
    }

    /// Rounds to `G` fraction bits, ties up, and saturates at 16 bits, so that bits may be lost.
    ///
    /// The error is at most half a step of 2^-G unless the result saturates.
    #[must_use]
    pub fn round<const G: u32>(self) -> Q<G> {
        const { assert!(G < F, "rounding drops at least one bit") }
        let half = 1_i64 << (F - G - 1);
        Q(saturate(self.0.saturating_add(half) >> (F - G)))
    }

    /// Converts to `f64`; exact up to 53 significant bits.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "documented: exact up to 53 bits")]
    pub fn to_f64(self) -> f64 {
        self.0 as f64 / (1_u64 << F) as f64
    }
}

/// Rounds to the nearest integer, ties away from zero; saturates at 64 bits, and NaN becomes 0.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    reason = "the casts truncate and saturate, which is what rounding by hand needs; core has no f64::round"
)]
fn round_half_away(value: f64) -> i64 {
    let whole = value as i64;
    let rest = value - whole as f64;
    whole.saturating_add(i64::from(rest >= 0.5)).saturating_sub(i64::from(rest <= -0.5))
}

/// Saturates an integer at 16 bits.
fn saturate(steps: i64) -> i16 {
    i16::try_from(steps).unwrap_or(if steps < 0 { i16::MIN } else { i16::MAX })
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "words are exact in f64")]
mod tests {
    use super::*;
    use ::fixed::types::{I2F14, I4F12, I8F8};
    use proptest::prelude::*;

    #[test]
    fn the_formats_span_what_their_names_say() {
        assert_eq!((Q1_14::MIN.to_f64(), Q1_14::MAX.to_f64()), (-2.0, 2.0 - 1.0 / 16_384.0));
        assert_eq!((Q3_12::MIN.to_f64(), Q3_12::MAX.to_f64()), (-8.0, 8.0 - 1.0 / 4_096.0));
        assert_eq!(Q7_8::from_bits(1).to_f64(), 1.0 / 256.0);
        assert_eq!(Q5_10::nearest(3.0).to_bits(), 3_072);
        assert_eq!(Q9_6::nearest(-40.0).to_bits(), -2_560);
    }

    #[test]
    fn words_of_all_torque_formats_are_steps_of_the_finest() {
        let formats = [TorqueFormat::Q3_12, TorqueFormat::Q5_10, TorqueFormat::Q7_8];
        assert_eq!(formats.map(|format| format.to_finest_steps(-3)), [-3, -12, -48]);
        assert_eq!(formats.map(|format| format.to_finest_steps(i16::MAX)), [32_767, 131_068, 524_272]);
    }

    #[test]
    fn every_word_comes_back_through_f64_and_agrees_with_the_fixed_crate() {
        for bits in i16::MIN..=i16::MAX {
            assert_eq!(Q1_14::nearest(Q1_14::from_bits(bits).to_f64()).to_bits(), bits);
            assert_eq!(Q1_14::from_bits(bits).to_f64(), I2F14::from_bits(bits).to_num::<f64>());
            assert_eq!(Q3_12::from_bits(bits).to_f64(), I4F12::from_bits(bits).to_num::<f64>());
            assert_eq!(Q7_8::try_nearest(I8F8::from_bits(bits).to_num()).unwrap().to_bits(), bits);
        }
    }

    #[test]
    fn every_angle_word_comes_back_through_radians() {
        for bits in i16::MIN..=i16::MAX {
            let angle = Q1_14::from_bits(bits).to_radians();
            for turns in [-2.0, -1.0, 0.0, 1.0, 2.0] {
                let word = Q1_14::from_radians(angle + turns * core::f64::consts::TAU);
                assert_eq!(word, Some(Q1_14::from_bits(bits)), "{angle} and {turns} turns");
            }
        }
        assert_eq!(Q1_14::from_radians(core::f64::consts::PI), Some(Q1_14::MIN));
        assert_eq!(Q1_14::from_radians(f64::NAN), None);
        assert_eq!(Q1_14::from_radians(f64::INFINITY), None);
    }

    #[test]
    fn out_of_range_is_said_with_the_bounds() {
        let error = Q1_14::try_nearest(2.5).unwrap_err();
        assert_eq!(error.to_string(), "2.5 is outside the range [-2, 2)");
        assert!(Q1_14::try_nearest(1.999_99).is_err(), "rounds up to 2, which is out of range");
        assert!(Q1_14::try_nearest(f64::NAN).is_err());
        assert_eq!(Q3_12::nearest(9.0), Q3_12::MAX);
        assert_eq!(Q3_12::nearest(-9.0), Q3_12::MIN);
    }

    proptest! {
        #[test]
        fn a_threshold_is_the_smallest_step_not_below_it(value in -31.9_f64..31.9) {
            let word = Q5_10::try_round_up(value).unwrap();
            prop_assert!(word.to_f64() >= value && word.to_f64() - value < 1.0 / 1_024.0);
        }

        #[test]
        fn rounding_errs_by_half_a_step_at_most(a: i16, b: i16) {
            let exact = Q1_14::from_bits(a).mul_wide::<12, 26>(Q3_12::from_bits(b));
            let rounded: Q3_12 = exact.round();
            let target = exact.to_f64().clamp(Q3_12::MIN.to_f64(), Q3_12::MAX.to_f64());
            prop_assert!((rounded.to_f64() - target).abs() <= 0.5 / 4_096.0);
        }

        #[test]
        fn ties_round_up(whole in -32_768_i64..32_767) {
            let half = Accumulator::<13>::from_steps(2 * whole + 1);
            prop_assert_eq!(i64::from(half.round::<12>().to_bits()), whole + 1);
        }
    }

    #[test]
    fn a_torque_format_has_its_range() {
        let format = TorqueFormat::Q3_12;
        assert_eq!(
            (format.to_real(i16::MIN), format.to_real(1), format.upper_bound()),
            (-8.0, 1.0 / 4_096.0, 8.0)
        );
        assert_eq!([Q3_12::MIN, Q3_12::ZERO, Q3_12::MAX].map(Q::is_saturated), [true, false, true]);
    }
}
