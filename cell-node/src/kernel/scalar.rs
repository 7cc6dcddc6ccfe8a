//! The number type of a kernel: fixed point on the cell, and other types for tests and operation counts.

use core::fmt::Debug;
use core::marker::PhantomData;
use core::ops::{Add, Mul, Neg, Sub};

use protocol::fixed::{Accumulator, Q1_14};

use crate::contact::low_16_bits;
use crate::sine::{PRECISE_SINE_FRACTION_BITS, precise_sine_cosine, sine_cosine};

/// The result type of a kernel, and the number type of its computation.
pub trait Scalar: Copy {
    /// True for the cell's own word, [`Q1_14`]. Assembly computes with this type only.
    const IS_CELL_WORD: bool = false;
    /// The number type of the computation.
    type Number: Number;

    /// Converts an element of J from the number that the kernel computes with to the type that it returns.
    fn from_number(number: Self::Number) -> Self;
}

/// A number type for kernels, with the wider type of its sums of products.
///
/// For words, each sum of products is rounded once; no other operation loses bits.
pub trait Number: Copy + Debug + PartialEq {
    /// A sum of products before rounding.
    type WideSum: Copy;
    /// The type for constants, which are computed once when a kernel is created. For integers a constant is a number of
    /// steps; the size of a step is passed to [`Number::round_constant`].
    type UnroundedConstant: Copy
        + Add<Output = Self::UnroundedConstant>
        + Sub<Output = Self::UnroundedConstant>
        + Mul<Output = Self::UnroundedConstant>
        + Neg<Output = Self::UnroundedConstant>;

    /// Converts a word of the parameters to a number.
    fn from_word(word: Q1_14) -> Self;
    /// Returns zero.
    #[must_use]
    fn zero() -> Self {
        Self::from_word(Q1_14::ZERO)
    }
    /// Multiplies two numbers.
    fn times(self, rhs: Self) -> Self::WideSum;
    /// Converts a number to a sum.
    fn widen(self) -> Self::WideSum;
    /// Adds two sums.
    fn plus(lhs: Self::WideSum, rhs: Self::WideSum) -> Self::WideSum;
    /// Subtracts two sums.
    fn minus(lhs: Self::WideSum, rhs: Self::WideSum) -> Self::WideSum;
    /// Rounds a sum to the nearest number, ties up, with saturation.
    fn round(sum: Self::WideSum) -> Self;
    /// Adds two products, or a number and a product, and rounds the sum. This is faster than [`Number::plus`] and
    /// [`Number::round`]. If both terms are products, one factor of each must be within [-1, 1], as sines are.
    #[must_use]
    fn rounded_sum(lhs: Self::WideSum, rhs: Self::WideSum) -> Self {
        Self::round(Self::plus(lhs, rhs))
    }
    /// Subtracts two products, or a product from a number, and rounds. The rule of [`Number::rounded_sum`] applies.
    #[must_use]
    fn rounded_difference(lhs: Self::WideSum, rhs: Self::WideSum) -> Self {
        Self::round(Self::minus(lhs, rhs))
    }
    /// Negates a number.
    #[must_use]
    fn negated(self) -> Self;
    /// Adds two sums whose result is known to fit a word.
    fn bounded_plus(lhs: Self::WideSum, rhs: Self::WideSum) -> Self::WideSum {
        Self::plus(lhs, rhs)
    }
    /// Subtracts two sums whose result is known to fit a word.
    fn bounded_minus(lhs: Self::WideSum, rhs: Self::WideSum) -> Self::WideSum {
        Self::minus(lhs, rhs)
    }
    /// Rounds a sum that is known to fit a word.
    #[must_use]
    fn round_bounded(sum: Self::WideSum) -> Self {
        Self::round(sum)
    }
    /// Adds a product to the number and rounds, if the result is known to fit a word.
    #[must_use]
    fn bounded_add_product(self, product: Self::WideSum) -> Self {
        Self::round(Self::plus(self.widen(), product))
    }
    /// Subtracts a product from the number and rounds, if the result is known to fit a word.
    #[must_use]
    fn bounded_subtract_product(self, product: Self::WideSum) -> Self {
        Self::round(Self::minus(self.widen(), product))
    }
    /// Negates a number that is known not to be the smallest word.
    #[must_use]
    fn bounded_negative(self) -> Self {
        self.negated()
    }
    /// Returns the length of a vector in steps of 2^-14, rounded up; `None` if it is unknown.
    fn norm_upper_bound(vector: [Self; 3]) -> Option<u32>;
    /// Returns sine and cosine of an angle in quarter turns.
    fn sine_cosine(angle: Q1_14) -> [Self; 2];
    /// Returns sine and cosine as cells of earlier builds computed them.
    #[cfg(feature = "earlier-sine")]
    #[must_use]
    fn seventh_order_sine_cosine(angle: Q1_14) -> [Self; 2] {
        Self::sine_cosine(angle)
    }
    /// Adds two angles in quarter turns. The sum wraps into one turn.
    #[must_use]
    fn add_angles(lhs: Q1_14, rhs: Q1_14) -> Q1_14 {
        lhs.wrapping_add(rhs)
    }

    /// Converts a word of the parameters to the wide number in which constants are computed before they are rounded.
    fn unrounded_from_word(word: Q1_14) -> Self::UnroundedConstant;
    /// Returns the sine and cosine of an angle in quarter turns, and one, all in the same steps: 2^-28 for integers.
    fn unrounded_sine_cosine_one(angle: Q1_14) -> [Self::UnroundedConstant; 3];
    /// Rounds a computed constant to a number. For integers, the constant is in steps of 2^-F.
    fn round_constant<const F: u32>(constant: Self::UnroundedConstant) -> Self;
}

/// A 16-bit number in the format Q1.14, for computations with [`FixedPoint`].
pub trait Word: Copy + Debug + PartialEq {
    /// True for the cell's own word, [`Q1_14`].
    const IS_CELL_WORD: bool = false;

    /// Creates the number from a word.
    fn from_word(word: Q1_14) -> Self;
    /// Returns the number as a word.
    fn to_word(self) -> Q1_14;
    /// Returns sine and cosine of an angle in quarter turns, in steps of 2^-14. The default is the
    /// cell's sine.
    #[must_use]
    fn sine_cosine(angle: Q1_14) -> [i32; 2] {
        sine_cosine(angle)
    }
    /// Records an operation, if this type counts operations; else does nothing.
    fn record_operation(_operation: impl FnOnce(&mut Operations)) {}
}

/// Numbers of operations in a computation.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Operations {
    /// Number of multiplications of two words.
    pub multiplications: u32,
    /// Number of additions and subtractions of sums.
    pub additions: u32,
    /// Number of sines.
    pub sines: u32,
    /// Number of cosines.
    pub cosines: u32,
    /// Number of negations of a word.
    pub negations: u32,
    /// Number of additions of angles, which wrap.
    pub angle_additions: u32,
    /// Number of sums rounded to a word.
    pub roundings: u32,
}

/// The cell's number type.
impl Word for Q1_14 {
    const IS_CELL_WORD: bool = true;

    fn from_word(word: Q1_14) -> Self {
        word
    }

    fn to_word(self) -> Q1_14 {
        self
    }
}

impl<W: Word> Scalar for W {
    const IS_CELL_WORD: bool = W::IS_CELL_WORD;
    type Number = FixedPoint<W>;

    #[inline]
    fn from_number(number: FixedPoint<W>) -> Self {
        Self::from_word(Q1_14::from_bits(low_16_bits(number.steps)))
    }
}

/// A number within the range of a word, in steps of 2^-14. It is stored in 32 bits, the width of a register. Products
/// and sums also take 32 bits.
#[repr(transparent)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FixedPoint<W> {
    steps: i32,
    of: PhantomData<W>,
}

impl<W> FixedPoint<W> {
    #[inline]
    const fn new(steps: i32) -> Self {
        Self { steps, of: PhantomData }
    }

    /// Converts a sum in steps of 2^-28 to steps of 2^-14, with saturation. The caller has added half a step of 2^-14
    /// for rounding.
    #[inline]
    fn saturate_sum(sum: i32) -> Self {
        let steps = sum >> 14;
        let [low, high, ..] = steps.to_le_bytes();
        let fits = i32::from(i16::from_le_bytes([low, high])) == steps;
        Self::new(if fits { steps } else { (steps >> 31) ^ 0x7FFF })
    }
}

/// Rounds steps of 2^-28 to steps of 2^-14, ties up. The shift is done in two parts, so that the added half is small
/// enough for an immediate operand of the processor.
#[inline]
const fn round_to_steps(sum: i32) -> i32 {
    ((sum >> 13) + 1) >> 1
}

/// Checks in debug builds that steps fit a word.
#[inline]
fn debug_assert_fits_word(steps: i32) -> i32 {
    debug_assert!(i16::try_from(steps).is_ok(), "{steps} is no word");
    steps
}

/// Half a step of 2^-14 in steps of 2^-28.
const HALF_STEP: i32 = 1 << 13;

impl<W: Word> Number for FixedPoint<W> {
    type WideSum = i32;
    type UnroundedConstant = i64;

    #[inline]
    fn from_word(word: Q1_14) -> Self {
        Self::new(word.to_bits().into())
    }

    #[inline]
    fn times(self, rhs: Self) -> i32 {
        W::record_operation(|done| done.multiplications += 1);
        self.steps.wrapping_mul(rhs.steps) // at most 2^30
    }

    #[inline]
    fn widen(self) -> i32 {
        self.steps << 14
    }

    #[inline]
    fn plus(lhs: i32, rhs: i32) -> i32 {
        W::record_operation(|done| done.additions += 1);
        lhs.saturating_add(rhs)
    }

    #[inline]
    fn minus(lhs: i32, rhs: i32) -> i32 {
        W::record_operation(|done| done.additions += 1);
        lhs.saturating_sub(rhs)
    }

    #[inline]
    fn round(sum: i32) -> Self {
        W::record_operation(|done| done.roundings += 1);
        Self::saturate_sum(sum.saturating_add(HALF_STEP))
    }

    /// The sum of a number and a product is at most 2^29 + 2^30 steps of 2^-28, so 32 bits suffice.
    #[inline]
    fn rounded_sum(lhs: i32, rhs: i32) -> Self {
        W::record_operation(|done| {
            (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1)
        });
        debug_assert!(
            lhs.checked_add(rhs).and_then(|sum| sum.checked_add(HALF_STEP)).is_some(),
            "{lhs} + {rhs}"
        );
        Self::saturate_sum(lhs.wrapping_add(rhs).wrapping_add(HALF_STEP))
    }

    #[inline]
    fn rounded_difference(lhs: i32, rhs: i32) -> Self {
        W::record_operation(|done| {
            (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1)
        });
        debug_assert!(
            lhs.checked_sub(rhs).and_then(|sum| sum.checked_add(HALF_STEP)).is_some(),
            "{lhs} - {rhs}"
        );
        Self::saturate_sum(lhs.wrapping_sub(rhs).wrapping_add(HALF_STEP))
    }

    #[inline]
    fn bounded_plus(lhs: i32, rhs: i32) -> i32 {
        W::record_operation(|done| done.additions += 1);
        lhs.wrapping_add(rhs)
    }

    #[inline]
    fn bounded_minus(lhs: i32, rhs: i32) -> i32 {
        W::record_operation(|done| done.additions += 1);
        lhs.wrapping_sub(rhs)
    }

    #[inline]
    fn round_bounded(sum: i32) -> Self {
        W::record_operation(|done| done.roundings += 1);
        Self::new(debug_assert_fits_word(round_to_steps(sum)))
    }

    #[inline]
    fn bounded_add_product(self, product: i32) -> Self {
        W::record_operation(|done| {
            (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1)
        });
        Self::new(debug_assert_fits_word(self.steps + round_to_steps(product)))
    }

    #[inline]
    fn bounded_subtract_product(self, product: i32) -> Self {
        W::record_operation(|done| {
            (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1)
        });
        Self::new(debug_assert_fits_word(self.steps + round_to_steps(product.wrapping_neg())))
    }

    #[inline]
    fn bounded_negative(self) -> Self {
        W::record_operation(|done| done.negations += 1);
        debug_assert!(self.steps > -0x8000);
        Self::new(-self.steps)
    }

    fn norm_upper_bound(vector: [Self; 3]) -> Option<u32> {
        // At most 3 * 2^30.
        let square: u32 = vector.iter().map(|it| it.steps.unsigned_abs().pow(2)).sum();
        Some(square.isqrt() + 1)
    }

    /// Negates the number. The smallest word becomes the largest.
    #[inline]
    fn negated(self) -> Self {
        W::record_operation(|done| done.negations += 1);
        let negative = -self.steps;
        Self::new(if negative > 0x7FFF { 0x7FFF } else { negative })
    }

    #[inline]
    fn sine_cosine(angle: Q1_14) -> [Self; 2] {
        W::record_operation(|done| (done.sines, done.cosines) = (done.sines + 1, done.cosines + 1));
        W::sine_cosine(angle).map(Self::new)
    }

    #[cfg(feature = "earlier-sine")]
    fn seventh_order_sine_cosine(angle: Q1_14) -> [Self; 2] {
        crate::sine::seventh_order::seventh_order_sine_cosine(angle).map(Self::new)
    }

    #[inline]
    fn add_angles(lhs: Q1_14, rhs: Q1_14) -> Q1_14 {
        W::record_operation(|done| done.angle_additions += 1);
        lhs.wrapping_add(rhs)
    }

    fn unrounded_from_word(word: Q1_14) -> i64 {
        i64::from(word.to_bits())
    }

    fn unrounded_sine_cosine_one(angle: Q1_14) -> [i64; 3] {
        let [sine, cosine] = precise_sine_cosine(angle);
        [sine, cosine, 1 << PRECISE_SINE_FRACTION_BITS]
    }

    fn round_constant<const F: u32>(constant: i64) -> Self {
        Self::from_word(Accumulator::<F>::from_steps(constant).round())
    }
}
