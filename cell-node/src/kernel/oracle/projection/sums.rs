//! Rounding of sums with more than two products.

use crate::kernel::Number;
use crate::kernel::rounding::{NonSaturatingRounding, Rounding, SaturatingRounding};

/// Roundings of sums that only the projection kernel needs, with saturation or without.
pub(super) trait VectorSums: Rounding {
    /// Adds two products to a number, and rounds the result.
    fn add_products<N: Number>(number: N, first: N::WideSum, second: N::WideSum) -> N;
    /// Adds two products without rounding.
    fn plus<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N::WideSum;
    /// Rounds a sum to a number.
    fn round<N: Number>(sum: N::WideSum) -> N;
}

impl VectorSums for SaturatingRounding {
    #[inline(always)]
    fn add_products<N: Number>(number: N, first: N::WideSum, second: N::WideSum) -> N {
        N::round(N::plus(N::plus(number.widen(), first), second))
    }

    #[inline(always)]
    fn plus<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N::WideSum {
        N::plus(lhs, rhs)
    }

    #[inline(always)]
    fn round<N: Number>(sum: N::WideSum) -> N {
        N::round(sum)
    }
}

impl VectorSums for NonSaturatingRounding {
    #[inline(always)]
    fn add_products<N: Number>(number: N, first: N::WideSum, second: N::WideSum) -> N {
        number.bounded_add_product(N::bounded_plus(first, second))
    }

    #[inline(always)]
    fn plus<N: Number>(lhs: N::WideSum, rhs: N::WideSum) -> N::WideSum {
        N::bounded_plus(lhs, rhs)
    }

    #[inline(always)]
    fn round<N: Number>(sum: N::WideSum) -> N {
        N::round_bounded(sum)
    }
}
