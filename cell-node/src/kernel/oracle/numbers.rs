//! Number types for kernels: real numbers, and words that count their operations.

use std::cell::Cell;

use protocol::fixed::Q1_14;

use crate::kernel::{Number, Operations, Scalar, Word};

impl Scalar for f64 {
    type Number = Self;

    fn from_number(number: Self) -> Self {
        number
    }
}

/// Real numbers as reference: the library's sine and cosine, and no rounding to words.
impl Number for f64 {
    type WideSum = Self;
    type UnroundedConstant = Self;

    fn from_word(word: Q1_14) -> Self {
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

    fn negated(self) -> Self {
        -self
    }

    fn norm_upper_bound(_: [Self; 3]) -> Option<u32> {
        None
    }

    fn sine_cosine(angle: Q1_14) -> [Self; 2] {
        [angle.to_radians().sin(), angle.to_radians().cos()]
    }

    fn unrounded_from_word(word: Q1_14) -> Self {
        word.to_f64()
    }

    fn unrounded_sine_cosine_one(angle: Q1_14) -> [Self; 3] {
        [angle.to_radians().sin(), angle.to_radians().cos(), 1.0]
    }

    fn round_constant<const F: u32>(constant: Self) -> Self {
        constant
    }
}

std::thread_local! {
    static OPERATIONS: Cell<Operations> = Cell::default();
}

impl Operations {
    /// Runs a computation on [`CountingWord`] numbers and returns its operation count.
    pub fn count_operations<T>(computation: impl FnOnce() -> T) -> (T, Self) {
        OPERATIONS.set(Self::default());
        let result = computation();
        (result, OPERATIONS.take())
    }
}

/// A Q1.14 word whose operations [`Operations::count_operations`] counts.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct CountingWord(pub Q1_14);

impl Word for CountingWord {
    fn from_word(word: Q1_14) -> Self {
        Self(word)
    }

    fn to_word(self) -> Q1_14 {
        self.0
    }

    fn record_operation(operation: impl FnOnce(&mut Operations)) {
        let mut done = OPERATIONS.get();
        operation(&mut done);
        OPERATIONS.set(done);
    }
}
