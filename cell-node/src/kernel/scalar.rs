//! The number that a kernel computes with: fixed point on the cell; other types for tests and counts.

use core::fmt::Debug;
use core::marker::PhantomData;
use core::ops::{Add, Mul, Neg, Sub};

use protocol::fixed::{Acc, Q1_14};

use crate::sine::{FINE, fine_sine_cosine, sine_cosine};

/// What a kernel returns, and by which numbers it computes it.
pub trait Scalar: Copy {
    /// What it is computed with.
    type Number: Number;

    /// A result.
    fn from_number(number: Self::Number) -> Self;
}

/// A number that the kernels can compute with, and the wider sums of products in which they do it.
///
/// Words of state are rounded once per sum of products; nothing else loses bits.
pub trait Number: Copy + Debug + PartialEq {
    /// A sum of products, before it is rounded.
    type Wide: Copy;
    /// What constants are computed with, once, when a kernel is built. An integer here counts steps
    /// whose size the program follows; see [`Number::settle`].
    type Fine: Copy
        + Add<Output = Self::Fine>
        + Sub<Output = Self::Fine>
        + Mul<Output = Self::Fine>
        + Neg<Output = Self::Fine>;

    /// The number that a parameter's word means.
    fn word(word: Q1_14) -> Self;
    /// Nothing.
    #[must_use]
    fn zero() -> Self {
        Self::word(Q1_14::ZERO)
    }
    /// The product.
    fn times(self, rhs: Self) -> Self::Wide;
    /// The number as a sum.
    fn widen(self) -> Self::Wide;
    /// The sum.
    fn plus(lhs: Self::Wide, rhs: Self::Wide) -> Self::Wide;
    /// The difference.
    fn minus(lhs: Self::Wide, rhs: Self::Wide) -> Self::Wide;
    /// Rounds a sum to the nearest word, ties up, and saturates.
    fn round(sum: Self::Wide) -> Self;
    /// The sum of two products, or of a number and a product, that is rounded: quicker than [`Number::plus`]. In each of
    /// two products one factor must be within 1, as sines are.
    #[must_use]
    fn rounded_sum(lhs: Self::Wide, rhs: Self::Wide) -> Self {
        Self::round(Self::plus(lhs, rhs))
    }
    /// The difference of the same, rounded.
    #[must_use]
    fn rounded_difference(lhs: Self::Wide, rhs: Self::Wide) -> Self {
        Self::round(Self::minus(lhs, rhs))
    }
    /// The negative.
    #[must_use]
    fn negative(self) -> Self;
    /// The sum, where it is known to be within the range of a word.
    fn bounded_plus(lhs: Self::Wide, rhs: Self::Wide) -> Self::Wide {
        Self::plus(lhs, rhs)
    }
    /// The difference, where it is known to be within the range of a word.
    fn bounded_minus(lhs: Self::Wide, rhs: Self::Wide) -> Self::Wide {
        Self::minus(lhs, rhs)
    }
    /// Rounds a sum that is known to be within the range of a word.
    #[must_use]
    fn bounded(sum: Self::Wide) -> Self {
        Self::round(sum)
    }
    /// The number and a product, rounded, where it is known to be within the range of a word.
    #[must_use]
    fn bounded_more(self, product: Self::Wide) -> Self {
        Self::round(Self::plus(self.widen(), product))
    }
    /// The number less a product, of the same kind.
    #[must_use]
    fn bounded_less(self, product: Self::Wide) -> Self {
        Self::round(Self::minus(self.widen(), product))
    }
    /// The negative of a number that is known not to be the smallest word.
    #[must_use]
    fn bounded_negative(self) -> Self {
        self.negative()
    }
    /// The length of a vector in steps of 2^-14, rounded up; none where it is not known.
    fn norm(vector: [Self; 3]) -> Option<u32>;
    /// Sine and cosine of an angle in quarter turns.
    fn sine_cosine(angle: Q1_14) -> [Self; 2];
    /// The sum of two angles, wrapped into one turn.
    #[must_use]
    fn plus_angle(lhs: Q1_14, rhs: Q1_14) -> Q1_14 {
        lhs.wrapping_add(rhs)
    }

    /// A parameter's word, to compute a constant with.
    fn fine(word: Q1_14) -> Self::Fine;
    /// Sine, cosine and one, in the same steps (of 2^-28 where they are integers).
    fn fine_turn(angle: Q1_14) -> [Self::Fine; 3];
    /// A computed constant as a word; where it is an integer, in steps of 2^-F.
    fn settle<const F: u32>(constant: Self::Fine) -> Self;
}

/// A number of 16 bits in the format Q1.14, computed with as [`Steps`].
pub trait Word: Copy + Debug + PartialEq {
    /// The number that a word means.
    fn from_word(word: Q1_14) -> Self;
    /// The word.
    fn to_word(self) -> Q1_14;
    /// Sine and cosine of an angle in quarter turns, in steps of 2^-14, of seventh order unless it says otherwise.
    #[must_use]
    fn sine_cosine(angle: Q1_14) -> [i32; 2] {
        sine_cosine(angle)
    }
    /// Takes note of an operation, if it counts them.
    fn note(_operation: impl FnOnce(&mut Operations)) {}
}

/// How often a computation did what.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Operations {
    /// Multiplications of two words.
    pub multiplications: u32,
    /// Additions and subtractions of sums.
    pub additions: u32,
    /// Sines.
    pub sines: u32,
    /// Cosines.
    pub cosines: u32,
    /// Negations of a word.
    pub negations: u32,
    /// Additions of angles, which wrap.
    pub angle_additions: u32,
    /// Sums rounded to a word.
    pub roundings: u32,
}

/// What the cell computes with.
impl Word for Q1_14 {
    fn from_word(word: Q1_14) -> Self {
        word
    }

    fn to_word(self) -> Q1_14 {
        self
    }
}

impl<W: Word> Scalar for W {
    type Number = Steps<W>;

    #[inline]
    fn from_number(number: Steps<W>) -> Self {
        let [low, high, ..] = number.steps.to_le_bytes();
        Self::from_word(Q1_14::from_bits(i16::from_le_bytes([low, high])))
    }
}

/// Steps of 2^-14 within the range of a word, as wide as a processor's register; products and sums take 32 bits too.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Steps<W> {
    steps: i32,
    of: PhantomData<W>,
}

impl<W> Steps<W> {
    #[inline]
    const fn new(steps: i32) -> Self {
        Self { steps, of: PhantomData }
    }

    /// Steps of 2^-28 that are already half a step of 2^-14 too many.
    #[inline]
    fn held(sum: i32) -> Self {
        let steps = sum >> 14;
        let [low, high, ..] = steps.to_le_bytes();
        let fits = i32::from(i16::from_le_bytes([low, high])) == steps;
        Self::new(if fits { steps } else { (steps >> 31) ^ 0x7FFF })
    }
}

/// Steps of 2^-28 in steps of 2^-14, rounded, ties up. In two steps, because the half that is added fits an instruction.
#[inline]
const fn to_steps(sum: i32) -> i32 {
    ((sum >> 13) + 1) >> 1
}

/// What is known to be a word.
#[inline]
fn within_word(steps: i32) -> i32 {
    debug_assert!(i16::try_from(steps).is_ok(), "{steps} is no word");
    steps
}

/// Half a step of 2^-14 in steps of 2^-28.
const HALF: i32 = 1 << 13;

impl<W: Word> Number for Steps<W> {
    type Wide = i32;
    type Fine = i64;

    #[inline]
    fn word(word: Q1_14) -> Self {
        Self::new(word.to_bits().into())
    }

    #[inline]
    fn times(self, rhs: Self) -> i32 {
        W::note(|done| done.multiplications += 1);
        self.steps.wrapping_mul(rhs.steps) // at most 2^30
    }

    #[inline]
    fn widen(self) -> i32 {
        self.steps << 14
    }

    #[inline]
    fn plus(lhs: i32, rhs: i32) -> i32 {
        W::note(|done| done.additions += 1);
        lhs.saturating_add(rhs)
    }

    #[inline]
    fn minus(lhs: i32, rhs: i32) -> i32 {
        W::note(|done| done.additions += 1);
        lhs.saturating_sub(rhs)
    }

    #[inline]
    fn round(sum: i32) -> Self {
        W::note(|done| done.roundings += 1);
        Self::held(sum.saturating_add(HALF))
    }

    /// At most 2^29 + 2^30 steps of 2^-28.
    #[inline]
    fn rounded_sum(lhs: i32, rhs: i32) -> Self {
        W::note(|done| (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1));
        debug_assert!(lhs.checked_add(rhs).and_then(|sum| sum.checked_add(HALF)).is_some(), "{lhs} + {rhs}");
        Self::held(lhs.wrapping_add(rhs).wrapping_add(HALF))
    }

    #[inline]
    fn rounded_difference(lhs: i32, rhs: i32) -> Self {
        W::note(|done| (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1));
        debug_assert!(lhs.checked_sub(rhs).and_then(|sum| sum.checked_add(HALF)).is_some(), "{lhs} - {rhs}");
        Self::held(lhs.wrapping_sub(rhs).wrapping_add(HALF))
    }

    #[inline]
    fn bounded_plus(lhs: i32, rhs: i32) -> i32 {
        W::note(|done| done.additions += 1);
        lhs.wrapping_add(rhs)
    }

    #[inline]
    fn bounded_minus(lhs: i32, rhs: i32) -> i32 {
        W::note(|done| done.additions += 1);
        lhs.wrapping_sub(rhs)
    }

    #[inline]
    fn bounded(sum: i32) -> Self {
        W::note(|done| done.roundings += 1);
        Self::new(within_word(to_steps(sum)))
    }

    #[inline]
    fn bounded_more(self, product: i32) -> Self {
        W::note(|done| (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1));
        Self::new(within_word(self.steps + to_steps(product)))
    }

    #[inline]
    fn bounded_less(self, product: i32) -> Self {
        W::note(|done| (done.additions, done.roundings) = (done.additions + 1, done.roundings + 1));
        Self::new(within_word(self.steps + to_steps(product.wrapping_neg())))
    }

    #[inline]
    fn bounded_negative(self) -> Self {
        W::note(|done| done.negations += 1);
        debug_assert!(self.steps > -0x8000);
        Self::new(-self.steps)
    }

    fn norm(vector: [Self; 3]) -> Option<u32> {
        // At most 3 * 2^30.
        let square: u32 = vector.iter().map(|it| it.steps.unsigned_abs().pow(2)).sum();
        Some(square.isqrt() + 1)
    }

    /// The smallest word becomes the largest.
    #[inline]
    fn negative(self) -> Self {
        W::note(|done| done.negations += 1);
        let negative = -self.steps;
        Self::new(if negative > 0x7FFF { 0x7FFF } else { negative })
    }

    #[inline]
    fn sine_cosine(angle: Q1_14) -> [Self; 2] {
        W::note(|done| (done.sines, done.cosines) = (done.sines + 1, done.cosines + 1));
        W::sine_cosine(angle).map(Self::new)
    }

    #[inline]
    fn plus_angle(lhs: Q1_14, rhs: Q1_14) -> Q1_14 {
        W::note(|done| done.angle_additions += 1);
        lhs.wrapping_add(rhs)
    }

    fn fine(word: Q1_14) -> i64 {
        i64::from(word.to_bits())
    }

    fn fine_turn(angle: Q1_14) -> [i64; 3] {
        let [sine, cosine] = fine_sine_cosine(angle);
        [sine, cosine, 1 << FINE]
    }

    fn settle<const F: u32>(constant: i64) -> Self {
        Self::word(Acc::<F>::from_steps(constant).round())
    }
}
