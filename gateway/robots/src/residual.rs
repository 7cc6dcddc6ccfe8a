//! Comparison of the rows' kinematics with the URDF's.

use core::f64::consts::TAU;

use nalgebra::Isometry3;

use crate::chain::UrdfChain;
use crate::chain::{CarriedLink, frames_after_joints};
use crate::urdf::UrdfJoint;
use protocol::skin::JointKind;

/// Number of random joint positions in the comparison, in addition to zero and the limits.
const RANDOM_POSITIONS: usize = 64;

/// The largest difference between rows and URDF, and the link at which it occurs.
#[derive(Clone, Debug, Default)]
pub(crate) struct LargestResidual {
    /// The difference in m or rad.
    pub(crate) residual: f64,
    /// Name of the link.
    pub(crate) link: String,
}

/// Compares the frames of all links that move with the chain, computed from the rows and from the URDF.
pub(crate) fn largest_residual(
    chain: &UrdfChain,
    path: &[&UrdfJoint],
    hanging: &[CarriedLink],
) -> LargestResidual {
    let mut worst = LargestResidual::default();
    for positions in test_positions(chain) {
        let frames = chain.frames(&positions);
        let behind = frames_after_joints(path, &positions);
        for (CarriedLink { link, joint, fixed }, (_, found)) in hanging.iter().zip(chain.links()) {
            let urdf = joint.checked_sub(1).and_then(|index| behind.get(index)).map(|pose| pose * fixed);
            let rows = frames.get(found.row).map(|frame| frame * found.frame);
            let residual =
                urdf.zip(rows).map_or(f64::INFINITY, |(urdf, rows)| frame_difference(&urdf, &rows));
            // NaN counts as the largest difference.
            if residual.is_nan() || residual > worst.residual {
                worst = LargestResidual { residual, link: link.clone() };
            }
        }
    }
    worst
}

/// Returns the difference between two frames: the greater of the distance in m and the angle in rad.
pub(crate) fn frame_difference(one: &Isometry3<f64>, other: &Isometry3<f64>) -> f64 {
    let turn = one.rotation.rotation_to(&other.rotation);
    // The cosine of a small angle would lose its digits.
    let angle = 2.0 * turn.imag().norm().atan2(turn.scalar().abs());
    (one.translation.vector - other.translation.vector).norm().max(angle)
}

/// Returns sets of joint positions: zero, the limits, and random positions between them that are the same in every run.
fn test_positions(chain: &UrdfChain) -> Vec<Vec<f64>> {
    let limits = chain.joints.iter().map(|joint| match joint.kind {
        JointKind::Revolute => joint.limits.map(|limit| limit.clamp(-TAU, TAU)),
        JointKind::Prismatic => joint.limits,
    });
    let limits: Vec<_> = limits.collect();
    let mut all = vec![
        vec![0.0; limits.len()],
        limits.iter().map(|[lower, _]| *lower).collect(),
        limits.iter().map(|[_, upper]| *upper).collect(),
    ];
    let mut state = 1_u64;
    let mut uniform = |[lower, upper]: &[f64; 2]| {
        // Knuth's linear congruential generator; the upper 32 bits are used.
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let high = u32::try_from(state >> 32).unwrap_or_default();
        lower + (upper - lower) * f64::from(high) / f64::from(u32::MAX)
    };
    all.extend((0..RANDOM_POSITIONS).map(|_| limits.iter().map(&mut uniform).collect()));
    all
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};

    use super::frame_difference;

    #[test]
    fn a_small_angle_is_not_lost() {
        for angle in [1e-3, 1e-8, 1e-12] {
            let turned = Isometry3::rotation(Vector3::new(0.0, angle, 0.0));
            let found = frame_difference(&Isometry3::identity(), &turned);
            assert!((found - angle).abs() < 1e-15, "{angle}: {found}");
        }
        assert!(frame_difference(&Isometry3::identity(), &Isometry3::translation(3.0, 4.0, 0.0)) > 4.9);
    }
}
