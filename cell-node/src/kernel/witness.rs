//! Numbers to test and to count with: real ones, and ones that count what is done to them.

use std::cell::Cell;

use protocol::fixed::Q1_14;

use super::Scalar;

/// The witness: real numbers, the library's sine and cosine, no rounding.
impl Scalar for f64 {
    type Wide = Self;
    type Fine = Self;

    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

    fn word(word: Q1_14) -> Self {
        word.to_f64()
    }

    fn times(self, rhs: Self) -> Self {
        self * rhs
    }

    fn widen(self) -> Self {
        self
    }

    fn plus(lhs: Self, rhs: Self) -> Self {
        lhs + rhs
    }

    fn minus(lhs: Self, rhs: Self) -> Self {
        lhs - rhs
    }

    fn round(sum: Self) -> Self {
        sum
    }

    fn negative(self) -> Self {
        -self
    }

    fn sine(angle: Q1_14) -> Self {
        angle.to_radians().sin()
    }

    fn cosine(angle: Q1_14) -> Self {
        angle.to_radians().cos()
    }

    fn fine(word: Q1_14) -> Self {
        word.to_f64()
    }

    fn fine_turn(angle: Q1_14) -> [Self; 3] {
        [Scalar::sine(angle), Scalar::cosine(angle), 1.0]
    }

    fn settle<const F: u32>(constant: Self) -> Self {
        constant
    }
}

/// What a computation did.
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

std::thread_local! {
    static DONE: Cell<Operations> = const { Cell::new(Operations {
        multiplications: 0, additions: 0, sines: 0, cosines: 0, negations: 0, angle_additions: 0, roundings: 0,
    }) };
}

impl Operations {
    /// Runs a computation on [`Counted`] numbers and says what it did.
    pub fn count<T>(computation: impl FnOnce() -> T) -> (T, Self) {
        DONE.set(Self::default());
        let result = computation();
        (result, DONE.take())
    }

    fn note(change: impl FnOnce(&mut Self)) {
        let mut done = DONE.get();
        change(&mut done);
        DONE.set(done);
    }
}

/// A Q1.14 word that [`Operations::count`] watches.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Counted(pub Q1_14);

impl Scalar for Counted {
    type Wide = i32;
    type Fine = i64;

    const ZERO: Self = Self(<Q1_14 as Scalar>::ZERO);
    const ONE: Self = Self(<Q1_14 as Scalar>::ONE);

    fn word(word: Q1_14) -> Self {
        Self(word)
    }

    fn times(self, rhs: Self) -> i32 {
        Operations::note(|done| done.multiplications += 1);
        self.0.times(rhs.0)
    }

    fn widen(self) -> i32 {
        Scalar::widen(self.0)
    }

    fn plus(lhs: i32, rhs: i32) -> i32 {
        Operations::note(|done| done.additions += 1);
        <Q1_14 as Scalar>::plus(lhs, rhs)
    }

    fn minus(lhs: i32, rhs: i32) -> i32 {
        Operations::note(|done| done.additions += 1);
        <Q1_14 as Scalar>::minus(lhs, rhs)
    }

    fn round(sum: i32) -> Self {
        Operations::note(|done| done.roundings += 1);
        Self(<Q1_14 as Scalar>::round(sum))
    }

    fn negative(self) -> Self {
        Operations::note(|done| done.negations += 1);
        Self(self.0.negative())
    }

    fn sine(angle: Q1_14) -> Self {
        Operations::note(|done| done.sines += 1);
        Self(<Q1_14 as Scalar>::sine(angle))
    }

    fn cosine(angle: Q1_14) -> Self {
        Operations::note(|done| done.cosines += 1);
        Self(<Q1_14 as Scalar>::cosine(angle))
    }

    fn plus_angle(lhs: Q1_14, rhs: Q1_14) -> Q1_14 {
        Operations::note(|done| done.angle_additions += 1);
        lhs.wrapping_add(rhs)
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
