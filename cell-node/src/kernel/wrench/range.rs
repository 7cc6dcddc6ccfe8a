//! The range of a word: what a wrench can become on its way, and how sums become words.

use protocol::parameters::Row;

use super::Wrenched;
use crate::contact::MAX_J;
use crate::kernel::Number;

/// What no moment of a wrench is beyond on its way down these rows, in steps of 2^-14, wherever the joints are; none if
/// that or a force may be more than a word can be. The wrench is turned by the joint above them first.
///
/// With |f| and |m| at most F and M: a twist or a turn by words for sine and cosine, each at most 5e-4 off, makes a vector
/// longer by a factor of at most 1 + 2^-10, and rounding its components by less than one step; a shift adds at most
/// |(a, d)| F to M, and its rounding less than one step.
pub(super) fn bound<N: Number>(contact: &Wrenched<N>, rows: &[Row]) -> Option<u16> {
    let turned = |norm: u32| norm + (norm >> 10) + 2;
    let (mut force, mut moment) = (turned(N::norm(contact.force)?), turned(N::norm(contact.moment)?));
    for row in rows.iter().rev() {
        let reach = N::norm([N::word(row.a), N::word(row.d), N::zero()])?;
        (force, moment) = (turned(force), turned(moment));
        if force >= 1 << 15 || reach > 1 << 16 {
            return None;
        }
        moment += ((reach * force) >> 14) + 3;
        (force, moment) = (turned(force), turned(moment));
        if moment >= (1 << 15) - 1 {
            return None;
        }
    }
    u16::try_from(moment).ok().filter(|bound| *bound < MAX_J - 1 && force < 1 << 15)
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
