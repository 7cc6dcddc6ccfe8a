//! The number that a kernel computes with: fixed point on the cell; other types for tests and counts.

use core::ops::{Add, Mul, Neg, Sub};

use protocol::fixed::{Acc, Q1_14};

use crate::sine::{FINE, cosine, fine_sine_cosine, paper_cosine, paper_sine, sine};

/// A number that the kernels can compute with, and the wider sums of products in which they do it.
///
/// Words of state are rounded once per sum of products; nothing else loses bits.
pub trait Scalar: Copy {
    /// A sum of products, before it is rounded.
    type Wide: Copy;
    /// What constants are computed with, once, when a kernel is built. An integer here counts steps
    /// whose size the program follows; see [`Scalar::settle`].
    type Fine: Copy
        + Add<Output = Self::Fine>
        + Sub<Output = Self::Fine>
        + Mul<Output = Self::Fine>
        + Neg<Output = Self::Fine>;

    /// Nothing.
    const ZERO: Self;
    /// One.
    const ONE: Self;

    /// The number that a parameter's word means.
    fn word(word: Q1_14) -> Self;
    /// The product.
    fn times(self, rhs: Self) -> Self::Wide;
    /// The number as a sum.
    fn widen(self) -> Self::Wide;
    /// The sum.
    fn plus(lhs: Self::Wide, rhs: Self::Wide) -> Self::Wide;
    /// The difference.
    fn minus(lhs: Self::Wide, rhs: Self::Wide) -> Self::Wide;
    /// Rounds a sum to a word, halves up, and holds it in range.
    fn round(sum: Self::Wide) -> Self;
    /// The negative.
    fn negative(self) -> Self;
    /// The sine of an angle in quarter turns.
    fn sine(angle: Q1_14) -> Self;
    /// The cosine of an angle in quarter turns.
    fn cosine(angle: Q1_14) -> Self;
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

/// What the cell computes with: words of 16 bits, products and sums of 32, the seventh-order sine.
impl Scalar for Q1_14 {
    type Wide = i32;
    type Fine = i64;

    const ZERO: Self = Self::ZERO;
    const ONE: Self = Self::from_bits(1 << 14);

    #[inline]
    fn word(word: Q1_14) -> Self {
        word
    }

    #[inline]
    fn times(self, rhs: Self) -> i32 {
        i32::from(self.to_bits()) * i32::from(rhs.to_bits()) // at most 2^30
    }

    #[inline]
    fn widen(self) -> i32 {
        i32::from(self.to_bits()) << 14
    }

    #[inline]
    fn plus(lhs: i32, rhs: i32) -> i32 {
        lhs.saturating_add(rhs)
    }

    #[inline]
    fn minus(lhs: i32, rhs: i32) -> i32 {
        lhs.saturating_sub(rhs)
    }

    #[inline]
    fn round(sum: i32) -> Self {
        let steps = sum.saturating_add(1 << 13) >> 14;
        Self::from_bits(i16::try_from(steps).unwrap_or(if steps < 0 { i16::MIN } else { i16::MAX }))
    }

    #[inline]
    fn negative(self) -> Self {
        self.saturating_neg()
    }

    #[inline]
    fn sine(angle: Q1_14) -> Self {
        sine(angle)
    }

    #[inline]
    fn cosine(angle: Q1_14) -> Self {
        cosine(angle)
    }

    fn fine(word: Q1_14) -> i64 {
        i64::from(word.to_bits())
    }

    fn fine_turn(angle: Q1_14) -> [i64; 3] {
        let [sine, cosine] = fine_sine_cosine(angle);
        [sine, cosine, 1 << FINE]
    }

    fn settle<const F: u32>(constant: i64) -> Self {
        Acc::<F>::from_steps(constant).round()
    }
}

/// The same words with the paper's fifth-order sine (Eq. 17 to 19).
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct PaperWord(pub Q1_14);

impl Scalar for PaperWord {
    type Wide = i32;
    type Fine = i64;

    const ZERO: Self = Self(Q1_14::ZERO);
    const ONE: Self = Self(<Q1_14 as Scalar>::ONE);

    fn word(word: Q1_14) -> Self {
        Self(word)
    }

    fn times(self, rhs: Self) -> i32 {
        self.0.times(rhs.0)
    }

    fn widen(self) -> i32 {
        Scalar::widen(self.0)
    }

    fn plus(lhs: i32, rhs: i32) -> i32 {
        <Q1_14 as Scalar>::plus(lhs, rhs)
    }

    fn minus(lhs: i32, rhs: i32) -> i32 {
        <Q1_14 as Scalar>::minus(lhs, rhs)
    }

    fn round(sum: i32) -> Self {
        Self(<Q1_14 as Scalar>::round(sum))
    }

    fn negative(self) -> Self {
        Self(self.0.negative())
    }

    fn sine(angle: Q1_14) -> Self {
        Self(paper_sine(angle))
    }

    fn cosine(angle: Q1_14) -> Self {
        Self(paper_cosine(angle))
    }

    fn fine(word: Q1_14) -> i64 {
        <Q1_14 as Scalar>::fine(word)
    }

    fn fine_turn(angle: Q1_14) -> [i64; 3] {
        <Q1_14 as Scalar>::fine_turn(angle)
    }

    fn settle<const F: u32>(constant: i64) -> Self {
        Self(<Q1_14 as Scalar>::settle::<F>(constant))
    }
}
