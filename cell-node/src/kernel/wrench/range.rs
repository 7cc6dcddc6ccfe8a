//! Bounds for the wrench kernel: the ranges of force and moment at all rows down to the base.

use protocol::parameters::Row;

use super::PerComponent;
use crate::contact::MAX_JACOBIAN_STEPS;
use crate::kernel::Number;

/// Returns an upper bound of the moments of a wrench at all of these rows, in steps of 2^-14, for any joint positions.
/// Returns `None` if a moment or force may exceed the range of a word. The joint above the rows turns the wrench first.
///
/// The bound is computed from F and M, the maxima of |f| and |m|. A twist or a turn with words for sine and cosine,
/// each at most 5e-4 off, lengthens a vector by a factor of at most 1 + 2^-10, and rounding its components adds less
/// than one step. A shift adds at most |(a, d)| F to M, and its rounding adds less than one step.
pub(super) fn moment_bound<N: Number>(contact: &PerComponent<N>, rows: &[Row]) -> Option<u16> {
    let turned = |norm: u32| norm + (norm >> 10) + 2;
    let (mut force, mut moment) =
        (turned(N::norm_upper_bound(contact.force)?), turned(N::norm_upper_bound(contact.moment)?));
    for row in rows.iter().rev() {
        let reach = N::norm_upper_bound([N::from_word(row.a), N::from_word(row.d), N::zero()])?;
        (force, moment) = (turned(force), turned(moment));
        if force >= 1 << 15 || reach > 1 << 16 {
            return None;
        }
        moment += ((reach * force) >> 14) + 3;
        (force, moment) = (turned(force), turned(moment));
    }
    u16::try_from(moment).ok().filter(|bound| *bound < MAX_JACOBIAN_STEPS - 1 && force < 1 << 15)
}
