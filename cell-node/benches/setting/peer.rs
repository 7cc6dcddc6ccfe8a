//! The Jacobian for comparison in benches, computed with a matrix library in any real number type.

use nalgebra::{IsometryMatrix3, Point3, RealField, Rotation3, Translation3, Vector3, convert};
use protocol::fixed::Q1_14;
use protocol::parameters::{MAX_JOINTS, Parameters, Row};

/// The Jacobian of one cell by Eq. 8. The frames are multiplied from the base to the cell, without optimisations.
#[derive(Debug)]
pub(crate) struct NalgebraKernel<T: RealField> {
    /// The constant part of each link's transform.
    fixed: Vec<IsometryMatrix3<T>>,
    position: Point3<T>,
    force: Vector3<T>,
}

impl<T: RealField + Copy> NalgebraKernel<T> {
    /// Creates the computation for a force of one newton against the normal of the cell.
    pub(crate) fn new(parameters: &Parameters) -> Self {
        let number = |word: Q1_14| convert::<f64, T>(word.to_f64());
        let link = |row: &Row| {
            let twist = Rotation3::from_axis_angle(&Vector3::x_axis(), convert(row.alpha.to_radians()));
            Translation3::new(number(row.a), T::zero(), number(row.d)) * twist
        };
        Self {
            fixed: parameters.rows.iter().take(usize::from(parameters.joint)).map(link).collect(),
            position: Point3::from(parameters.pose.position.map(number)),
            force: -Vector3::from(parameters.pose.normal.map(number)),
        }
    }

    /// Returns J_l in m for each joint l, at joint angles in rad.
    pub(crate) fn jacobian(&self, joints: &[T; MAX_JOINTS]) -> [T; MAX_JOINTS] {
        let mut frames = [IsometryMatrix3::identity(); MAX_JOINTS];
        let mut tip = IsometryMatrix3::identity();
        for ((frame, fixed), &angle) in frames.iter_mut().zip(&self.fixed).zip(joints) {
            *frame = tip;
            tip = tip * Rotation3::from_axis_angle(&Vector3::z_axis(), angle) * fixed;
        }
        let position = tip * self.position;
        let force = tip.rotation * self.force;
        let mut jacobian = [T::zero(); MAX_JOINTS];
        for (row, below) in jacobian.iter_mut().zip(frames.iter().take(self.fixed.len())) {
            let axis = below.rotation.matrix().column(2);
            *row = axis.cross(&(position.coords - below.translation.vector)).dot(&force);
        }
        jacobian
    }
}
