//! Rounding of sums to words: with saturation, or without it where the range of the result is known.

use super::Number;

/// A way to round sums to words, with saturation or without it.
pub(super) trait Rounding {
    /// Rounds the sum of two products. In each product one factor must be within [-1, 1].
    fn rounded_sum<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N;
    /// Rounds the difference of two products. In each product one factor must be within [-1, 1].
    fn rounded_difference<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N;
    /// Rounds the sum of a number and a product.
    fn add_product<N: Number>(number: N, product: N::WideSum) -> N;
    /// Rounds the difference of a number and a product.
    fn subtract_product<N: Number>(number: N, product: N::WideSum) -> N;
    /// Rounds a number plus the product `more` minus the product `less`.
    fn add_and_subtract<N: Number>(number: N, more: N::WideSum, less: N::WideSum) -> N;
    fn negated<N: Number>(number: N) -> N;
}

/// Rounding with saturation, for sums that may leave the range of a word.
pub(super) enum SaturatingRounding {}

impl Rounding for SaturatingRounding {
    #[inline(always)]
    fn rounded_sum<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N {
        N::rounded_sum(lhs, rhs)
    }

    #[inline(always)]
    fn rounded_difference<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N {
        N::rounded_difference(lhs, rhs)
    }

    #[inline(always)]
    fn add_product<N: Number>(number: N, product: N::WideSum) -> N {
        N::rounded_sum(number.widen(), product)
    }

    #[inline(always)]
    fn subtract_product<N: Number>(number: N, product: N::WideSum) -> N {
        N::rounded_difference(number.widen(), product)
    }

    #[inline(always)]
    fn add_and_subtract<N: Number>(number: N, more: N::WideSum, less: N::WideSum) -> N {
        N::round(N::minus(N::plus(number.widen(), more), less))
    }

    #[inline(always)]
    fn negated<N: Number>(number: N) -> N {
        number.negated()
    }
}

/// Rounding without saturation, for sums that are known to fit a word.
pub(super) enum NonSaturatingRounding {}

impl Rounding for NonSaturatingRounding {
    #[inline(always)]
    fn rounded_sum<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N {
        N::round_bounded(N::bounded_plus(lhs, rhs))
    }

    #[inline(always)]
    fn rounded_difference<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N {
        N::round_bounded(N::bounded_minus(lhs, rhs))
    }

    #[inline(always)]
    fn add_product<N: Number>(number: N, product: N::WideSum) -> N {
        number.bounded_add_product(product)
    }

    #[inline(always)]
    fn subtract_product<N: Number>(number: N, product: N::WideSum) -> N {
        number.bounded_subtract_product(product)
    }

    #[inline(always)]
    fn add_and_subtract<N: Number>(number: N, more: N::WideSum, less: N::WideSum) -> N {
        number.bounded_add_product(N::bounded_minus(more, less))
    }

    #[inline(always)]
    fn negated<N: Number>(number: N) -> N {
        number.bounded_negative()
    }
}
