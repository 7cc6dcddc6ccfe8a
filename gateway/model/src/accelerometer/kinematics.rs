//! The specific force at a cell, which its accelerometer measures, while the joints move.
//!
//! A row of the chain carries its cells rigidly. With the acceleration `a` of the row's origin, its angular velocity
//! `w` and angular acceleration `w'`, a cell at `p` in the frame of the row measures, in that frame,
//!
//! ```text
//!   f(p) = R^T (a - g) + ([w']x + [w]x [w]x) p  =  force + gradient p
//! ```
//!
//! The second term is the tangential and the centripetal acceleration. All terms are in units of g.

use crate::central::CentralComputation;
use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, RowKind};
use protocol::skin::Skin;

/// Standard gravity in m/s2.
pub const STANDARD_GRAVITY: f64 = 9.806_65;
/// Gravity in the base frame of an upright robot, in m/s2.
pub const UPRIGHT_GRAVITY: [f64; 3] = [0.0, 0.0, -STANDARD_GRAVITY];

/// Positions, speeds and accelerations of the joints of one chain: rad, rad/s and rad/s2, or m, m/s and m/s2 for
/// prismatic joints.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct JointState {
    /// The positions, in rad or m.
    pub position: [f64; MAX_JOINTS],
    /// The speeds, in rad/s or m/s.
    pub speed: [f64; MAX_JOINTS],
    /// The accelerations, in rad/s2 or m/s2.
    pub acceleration: [f64; MAX_JOINTS],
}

/// The specific force (acceleration minus gravity) at every point of one row of the chain, in the frame of the row.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RowMotion {
    /// The specific force at the row's origin, in g.
    pub force: Vector3<f64>,
    /// The change of the specific force with the position on the row, in g/m.
    pub gradient: Matrix3<f64>,
}

impl RowMotion {
    /// Returns the specific force at a position on the row (in m, in the frame of the row), in g.
    #[must_use]
    pub fn specific_force_at(&self, position: &Vector3<f64>) -> Vector3<f64> {
        self.force + self.gradient * position
    }
}

/// The geometry of a bus's chain and the direction of gravity, from which the specific forces on its rows follow.
#[derive(Clone, Debug)]
pub struct ArmKinematics {
    central: CentralComputation,
    kinds: Vec<RowKind>,
    /// Gravity in the robot's base frame, in m/s2.
    gravity: Vector3<f64>,
}

impl ArmKinematics {
    /// Builds the chain of a bus that has cells; `gravity` is in the robot's base frame, in m/s2.
    #[must_use]
    pub fn new(skin: &Skin, bus: usize, gravity: [f64; 3]) -> Self {
        let kinds = skin.chain(bus).rows.iter().map(|row| row.kind).collect();
        Self {
            central: CentralComputation::without_quantisation(&skin.with_cells_of_bus(bus)),
            kinds,
            gravity: gravity.into(),
        }
    }

    /// Returns the specific force field of each row of the chain, base to tip. The first entry is the base, which no
    /// joint moves.
    #[must_use]
    pub fn row_motions(&self, state: &JointState) -> [RowMotion; MAX_ROWS + 1] {
        let frames = self.central.frames_at_positions(&state.position);
        let mut rows = [RowMotion::default(); MAX_ROWS + 1];
        let (mut spin, mut turn, mut linear) = (Vector3::zeros(), Vector3::zeros(), Vector3::zeros());
        let mut joints = state.speed.iter().zip(&state.acceleration);
        let kinds = core::iter::once(RowKind::Fixed).chain(self.kinds.iter().copied());
        for ((index, kind), motion) in kinds.enumerate().zip(&mut rows) {
            let (Some(below), Some(frame)) =
                (frames.row_frame(index.saturating_sub(1)), frames.row_frame(index))
            else {
                break;
            };
            let moved = if kind == RowKind::Fixed { None } else { joints.next() };
            let (speed, acceleration) =
                moved.map_or((0.0, 0.0), |(speed, acceleration)| (*speed, *acceleration));
            let axis: Vector3<f64> = below.rotation.matrix().column(2).into_owned();
            if kind == RowKind::Revolute {
                turn += axis * acceleration + spin.cross(&axis) * speed;
                spin += axis * speed;
            }
            let arm = frame.translation.vector - below.translation.vector;
            linear += turn.cross(&arm) + spin.cross(&spin.cross(&arm));
            if kind == RowKind::Prismatic {
                linear += axis * acceleration + spin.cross(&axis) * (2.0 * speed);
            }
            let rotation = frame.rotation.matrix();
            let local = |vector: Vector3<f64>| rotation.tr_mul(&vector);
            let (spin, turn) = (local(spin), local(turn));
            let cross = spin.cross_matrix();
            motion.force = local(linear - self.gravity) / STANDARD_GRAVITY;
            motion.gradient = (turn.cross_matrix() + cross * cross) / STANDARD_GRAVITY;
        }
        rows
    }

    /// Returns the transform from the frame of one row to that of another row of the same link.
    #[must_use]
    pub fn transform_between(&self, from: u8, to: u8) -> Isometry3<f64> {
        let frames = self.central.frames_at_positions(&[]);
        let (Some(from), Some(to)) = (frames.row_frame(from.into()), frames.row_frame(to.into())) else {
            return Isometry3::identity();
        };
        let change = to.inverse() * from;
        Isometry3::from_parts(change.translation, UnitQuaternion::from_rotation_matrix(&change.rotation))
    }

    /// Converts a position in the frame of a row to a position in the robot's base frame, in m, for these joint
    /// positions in rad or m.
    #[must_use]
    pub fn position_in_base_frame(
        &self,
        row: usize,
        position: &Vector3<f64>,
        joints: &[f64],
    ) -> Vector3<f64> {
        let frames = self.central.frames_at_positions(joints);
        frames
            .row_frame(row)
            .map_or_else(Vector3::zeros, |frame| (frame * nalgebra::Point3::from(*position)).coords)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing;

    /// Joint positions as functions of time, with their derivatives in closed form.
    fn state(t: f64, joints: usize) -> JointState {
        let mut state = JointState::default();
        for joint in 0..joints {
            let (amplitude, rate, phase) =
                (0.2 + 0.03 * joint as f64, 2.0 + 0.7 * joint as f64, joint as f64);
            let angle = rate * t + phase;
            state.position[joint] = 0.3 + amplitude * angle.sin();
            state.speed[joint] = amplitude * rate * angle.cos();
            state.acceleration[joint] = -amplitude * rate * rate * angle.sin();
        }
        state
    }

    #[test]
    fn the_force_is_the_second_difference_of_the_place_less_gravity() {
        for skin in [testing::ur5_skin(), testing::panda_skin(), testing::lift_skin()] {
            let arm = ArmKinematics::new(&skin, 0, UPRIGHT_GRAVITY);
            let joints = skin.chain(0).joints.len();
            let (t, step) = (0.37, 1e-4);
            let position = Vector3::new(0.03, -0.05, 0.11);
            let rows = arm.row_motions(&state(t, joints));
            for (row, motion) in rows.iter().enumerate().take(skin.chain(0).rows.len() + 1) {
                let at = |t: f64| arm.position_in_base_frame(row, &position, &state(t, joints).position);
                let acceleration = (at(t + step) - 2.0 * at(t) + at(t - step)) / (step * step);
                let frames = arm.central.frames_at_positions(&state(t, joints).position);
                let rotation = frames.row_frame(row).unwrap().rotation.matrix().to_owned();
                let expected = rotation.transpose()
                    * (acceleration + Vector3::new(0.0, 0.0, STANDARD_GRAVITY))
                    / STANDARD_GRAVITY;
                let off = (motion.specific_force_at(&position) - expected).norm();
                assert!(off < 1e-5, "{} row {row}: {off}", skin.name);
            }
        }
    }
}
