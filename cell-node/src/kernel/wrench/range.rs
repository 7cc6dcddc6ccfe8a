//! The range of a word: what a wrench can become on its way.

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
    }
    u16::try_from(moment).ok().filter(|bound| *bound < MAX_J - 1 && force < 1 << 15)
}
