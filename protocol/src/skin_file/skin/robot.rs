//! The robot: its joints, and the chains of joints that carry skin.

use serde::Deserialize;

use crate::fixed::Q1_14;
use crate::parameters::RowKind;

/// Maximum number of joints of a robot, over all chains.
pub const MAX_ROBOT_JOINTS: usize = 32;

/// A tree of joints, given as chains from the base that may share their first joints.
#[derive(Clone, Debug, PartialEq)]
pub struct Robot {
    /// Name of the robot.
    pub name: String,
    /// Path of the robot's URDF file, relative to the skin file.
    pub urdf: Option<String>,
    /// Joints of the robot. Controllers and recordings use the same order.
    pub joints: Vec<Joint>,
    /// Chains of the robot, each with at least one joint.
    pub chains: Vec<Chain>,
}

/// A joint of the robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Name of the joint.
    pub name: String,
    /// Kind of the joint.
    pub kind: JointKind,
    /// Minimum and maximum position of the joint, in rad or m.
    pub limits: [f64; 2],
}

/// The kind of a joint.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum JointKind {
    /// Revolute: positions in rad, torques in Nm.
    #[default]
    Revolute,
    /// Prismatic: positions in m, forces in N.
    Prismatic,
}

impl JointKind {
    /// Returns the name of the kind.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.row_kind().name()
    }

    /// Returns the kind of a table row with such a joint.
    #[must_use]
    pub const fn row_kind(self) -> RowKind {
        match self {
            Self::Revolute => RowKind::Revolute,
            Self::Prismatic => RowKind::Prismatic,
        }
    }

    /// Returns the unit of the joint's position: `rad` or `m`.
    #[must_use]
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Revolute => "rad",
            Self::Prismatic => "m",
        }
    }

    /// Returns the unit of the joint's torque or force.
    #[must_use]
    pub const fn torque_unit(self) -> &'static str {
        match self {
            Self::Revolute => "Nm",
            Self::Prismatic => "N",
        }
    }

    /// Converts a position in rad or m to a Q1.14 word in quarter turns or m. Returns `None` if the position is not
    /// finite.
    #[must_use]
    pub fn position_to_word(self, position: f64) -> Option<Q1_14> {
        match self {
            Self::Revolute => Q1_14::from_radians(position),
            Self::Prismatic => position.is_finite().then(|| Q1_14::nearest(position)),
        }
    }

    /// Converts a Q1.14 word in quarter turns or m to a position in rad or m.
    #[must_use]
    pub fn word_to_position(self, word: Q1_14) -> f64 {
        match self {
            Self::Revolute => word.to_radians(),
            Self::Prismatic => word.to_f64(),
        }
    }
}

/// A chain of joints from base to tip, which carries buses of cells.
#[derive(Clone, Debug, PartialEq)]
pub struct Chain {
    /// Name of the chain.
    pub name: String,
    /// Pose of frame 0 of the chain's table, relative to the robot's base.
    pub base: ChainBase,
    /// Joints of the chain as indices into [`Robot::joints`]; 1 to 14.
    pub joints: Vec<usize>,
    /// Denavit-Hartenberg table of the chain from base to tip: a row for each joint, and fixed rows; at most 32.
    pub rows: Vec<ChainRow>,
}

/// The pose of a chain's base relative to the robot's base. Cells compute in frame 0 and do not need it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChainBase {
    /// Position in m.
    pub position: [f64; 3],
    /// Orientation as a unit quaternion x, y, z, w.
    pub orientation: [f64; 4],
}

impl Default for ChainBase {
    fn default() -> Self {
        Self { position: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0] }
    }
}

impl ChainBase {
    /// Returns the homogeneous transform from frame 0 to the robot's base, a 4 by 4 matrix in columns with lengths in
    /// m.
    #[must_use]
    pub fn transform_matrix(&self) -> [[f64; 4]; 4] {
        let norm = self.orientation.iter().map(|it| it * it).sum::<f64>().sqrt();
        let [x, y, z, w] = self.orientation.map(|it| it / norm);
        let [px, py, pz] = self.position;
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z), 2.0 * (x * z - w * y), 0.0],
            [2.0 * (x * y - w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z + w * x), 0.0],
            [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z, 0.0],
            [px, py, pz, 1.0],
        ]
    }
}

/// A row of a chain's table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChainRow {
    /// Kind of the row: the kind of its joint, or fixed.
    pub kind: RowKind,
    /// Denavit-Hartenberg constants of the row.
    pub table: DenavitHartenberg,
    /// Minimum and maximum position of the row's joint, in rad or m; zeros for a fixed row.
    pub limits: [f64; 2],
}

/// The constants of a table row, `Rz(theta + theta_offset) Tz(d) Tx(a) Rx(alpha)`. Omitted values are 0.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq)]
#[serde(deny_unknown_fields, default)]
pub struct DenavitHartenberg {
    /// Length of the link in m.
    pub a: f64,
    /// Twist in rad.
    pub alpha: f64,
    /// Offset along the joint's axis in m. For a prismatic joint, the joint position is added to it.
    pub d: f64,
    /// Angle in rad. For a revolute joint, the joint position is added to it; for other rows it is the whole angle.
    pub theta_offset: f64,
}

impl Chain {
    /// Returns the number of the row that a joint moves. Joints and rows are counted from 1.
    #[must_use]
    pub fn row_of(&self, joint: u8) -> Option<u8> {
        let moving = (1..).zip(&self.rows).filter(|(_, row)| row.kind != RowKind::Fixed);
        moving.map(|(number, _)| number).nth(usize::from(joint).checked_sub(1)?)
    }

    /// Returns the number of the joint that moves the link of a row: the last joint up to this row. Joints and rows are
    /// counted from 1; 0 is returned for rows before the first joint.
    #[must_use]
    pub fn joint_of_row(&self, row: u8) -> u8 {
        let moving = self.rows.iter().take(row.into()).filter(|row| row.kind != RowKind::Fixed);
        u8::try_from(moving.count()).unwrap_or(u8::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_transform_of_a_base_turns_its_axes_as_the_quaternion_says() {
        let quarter = std::f64::consts::FRAC_1_SQRT_2;
        let (x, y, z) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
        let minus = |axis: [f64; 3]| axis.map(|it| -it);
        for (orientation, images) in [
            ([0.0, 0.0, 0.0, 1.0], [x, y, z]),
            ([quarter, 0.0, 0.0, quarter], [x, z, minus(y)]),
            ([0.0, quarter, 0.0, quarter], [minus(z), y, x]),
            ([0.0, 0.0, quarter, quarter], [y, minus(x), z]),
            // About the diagonal, by 120 degrees and back; the length does not count.
            ([3.0, 3.0, 3.0, 3.0], [y, z, x]),
            ([0.5, 0.5, 0.5, -0.5], [z, x, y]),
        ] {
            let position = [0.1, -0.2, 0.3];
            let columns = ChainBase { position, orientation }.transform_matrix();
            let expected = [images[0], images[1], images[2], position];
            for ((column, expected), is_point) in columns.iter().zip(expected).zip([0.0, 0.0, 0.0, 1.0]) {
                for (got, expected) in column.iter().zip([expected[0], expected[1], expected[2], is_point]) {
                    assert!((got - expected).abs() < 1e-12, "{orientation:?}: {columns:?}");
                }
            }
        }
    }
}
