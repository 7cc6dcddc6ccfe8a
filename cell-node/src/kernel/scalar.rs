//! The number that a kernel computes with: fixed point on the cell; other types for tests and counts.

use core::ops::{Add, Mul, Neg, Sub};

use protocol::fixed::{Acc, Q1_14};

use crate::sine::{FINE, QUARTER, fine_sine_cosine, paper_sine, sine};

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

    /// The number that a parameter's word means.
    fn word(word: Q1_14) -> Self;
    /// Nothing.
    #[must_use]
    fn zero() -> Self {
        Self::word(Q1_14::ZERO)
    }
    /// One.
    #[must_use]
    fn one() -> Self {
        Self::word(QUARTER)
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

/// A number of 16 bits in the format Q1.14; as a [`Scalar`] its products and sums take 32 bits.
pub trait Word: Copy {
    /// The number that a word means.
    fn from_word(word: Q1_14) -> Self;
    /// The word.
    fn to_word(self) -> Q1_14;
    /// The sine of an angle in quarter turns, of seventh order unless it says otherwise.
    #[must_use]
    fn sine_word(angle: Q1_14) -> Q1_14 {
        sine(angle)
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

/// The same words with the paper's fifth-order sine (Eq. 17 to 19).
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct PaperWord(pub Q1_14);

impl Word for PaperWord {
    fn from_word(word: Q1_14) -> Self {
        Self(word)
    }

    fn to_word(self) -> Q1_14 {
        self.0
    }

    fn sine_word(angle: Q1_14) -> Q1_14 {
        paper_sine(angle)
    }
}

impl<W: Word> Scalar for W {
    type Wide = i32;
    type Fine = i64;

    fn word(word: Q1_14) -> Self {
        Self::from_word(word)
    }

    fn times(self, rhs: Self) -> i32 {
        Self::note(|done| done.multiplications += 1);
        i32::from(self.to_word().to_bits()) * i32::from(rhs.to_word().to_bits()) // at most 2^30
    }

    fn widen(self) -> i32 {
        i32::from(self.to_word().to_bits()) << 14
    }

    fn plus(lhs: i32, rhs: i32) -> i32 {
        Self::note(|done| done.additions += 1);
        lhs.saturating_add(rhs)
    }

    fn minus(lhs: i32, rhs: i32) -> i32 {
        Self::note(|done| done.additions += 1);
        lhs.saturating_sub(rhs)
    }

    fn round(sum: i32) -> Self {
        Self::note(|done| done.roundings += 1);
        let steps = sum.saturating_add(1 << 13) >> 14;
        let bits = i16::try_from(steps).unwrap_or(if steps < 0 { i16::MIN } else { i16::MAX });
        Self::from_word(Q1_14::from_bits(bits))
    }

    fn negative(self) -> Self {
        Self::note(|done| done.negations += 1);
        Self::from_word(self.to_word().saturating_neg())
    }

    fn sine(angle: Q1_14) -> Self {
        Self::note(|done| done.sines += 1);
        Self::from_word(Self::sine_word(angle))
    }

    fn cosine(angle: Q1_14) -> Self {
        Self::note(|done| done.cosines += 1);
        Self::from_word(Self::sine_word(angle.wrapping_add(QUARTER)))
    }

    fn plus_angle(lhs: Q1_14, rhs: Q1_14) -> Q1_14 {
        Self::note(|done| done.angle_additions += 1);
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
        Self::from_word(Acc::<F>::from_steps(constant).round())
    }
}
