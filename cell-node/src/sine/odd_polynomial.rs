//! Odd polynomials for the sine of up to one quarter turn, as the paper has them.
//!
//! A polynomial is evaluated on [-1, 1] and continued by `sin(z) = sin(2 - z)` (Eq. 18), which with words that wrap also
//! holds below -1.

use protocol::fixed::Q1_14;

use super::product_fitting_i32;

/// The number one, with the 16 fraction bits of the polynomials.
pub(super) const ONE_Q16: i32 = 1 << 16;

/// Returns sine and cosine in steps of 2^-14, computed with an odd polynomial whose coefficients add up to one. The
/// angle is folded to |z| within one quarter turn. |sin z| is the polynomial of |z|, and |cos z| is the polynomial of
/// 1 - |z|. Intermediate results can be negative only because coefficients are.
#[inline]
pub(super) fn evaluate_sine_cosine<const TERMS: usize>(angle: Q1_14, coefficients: [i32; TERMS]) -> [i32; 2] {
    let quarter = 1 << 14;
    let z = i32::from(angle.to_bits());
    let negative = z >> 31;
    let left = quarter - ((z ^ negative) - negative); // of the first quarter; below zero in the second
    let beyond = left >> 31;
    let left_over = (left ^ beyond) - beyond;
    let folded = quarter - left_over;
    let squares =
        [product_fitting_i32(folded, folded) >> 13, product_fitting_i32(left_over, left_over) >> 13];
    let horner = |[s, c]: [i32; 2], [coefficient, _]: [i32; 2]| {
        [
            coefficient + (product_fitting_i32(squares[0], s) >> 15),
            coefficient + (product_fitting_i32(squares[1], c) >> 15),
        ]
    };
    let factors = coefficients.map(|it| [it, it]).into_iter().rev().reduce(horner).unwrap_or([0; 2]);
    // Rounded, ties away from zero, because the sign is applied later.
    let sine = ((product_fitting_i32(folded, factors[0]) >> 15) + 1) >> 1;
    let cosine = ((product_fitting_i32(left_over, factors[1]) >> 15) + 1) >> 1;
    [(sine ^ negative) - negative, (cosine ^ beyond) - beyond]
}
