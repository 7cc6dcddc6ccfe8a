//! How sums become words: held at the ends of their range, or known to be within it.

use super::Number;

/// How sums become words.
pub(super) trait Rounding {
    /// The sum of two products, in each of which one factor is within 1.
    fn sum<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N;
    /// The difference of the same.
    fn difference<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N;
    /// A number and a product.
    fn more<N: Number>(number: N, product: N::Wide) -> N;
    /// A number less a product.
    fn less<N: Number>(number: N, product: N::Wide) -> N;
    /// A number and a product, less another one.
    fn more_and_less<N: Number>(number: N, more: N::Wide, less: N::Wide) -> N;
    /// The negative.
    fn negative<N: Number>(number: N) -> N;
}

/// What does not fit is held at the ends of the range.
pub(super) enum Held {}

impl Rounding for Held {
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

/// All fits.
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
