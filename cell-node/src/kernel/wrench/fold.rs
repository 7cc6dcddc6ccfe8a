//! The part of the wrench computation that is constant, computed once per configuration.

use core::ops::{Add, Mul, Neg, Sub};

use protocol::parameters::{Pose, Row};

use super::{Number, PerComponent};

/// Returns the wrench of the contact, twisted and shifted by joint k's row, and rounded once.
pub(super) fn constant_wrench<N: Number>(pose: &Pose, row: &Row) -> PerComponent<N> {
    let (force, moment) = exact_constant_wrench(
        pose.normal.map(N::unrounded_from_word),
        pose.position.map(N::unrounded_from_word),
        N::unrounded_sine_cosine_one(row.alpha),
        (N::unrounded_from_word(row.a), N::unrounded_from_word(row.d)),
    );
    // 14 fraction bits of a word and 28 of the twist; for the moment 14 more of a length.
    PerComponent { force: force.map(N::round_constant::<42>), moment: moment.map(N::round_constant::<56>) }
}

/// Returns the same wrench before rounding. With words of 16 bits, no intermediate number exceeds 2^61.
fn exact_constant_wrench<N: Copy + Add<Output = N> + Sub<Output = N> + Mul<Output = N> + Neg<Output = N>>(
    [nx, ny, nz]: [N; 3],
    [tx, ty, tz]: [N; 3],
    [sine, cosine, one]: [N; 3],
    (a, d): (N, N),
) -> ([N; 3], [N; 3]) {
    let twist = |[x, y, z]: [N; 3]| [one * x, cosine * y - sine * z, sine * y + cosine * z];
    // The force pushes against the normal.
    let [fx, fy, fz] = twist([-nx, -ny, -nz]);
    // t x f = n x t.
    let [mx, my, mz] = twist([ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx]);
    ([fx, fy, fz], [mx - d * fy, my + d * fx - a * fz, mz + a * fy])
}
