//! References for comparison with the cell's kernel: the paper's method and sine, real numbers, and operation counts.
//!
//! Cells are built without this module (feature `oracle`). [`Projection`] computes the same Jacobian as
//! [`Wrench`] with the paper's method: it carries the frames from the base up to the cell (Eq. 20 to 25).
//!
//! | UR5, cell on the last link | mul | add | sin | cos | mean torque error | max |
//! |---|---|---|---|---|---|---|
//! | [`Wrench`] | 40 | 24 | 5 | 5 | 1.2e-4 Nm | 1.5e-3 Nm |
//! | [`Projection`] | 103 | 56 | 6 | 6 | 1.4e-4 Nm | 1.5e-3 Nm |
//! | the paper (Eq. 27) | 103 | 57 | 6 | 6 | 5.4e-3 Nm | |
//!
//! The operations are counted by running the code with the number type `Counted`. Real numbers, `f64`, have
//! no rounding and use the library's sine. Both also need the feature `std`. The errors, of Q3.12 words
//! against Eq. 8 in double precision, are bounds over 300 poses with up to 6 N. `cargo run -p cell-node
//! --example kernels` prints the measured values.
//!
//! [`Wrench`]: super::Wrench

#[cfg(feature = "std")]
mod numbers;
mod projection;

#[cfg(feature = "std")]
pub use numbers::CountingWord;
pub use projection::Projection;

use protocol::fixed::Q1_14;

use super::Word;
use crate::sine::paper::paper_sine_cosine;

/// A Q1.14 word, as on the cell, but with the paper's fifth-order sine (Eq. 17 to 19).
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct PaperWord(pub Q1_14);

impl Word for PaperWord {
    fn from_word(word: Q1_14) -> Self {
        Self(word)
    }

    fn to_word(self) -> Q1_14 {
        self.0
    }

    fn sine_cosine(angle: Q1_14) -> [i32; 2] {
        paper_sine_cosine(angle)
    }
}
