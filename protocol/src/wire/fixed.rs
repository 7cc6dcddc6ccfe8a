//! Fixed-point numbers of 16 bits, and the exact sums in which they meet.
//!
//! `Qm_n` is read as one sign bit, `m` integer bits and `n` fraction bits, as the robot-skin
//! literature does: Q1.14 spans [-2, 2). The crate `fixed` counts the sign bit in and calls the same
//! format `I2F14`.
//!
//! A format is the resolution of a number, not its quantity: [`crate::message`] defines which word is a
//! force and which a torque. There are no overloaded operators, so that every place where bits can be
//! lost has a name: [`Acc::round`] and the saturating operations.

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

/// Whether a word of any format means *saturated* where saturation is marked (torques and sums).
#[must_use]
pub const fn is_saturated(word: i16) -> bool {
    word == i16::MAX || word == i16::MIN
}

/// In which format the cells of a bus send their own torques: a wider range for a coarser step. Sums are Q7.8.
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
    /// Every format, the finest first; a format's place is the number that stands for it.
    pub const ALL: [Self; 3] = [Self::Q3_12, Self::Q5_10, Self::Q7_8];

    /// Its name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Q3_12 => "Q3.12",
            Self::Q5_10 => "Q5.10",
            Self::Q7_8 => "Q7.8",
        }
    }

    /// The number that stands for it in a parameter.
    #[must_use]
    pub const fn number(self) -> u8 {
        self as u8
    }

    /// The format that a number stands for.
    #[must_use]
    pub fn from_number(number: i16) -> Option<Self> {
        usize::try_from(number).ok().and_then(|number| Self::ALL.get(number)).copied()
    }

    /// Fraction bits of its words.
    #[must_use]
    pub const fn fraction(self) -> u32 {
        match self {
            Self::Q3_12 => 12,
            Self::Q5_10 => 10,
            Self::Q7_8 => 8,
        }
    }

    /// What one step is worth, in Nm or N.
    #[must_use]
    pub fn step(self) -> f64 {
        1.0 / f64::from(1_u32 << self.fraction())
    }

    /// What a word is worth, in Nm or N.
    #[must_use]
    pub fn real(self, word: i16) -> f64 {
        f64::from(word) * self.step()
    }

    /// The nearest word, ties away from zero; out of range it saturates, and what is not a number becomes zero.
    #[must_use]
    pub fn nearest(self, value: f64) -> i16 {
        match self {
            Self::Q3_12 => Q::<12>::nearest(value).0,
            Self::Q5_10 => Q::<10>::nearest(value).0,
            Self::Q7_8 => Q::<8>::nearest(value).0,
        }
    }

    /// A word in steps of 2^-12 Nm or N, the finest of all formats: exact.
    #[must_use]
    pub fn finest_steps(self, word: i16) -> i32 {
        i32::from(word) << (Self::Q3_12.fraction() - self.fraction())
    }

    /// The first torque beyond its range, in Nm or N.
    #[must_use]
    pub fn bound(self) -> f64 {
        -self.real(i16::MIN)
    }

    /// The word of an exact torque, rounded to the nearest step, ties up, and held within the range.
    #[must_use]
    pub fn round<const F: u32>(self, exact: Acc<F>) -> i16 {
        match self {
            Self::Q3_12 => exact.round::<12>().to_bits(),
            Self::Q5_10 => exact.round::<10>().to_bits(),
            Self::Q7_8 => exact.round::<8>().to_bits(),
        }
    }
}

/// A real number that is outside the range of a `Q` format.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error("{got} is not in [{min}, {bound})")]
pub struct OutOfRange {
    /// The number that does not fit.
    pub got: f64,
    /// The smallest number of the format.
    pub min: f64,
    /// The first number above the format's range.
    pub bound: f64,
}

impl<const F: u32> Q<F> {
    /// Nothing.
    pub const ZERO: Self = Self(0);
    /// The largest number; in a torque it means *saturated*.
    pub const MAX: Self = Self(i16::MAX);
    /// The smallest number; in a torque it means *saturated*.
    pub const MIN: Self = Self(i16::MIN);
    /// Steps in one.
    const SCALE: f64 = (1_u32 << F) as f64;

    /// The number whose word on the wire is `bits`.
    #[must_use]
    pub const fn from_bits(bits: i16) -> Self {
        Self(bits)
    }

    /// The word on the wire.
    #[must_use]
    pub const fn to_bits(self) -> i16 {
        self.0
    }

    /// The number as a real one, exactly.
    #[must_use]
    pub fn to_f64(self) -> f64 {
        f64::from(self.0) / Self::SCALE
    }

    /// The nearest number of this format, ties away from zero; out of range it saturates, and what
    /// is not a number becomes zero.
    #[must_use]
    pub fn nearest(value: f64) -> Self {
        Self(saturate(round_half_away(value * Self::SCALE)))
    }

    /// The nearest number of this format, ties away from zero.
    ///
    /// # Errors
    /// When the nearest step lies outside the range, or `value` is not a number.
    pub fn try_nearest(value: f64) -> Result<Self, OutOfRange> {
        if value.is_nan() {
            return Err(Self::out_of_range(value));
        }
        i16::try_from(round_half_away(value * Self::SCALE)).map(Self).map_err(|_| Self::out_of_range(value))
    }

    /// The smallest number of this format that is not below `value`: how thresholds are rounded, so that
    /// nothing below the requested threshold gets through.
    ///
    /// # Errors
    /// When that number lies outside the range, or `value` is not a number.
    pub fn try_at_least(value: f64) -> Result<Self, OutOfRange> {
        let nearest = Self::try_nearest(value)?;
        if nearest.to_f64() >= value {
            return Ok(nearest);
        }
        nearest.0.checked_add(1).map(Self).ok_or_else(|| Self::out_of_range(value))
    }

    fn out_of_range(got: f64) -> OutOfRange {
        OutOfRange { got, min: Self::MIN.to_f64(), bound: -Self::MIN.to_f64() }
    }

    /// Whether this word means *saturated* where saturation is marked (torques and sums).
    #[must_use]
    pub const fn is_saturated(self) -> bool {
        is_saturated(self.0)
    }

    /// The negative; the smallest number becomes the largest.
    #[must_use]
    pub const fn saturating_neg(self) -> Self {
        Self(self.0.saturating_neg())
    }

    /// The sum; held at the ends of the range.
    #[must_use]
    pub const fn saturating_add(self, rhs: Self) -> Self {
        Self(self.0.saturating_add(rhs.0))
    }

    /// The sum, wrapped into range: for angles, whose range is one turn.
    #[must_use]
    pub const fn wrapping_add(self, rhs: Self) -> Self {
        Self(self.0.wrapping_add(rhs.0))
    }

    /// The number as an exact sum, to add to and to round again.
    #[must_use]
    pub fn widen(self) -> Acc<F> {
        Acc(i64::from(self.0))
    }

    /// The exact product. `P` must be `F + G`, which the compiler checks.
    ///
    /// ```compile_fail
    /// # use protocol::fixed::{Acc, Q1_14, Q7_8};
    /// let _: Acc<21> = Q1_14::ZERO.mul_wide(Q7_8::ZERO); // 14 + 8 is not 21
    /// ```
    #[must_use]
    pub fn mul_wide<const G: u32, const P: u32>(self, rhs: Q<G>) -> Acc<P> {
        const { assert!(P == F + G, "a product has the sum of the fractional bits") }
        Acc(i64::from(self.0) * i64::from(rhs.0))
    }
}

impl Q1_14 {
    /// An angle in radians as quarter turns, `z = angle / (pi/2)` wrapped into [-2, 2), to the nearest
    /// step (ties away from zero). `None` when the angle is not finite.
    ///
    /// The range of Q1.14 is one whole turn, so wrapping is what 16-bit words do by themselves
    /// (paper, Eq. 11; the period of its Eq. 12 is 4, not 2).
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

    /// The angle in radians, in [-pi, pi).
    #[must_use]
    pub fn to_radians(self) -> f64 {
        self.to_f64() * core::f64::consts::FRAC_PI_2
    }
}

/// An exact sum of products, `F` bits fractional; room for 2^33 products of two words.
#[derive(Clone, Copy, Debug, Default, Eq, Ord, PartialEq, PartialOrd)]
pub struct Acc<const F: u32>(i64);

impl<const F: u32> Acc<F> {
    /// Nothing.
    pub const ZERO: Self = Self(0);

    /// The sum of the steps of 2^-F given as an integer.
    #[must_use]
    pub const fn from_steps(steps: i64) -> Self {
        Self(steps)
    }

    /// How many steps of 2^-F this is.
    #[must_use]
    pub const fn steps(self) -> i64 {
        self.0
    }

    /// The sum; saturates at the ends of 64 bits.
    #[must_use]
    pub const fn plus(self, rhs: Self) -> Self {
        Self(self.0.saturating_add(rhs.0))
    }

    /// The same number in finer steps. `G` must not be below `F`, which the compiler checks.
    #[must_use]
    pub const fn finer<const G: u32>(self) -> Acc<G> {
        const { assert!(G >= F, "finer means more fractional bits") }
        Acc(self.0.saturating_mul(1_i64 << (G - F)))
    }

    /// Rounds to `G` fractional bits, ties up, and holds the result within 16 bits: one of the few
    /// places where bits may be lost.
    ///
    /// The error is at most half a step of 2^-G unless the result saturates.
    #[must_use]
    pub fn round<const G: u32>(self) -> Q<G> {
        const { assert!(G < F, "rounding drops at least one bit") }
        let half = 1_i64 << (F - G - 1);
        Q(saturate(self.0.saturating_add(half) >> (F - G)))
    }

    /// The number as a real one; exact up to 53 significant bits.
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

/// Holds an integer within 16 bits.
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
        assert_eq!(error.to_string(), "2.5 is not in [-2, 2)");
        assert!(Q1_14::try_nearest(1.999_99).is_err(), "rounds up to 2, which is out of range");
        assert!(Q1_14::try_nearest(f64::NAN).is_err());
        assert_eq!(Q3_12::nearest(9.0), Q3_12::MAX);
        assert_eq!(Q3_12::nearest(-9.0), Q3_12::MIN);
    }

    proptest! {
        #[test]
        fn a_threshold_is_the_smallest_step_not_below_it(value in -31.9_f64..31.9) {
            let word = Q5_10::try_at_least(value).unwrap();
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
            let half = Acc::<13>::from_steps(2 * whole + 1);
            prop_assert_eq!(i64::from(half.round::<12>().to_bits()), whole + 1);
        }
    }

    #[test]
    fn a_torque_format_has_its_range() {
        let format = TorqueFormat::Q3_12;
        assert_eq!((format.real(i16::MIN), format.real(1), format.bound()), (-8.0, 1.0 / 4_096.0, 8.0));
        assert_eq!([Q3_12::MIN, Q3_12::ZERO, Q3_12::MAX].map(Q::is_saturated), [true, false, true]);
    }
}
