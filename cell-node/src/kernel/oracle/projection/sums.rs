//! Rounding of sums with more than two products.

use crate::kernel::Number;
use crate::kernel::rounding::{Bounded, Rounding, Saturating};

/// Roundings of sums that only the projection kernel needs, with saturation or without.
pub(super) trait VectorSums: Rounding {
    /// Adds two products to a number, and rounds the result.
    fn more_and_more<N: Number>(number: N, first: N::Wide, second: N::Wide) -> N;
    /// Adds two products without rounding.
    fn plus<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N::Wide;
    /// Rounds a sum to a number.
    fn round<N: Number>(sum: N::Wide) -> N;
}

impl VectorSums for Saturating {
    #[inline(always)]
    fn more_and_more<N: Number>(number: N, first: N::Wide, second: N::Wide) -> N {
        N::round(N::plus(N::plus(number.widen(), first), second))
    }

    #[inline(always)]
    fn plus<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N::Wide {
        N::plus(lhs, rhs)
    }

    #[inline(always)]
    fn round<N: Number>(sum: N::Wide) -> N {
        N::round(sum)
    }
}

impl VectorSums for Bounded {
    #[inline(always)]
    fn more_and_more<N: Number>(number: N, first: N::Wide, second: N::Wide) -> N {
        number.bounded_more(N::bounded_plus(first, second))
    }

    #[inline(always)]
    fn plus<N: Number>(lhs: N::Wide, rhs: N::Wide) -> N::Wide {
        N::bounded_plus(lhs, rhs)
    }

    #[inline(always)]
    fn round<N: Number>(sum: N::Wide) -> N {
        N::bounded(sum)
    }
}
