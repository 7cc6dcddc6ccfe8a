//! Sine and cosine of an angle in quarter turns, with integers only.
//!
//! An angle is a Q1.14 word in quarter turns (paper, Eq. 11), so that 16 bits hold exactly one turn and wrap without
//! further code. The period of the paper's Eq. 12 is 4 of these units, not 2. All products fit 32 bits.
//!
//! | function | order | mean error | max error |
//! |---|---|---|---|
//! | [`sine`], [`cosine`] | 5 and 6, by eighths of a turn | 1.53e-5 | 3.9e-5 |
//! | `seventh_order_sine_cosine` | 7, by quarters | 1.57e-5 | 6.1e-5 |
//! | `paper_sine`, `paper_cosine` | 5, by quarters | 1.9e-4 | 4.4e-4 |
//!
//! The errors are over all 65 536 angles; rounding to Q1.14 alone costs 1.5e-5 in the mean. All functions
//! are exact at 0 and at the quarter turns, exactly odd (or even), and within [-1, 1]. They never panic, and
//! their work is bounded. Cells use the first. Cells of earlier builds used the seventh order; their recordings are
//! replayed with it (feature `earlier-sine`). The paper's is available for comparison (feature `oracle`).

use core::f64::consts::FRAC_PI_2;

use protocol::fixed::Q1_14;

use crate::contact::low_16_bits;

#[cfg(any(feature = "oracle", feature = "earlier-sine"))]
mod odd_polynomial;
#[cfg(feature = "oracle")]
pub(crate) mod paper;
#[cfg(feature = "earlier-sine")]
pub(crate) mod seventh_order;

#[cfg(feature = "oracle")]
pub use paper::{paper_cosine, paper_sine};

/// A quarter turn as a word.
pub(crate) const QUARTER_TURN: Q1_14 = Q1_14::from_bits(1 << 14);

/// Coefficients of z, z^3 and z^5 in the polynomial for the sine of z quarter turns, |z| <= 1/2, with 16 fraction bits.
///
/// They and those of the cosine were found by search: they have the smallest mean error with the truncations of
/// [`sine_cosine`]. `cortex_m0.s` has the same numbers.
const SINE_COEFFICIENTS: [i32; 3] = [102_943, -42_307, 5_063];
/// Coefficients of z^2, z^4 and z^6 for the cosine, with 15 fraction bits.
const COSINE_COEFFICIENTS: [i32; 3] = [-40_420, 8_268, -572];

/// Returns the sine of an angle in quarter turns, in [-1, 1].
///
/// The mean error over all angles is below 1.54e-5, and the maximum below 4e-5.
#[must_use]
pub fn sine(angle: Q1_14) -> Q1_14 {
    let [sine, _] = sine_cosine(angle);
    word_within_one(sine)
}

/// Returns the cosine of an angle in quarter turns: the [`sine`] a quarter turn later (Eq. 19).
#[must_use]
pub fn cosine(angle: Q1_14) -> Q1_14 {
    let [_, cosine] = sine_cosine(angle);
    word_within_one(cosine)
}

/// Converts a sine or cosine in steps of 2^-14 to a word.
fn word_within_one(steps: i32) -> Q1_14 {
    Q1_14::from_bits(low_16_bits(steps))
}

/// Returns [`sine`] and [`cosine`] of one angle in steps of 2^-14.
///
/// The angle is split into the nearest quarter turn and the rest, at most an eighth of a turn, for which short
/// polynomials suffice.
#[inline]
pub(crate) fn sine_cosine(angle: Q1_14) -> [i32; 2] {
    let bits = i32::from(angle.to_bits());
    let z = (bits << 18) >> 18;
    // 17 fraction bits; the one makes up for what truncations take away.
    let square = (product_fitting_i32(z, z) >> 11) + 1;
    let [first, third, fifth] = SINE_COEFFICIENTS;
    let factor = third + (product_fitting_i32(square, fifth) >> 17);
    let factor = first + (product_fitting_i32(square, factor) >> 17);
    let sine = round_shifted::<16>(product_fitting_i32(z, factor));
    let [second, fourth, sixth] = COSINE_COEFFICIENTS;
    let factor = fourth + (product_fitting_i32(square, sixth) >> 17);
    let factor = second + (product_fitting_i32(square, factor) >> 17);
    let cosine = (1 << 14) + round_shifted::<18>(product_fitting_i32(square, factor));
    let nearest = round_shifted::<14>(bits);
    let [sine, cosine] = if nearest & 1 == 0 { [sine, cosine] } else { [cosine, -sine] };
    if nearest & 2 == 0 { [sine, cosine] } else { [-sine, -cosine] }
}

/// Shifts right and rounds to nearest, ties up.
#[inline]
const fn round_shifted<const BITS: u32>(number: i32) -> i32 {
    ((number >> (BITS - 1)) + 1) >> 1
}

/// Folds an angle to a word within [-1, 1] quarter turns with the same sine.
fn fold_angle(angle: Q1_14) -> i32 {
    let z = angle.to_bits();
    let folded = if z.unsigned_abs() <= 1 << 14 { z } else { i16::MIN.wrapping_sub(z) };
    i32::from(folded)
}

/// Returns a product that is known to fit 32 bits. A release build does not check this, because on a small processor
/// the check would take longer than the product.
fn product_fitting_i32(lhs: i32, rhs: i32) -> i32 {
    debug_assert!(lhs.checked_mul(rhs).is_some(), "{lhs} x {rhs} is wider than 32 bits");
    lhs.wrapping_mul(rhs)
}

/// Number of fraction bits of [`precise_sine_cosine`].
pub(crate) const PRECISE_SINE_FRACTION_BITS: u32 = 28;

/// Returns sine and cosine with 28 fraction bits, for constants that are computed once. They are exact at the quarter
/// turns; elsewhere the error is at most 1e-8.
pub(crate) fn precise_sine_cosine(angle: Q1_14) -> [i64; 2] {
    [angle, angle.wrapping_add(QUARTER_TURN)].map(|angle| {
        let z = i64::from(fold_angle(angle));
        let factor = SINE_TAYLOR_COEFFICIENTS
            .into_iter()
            .rev()
            .reduce(|sum, c| c + ((z * z * sum) >> 28))
            .unwrap_or(0);
        let product = z * factor; // 14 + 32 fraction bits
        (product + (1 << 17)) >> 18
    })
}

/// Coefficients of the power series for the sine of a quarter turn, with 32 fraction bits: (pi/2)^n / n!, n = 1, 3, 5
/// ... 15.
#[expect(clippy::cast_possible_truncation, reason = "all below 2^33")]
const SINE_TAYLOR_COEFFICIENTS: [i64; 8] = {
    let mut series = [0; 8];
    let (mut term, mut n) = (FRAC_PI_2, 1.0);
    let mut rest: &mut [i64] = &mut series;
    while let [first, others @ ..] = rest {
        *first = (term * (1_i64 << 32) as f64) as i64;
        term *= -FRAC_PI_2 * FRAC_PI_2 / ((n + 1.0) * (n + 2.0));
        n += 2.0;
        rest = others;
    }
    series
};

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Accumulator;

    /// Returns the mean and maximum error over all angles.
    fn errors(function: impl Fn(Q1_14) -> f64, oracle: impl Fn(f64) -> f64) -> (f64, f64) {
        let mut sum = 0.0;
        let mut max = 0.0_f64;
        for bits in i16::MIN..=i16::MAX {
            let angle = Q1_14::from_bits(bits);
            let error = (function(angle) - oracle(angle.to_radians())).abs();
            sum += error;
            max = max.max(error);
        }
        (sum / 65_536.0, max)
    }

    fn earlier(angle: Q1_14) -> Q1_14 {
        let [sine, _] = seventh_order::seventh_order_sine_cosine(angle);
        word_within_one(sine)
    }

    #[test]
    fn the_errors_over_all_angles_are_within_what_the_table_says() {
        for (name, (mean, max), bars) in [
            ("sine", errors(|z| sine(z).to_f64(), f64::sin), (1.54e-5, 4e-5)),
            ("cosine", errors(|z| cosine(z).to_f64(), f64::cos), (1.54e-5, 4e-5)),
            ("earlier sine", errors(|z| earlier(z).to_f64(), f64::sin), (1.6e-5, 6.2e-5)),
            ("paper's sine", errors(|z| paper_sine(z).to_f64(), f64::sin), (1.9e-4, 4.4e-4)),
            ("paper's cosine", errors(|z| paper_cosine(z).to_f64(), f64::cos), (1.9e-4, 4.4e-4)),
        ] {
            println!("{name}: mean {mean:.3e}, max {max:.3e}");
            assert!(mean <= bars.0 && max <= bars.1, "{name}: mean {mean:e}, max {max:e}");
        }
    }

    #[test]
    fn rounding_alone_costs_what_the_table_says() {
        let (mean, _) = errors(|z| Q1_14::nearest(z.to_radians().sin()).to_f64(), f64::sin);
        assert!((1.4e-5..1.55e-5).contains(&mean), "{mean:e}");
    }

    #[test]
    fn a_cosine_is_the_sine_a_quarter_turn_later() {
        for bits in i16::MIN..=i16::MAX {
            let angle = Q1_14::from_bits(bits);
            let later = angle.wrapping_add(QUARTER_TURN);
            assert_eq!(cosine(angle), sine(later), "at {bits}");
            assert_eq!(paper_cosine(angle), paper_sine(later), "at {bits}");
        }
    }

    #[test]
    fn the_quarter_turns_are_exact() {
        for function in [sine, paper_sine] {
            for (angle, target) in [(0, 0), (1 << 14, 1 << 14), (-1 << 14, -1 << 14), (i16::MIN, 0)] {
                assert_eq!(function(Q1_14::from_bits(angle)).to_bits(), target, "at {angle}");
            }
        }
        for function in [cosine, paper_cosine] {
            for (angle, target) in [(0, 1 << 14), (1 << 14, 0), (-1 << 14, 0), (i16::MIN, -1 << 14)] {
                assert_eq!(function(Q1_14::from_bits(angle)).to_bits(), target, "at {angle}");
            }
        }
    }

    #[test]
    fn the_symmetries_hold_at_every_angle() {
        for (sine, cosine) in [
            (sine as fn(Q1_14) -> Q1_14, cosine as fn(Q1_14) -> Q1_14),
            (paper_sine as fn(Q1_14) -> Q1_14, paper_cosine as fn(Q1_14) -> Q1_14),
        ] {
            for bits in i16::MIN..=i16::MAX {
                let (angle, opposite) = (Q1_14::from_bits(bits), Q1_14::from_bits(bits.wrapping_neg()));
                let half_a_turn_on = angle.wrapping_add(Q1_14::MIN);
                assert_eq!(sine(opposite).to_bits(), -sine(angle).to_bits(), "sine is odd at {bits}");
                assert_eq!(sine(half_a_turn_on).to_bits(), -sine(angle).to_bits(), "half a turn from {bits}");
                assert_eq!(cosine(opposite), cosine(angle), "cosine is even at {bits}");
                assert!(sine(angle).to_bits().abs() <= 1 << 14, "within 1 at {bits}");
            }
        }
    }

    #[test]
    fn the_fine_ones_are_exact_at_quarter_turns_and_fine_between() {
        let one = 1 << PRECISE_SINE_FRACTION_BITS;
        for (angle, target) in
            [(0, [0, one]), (1 << 14, [one, 0]), (-1 << 14, [-one, 0]), (i16::MIN, [0, -one])]
        {
            assert_eq!(precise_sine_cosine(Q1_14::from_bits(angle)), target, "at {angle}");
        }
        let real = |fine: i64| Accumulator::<PRECISE_SINE_FRACTION_BITS>::from_steps(fine).to_f64();
        for (index, oracle) in [f64::sin, f64::cos].into_iter().enumerate() {
            let (_, max) = errors(|z| real(precise_sine_cosine(z)[index]), oracle);
            assert!(max <= 1e-8, "{max:e}");
        }
    }
}
