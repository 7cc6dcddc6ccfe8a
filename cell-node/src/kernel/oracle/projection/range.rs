//! Bounds for the projection kernel: the ranges of axes, force, position and moments.

use super::{ChainLink, Vector};
use crate::kernel::Number;

/// Returns true if no number can leave the range of a word between the cell and the base, for any joint
/// positions.
///
/// The three axes are those of an exact rotation plus an error of nine components, whose norm is the root of
/// the sum of their squares. A turn or a twist with words for sine and cosine, each at most 5e-4 off,
/// increases that norm by a factor of at most 1 + 2^-10 and adds at most 17 steps of 2^-14; rounding six
/// components adds less than two. Multiplying a vector by the axes, or by an axis, increases its length by at
/// most that norm times itself; and no component of an axis exceeds 1 plus that norm. For 32 rows this is
/// still below 1.1.
pub(super) fn stays_in_word_range<N: Number>(
    force: Vector<N>,
    position: Vector<N>,
    links: &[ChainLink<N>],
) -> bool {
    let off = links.iter().fold(0, |off, _| error_after_rotation(error_after_rotation(off)));
    let axes = (1 << 14) + off;
    // Rounding adds less than one step to a vector, and so does this division.
    let along = |norm: u32| ((axes * norm) >> 14) + 2;
    let within = |number: &u32| *number < (1 << 15) - 1;
    let (Some(force), Some(mut reach)) =
        (N::norm_upper_bound(force).map(along), N::norm_upper_bound(position).map(along))
    else {
        return false;
    };
    for link in links {
        let Some(length) = N::norm_upper_bound([N::from_word(link.a), N::from_word(link.d), N::zero()])
        else {
            return false;
        };
        reach += along(length);
        if !within(&reach) {
            return false;
        }
    }
    let moment = along(reach);
    let most = ((force.min(1 << 15) * moment.min(1 << 16)) >> 14) + 2;
    [force, reach, moment, most].iter().all(within)
}

/// Returns the bound of the axes' error after one more rotation, given the bound before it.
fn error_after_rotation(off: u32) -> u32 {
    off + (off >> 10) + 20
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use protocol::fixed::Q1_14;
    use protocol::parameters::{MAX_JOINTS, MAX_ROWS, Parameters, Pose, Row, RowKind};

    use crate::kernel::oracle::{CountingWord, Projection};
    use crate::kernel::{Kernel, Operations};

    /// Returns an arm with `rows` rows. Quarter turns and zeros are more frequent than by chance, and some rows are
    /// fixed.
    fn arm(rows: usize, words: &[i16]) -> Parameters {
        let mut words = words.iter().copied().cycle();
        let mut next = || words.next().unwrap_or_default();
        let mut short = |by: i16| if next() & 1 == 0 { Q1_14::ZERO } else { Q1_14::from_bits(next() / by) };
        let mut parameters = Parameters::default();
        let by = 2 * i16::try_from(rows).unwrap();
        for row in parameters.rows.iter_mut().take(rows) {
            let [a, d, theta_offset, turns] = [short(by), short(by), short(1), short(1)];
            let kind = if turns.to_bits() % 5 == 1 { RowKind::Fixed } else { RowKind::Revolute };
            let quarter = Q1_14::from_bits(turns.to_bits() << 14);
            let alpha = if turns.to_bits() & 0x30 == 0 { turns } else { quarter };
            *row = Row { a, d, alpha, theta_offset, kind };
        }
        let position = [short(8), short(8), short(8)];
        let normal = [short(2), short(2), short(2)];
        let pose = Pose { position, normal };
        let joint = parameters.rows.iter().take(rows).filter(|row| row.has_joint()).count();
        let [joint, row] = [joint, rows].map(|number| u8::try_from(number).unwrap());
        Parameters { joint, joints: joint, row, table_rows: row, pose, ..parameters }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 4_096, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn what_is_bounded_is_what_is_held(
            rows in prop_oneof![1..=7_usize, 1..=MAX_ROWS], words: [i16; 29], joints: [i16; MAX_JOINTS],
        ) {
            let joints = joints.map(Q1_14::from_bits);
            let kernel = Projection::<CountingWord>::new(&arm(rows, &words));
            let held = Projection { bounded: false, ..kernel };
            prop_assert_eq!(
                Operations::count_operations(|| kernel.jacobian(&joints)),
                Operations::count_operations(|| held.jacobian(&joints))
            );
        }
    }

    #[test]
    fn an_arm_of_a_metre_and_a_half_is_bounded_and_one_of_two_is_not() {
        let arm = |length: f64, normal: f64| {
            let [zero, normal] = [0.0, normal].map(Q1_14::nearest);
            let row = Row { a: Q1_14::nearest(length / 6.0), alpha: Q1_14::nearest(0.3), ..Row::default() };
            let pose = Pose { position: [zero; 3], normal: [zero, zero, normal] };
            Parameters { joint: 6, joints: 6, pose, rows: [row; MAX_ROWS], ..Parameters::default() }
        };
        let is_bounded = |length, normal| Projection::<Q1_14>::new(&arm(length, normal)).bounded;
        assert!(is_bounded(1.5, 1.0) && is_bounded(1.9, 1.0));
        assert!(!is_bounded(2.0, 1.0) && !is_bounded(1.5, 1.9));
        // The turns of six rows may lengthen position, axis and force by 1.5 % each.
        assert!(!is_bounded(1.95, 1.0));
        let mut slides = arm(0.5, 1.0);
        slides.rows[3].kind = RowKind::Prismatic;
        assert!(!Projection::<Q1_14>::new(&slides).bounded);
    }
}
