//! The range of a word: what a wrench can become on its way, and how sums become words.

use protocol::parameters::Row;

use super::Wrenched;
use crate::kernel::Number;

/// Whether a wrench stays within the range of a word on its way down these rows, wherever the joints are.
///
/// In steps of 2^-14, with |f| and |m| at most F and M: a twist or a turn by words for sine and cosine, each at most 5e-4
/// off, makes a vector longer by a factor of at most 1 + 2^-10, and rounding its components by less than one step; a shift
/// adds at most |(a, d)| F to M, and its rounding less than one step.
pub(super) fn is_bounded<N: Number>(contact: &Wrenched<N>, rows: &[Row]) -> bool {
    let (Some(mut force), Some(mut moment)) = (N::norm(contact.force), N::norm(contact.moment)) else {
        return false;
    };
    let turned = |norm: u32| norm + (norm >> 10) + 2;
    for row in rows.iter().rev() {
        let reach = N::norm([N::word(row.a), N::word(row.d), N::zero()]).unwrap_or(u32::MAX);
        (force, moment) = (turned(force), turned(moment));
        if force >= 1 << 15 || reach > 1 << 16 {
            return false;
        }
        moment += ((reach * force) >> 14) + 3;
        (force, moment) = (turned(force), turned(moment));
        if moment >= (1 << 15) - 1 {
            return false;
        }
    }
    true
}

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
