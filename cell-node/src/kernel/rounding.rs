//! Rounding of sums to words: with saturation, or without it where the range of the result is known.

use super::Number;

/// A way to round sums to words, with saturation or without it.
pub(super) trait Rounding {
    /// Rounds the sum of two products. In each product one factor must be within [-1, 1].
    fn sum<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N;
    /// Rounds the difference of two products. In each product one factor must be within [-1, 1].
    fn difference<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N;
    /// Rounds the sum of a number and a product.
    fn more<N: Number>(number: N, product: N::Wide) -> N;
    /// Rounds the difference of a number and a product.
    fn less<N: Number>(number: N, product: N::Wide) -> N;
    /// Rounds a number plus the product `more` minus the product `less`.
    fn more_and_less<N: Number>(number: N, more: N::Wide, less: N::Wide) -> N;
    /// Negates a number.
    fn negative<N: Number>(number: N) -> N;
}

/// Rounding with saturation, for sums that may leave the range of a word.
pub(super) enum Saturating {}

impl Rounding for Saturating {
    #[inline(always)]
    fn sum<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N {
        N::rounded_sum(lhs, rhs)
    }

    #[inline(always)]
    fn difference<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N {
        N::rounded_difference(lhs, rhs)
    }

    #[inline(always)]
    fn more<N: Number>(number: N, product: N::Wide) -> N {
        N::rounded_sum(number.widen(), product)
    }

    #[inline(always)]
    fn less<N: Number>(number: N, product: N::Wide) -> N {
        N::rounded_difference(number.widen(), product)
    }

    #[inline(always)]
    fn more_and_less<N: Number>(number: N, more: N::Wide, less: N::Wide) -> N {
        N::round(N::minus(N::plus(number.widen(), more), less))
    }

    #[inline(always)]
    fn negative<N: Number>(number: N) -> N {
        number.negative()
    }
}

/// Rounding without saturation, for sums that are known to fit a word.
pub(super) enum Bounded {}

impl Rounding for Bounded {
    #[inline(always)]
    fn sum<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N {
        N::bounded(N::bounded_plus(lhs, rhs))
    }

    #[inline(always)]
    fn difference<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N {
        N::bounded(N::bounded_minus(lhs, rhs))
    }

    #[inline(always)]
    fn more<N: Number>(number: N, product: N::Wide) -> N {
        number.bounded_more(product)
    }

    #[inline(always)]
    fn less<N: Number>(number: N, product: N::Wide) -> N {
        number.bounded_less(product)
    }

    #[inline(always)]
    fn more_and_less<N: Number>(number: N, more: N::Wide, less: N::Wide) -> N {
        number.bounded_more(N::bounded_minus(more, less))
    }

    #[inline(always)]
    fn negative<N: Number>(number: N) -> N {
        number.bounded_negative()
    }
}
