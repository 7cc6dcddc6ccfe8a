//! References for the kernels: the UR5's table, torques from other programs, and Eq. 8 in real numbers.

#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::float_cmp,
    reason = "shared by programs that use a part each; a test may stop; zeros are exact"
)]

use cell_node::contact::{Force, Torque};
use protocol::fixed::{Q1_14, Q3_12, TorqueFormat};
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, Parameters, Pose, Row, RowKind};

/// A line of `vectors/ur5_torque.csv`: torques computed from Eq. 8 in double precision, which agree with a rigid-body
/// library and the robot's URDF to 1e-11 Nm.
pub(crate) struct Case {
    /// Number of the joint that moves the cell, 1 to 6.
    pub(crate) joint: u8,
    /// Joint positions in rad.
    pub(crate) positions: [f64; MAX_JOINTS],
    /// Position of the cell in the frame of that joint, in m.
    pub(crate) position: [f64; 3],
    /// Direction of the force in the same frame, a unit vector.
    pub(crate) direction: [f64; 3],
    /// Force on the cell in N.
    pub(crate) force: f64,
    /// Torque in each joint in Nm.
    pub(crate) torques: [f64; MAX_JOINTS],
}

impl Case {
    /// Returns all cases of the file.
    pub(crate) fn all() -> Vec<Self> {
        include_str!("../../../tests/vectors/ur5_torque.csv").lines().skip(1).map(Self::read).collect()
    }

    fn read(line: &str) -> Self {
        let (joint, rest) = line.split_once(',').unwrap();
        let node_ids: Vec<f64> = rest.split(',').map(|number| number.parse().unwrap()).collect();
        Self {
            joint: joint.parse().unwrap(),
            positions: per_joint(&node_ids[..6]),
            position: node_ids[6..9].try_into().unwrap(),
            direction: node_ids[9..12].try_into().unwrap(),
            force: node_ids[12],
            torques: per_joint(&node_ids[13..]),
        }
    }

    /// Returns the parameters of the cell in this case. The outward normal is opposite to the force.
    pub(crate) fn parameters(&self) -> Parameters {
        let pose = Pose {
            position: self.position.map(Q1_14::nearest),
            normal: self.direction.map(|n| Q1_14::nearest(-n)),
        };
        Parameters { joint: self.joint, joints: 6, pose, rows: ur5(), ..Parameters::default() }
    }

    /// Returns the joint positions as words.
    pub(crate) fn words(&self) -> [Q1_14; MAX_JOINTS] {
        self.positions.map(|angle| Q1_14::from_radians(angle).unwrap())
    }
}

/// Errors of computed torques relative to those of the cases, in Nm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Errors {
    /// Mean of the absolute errors in Nm.
    pub(crate) mean: f64,
    /// Largest absolute error in Nm.
    pub(crate) max: f64,
    /// Number of compared torques. Only the torques of loaded joints are compared.
    pub(crate) torques: usize,
    /// Number of cases that are left out because a torque exceeds the range of Q3.12.
    pub(crate) omitted: usize,
}

impl Errors {
    /// Compares the torques of each case with those that `torques` returns for it, in Nm.
    pub(crate) fn of(torques: impl Fn(&Case) -> [f64; MAX_JOINTS]) -> Self {
        let cases = Case::all();
        let fits = |case: &&Case| case.torques.iter().all(|torque| torque.abs() < Q3_12::MAX.to_f64());
        let errors: Vec<f64> = cases
            .iter()
            .filter(fits)
            .flat_map(|case| {
                let got = torques(case);
                let loaded = usize::from(case.joint);
                assert!(got[loaded..].iter().all(|&torque| torque == 0.0), "joints beyond k bear no load");
                (0..loaded).map(move |joint| (got[joint] - case.torques[joint]).abs())
            })
            .collect();
        Self {
            mean: errors.iter().sum::<f64>() / errors.len() as f64,
            max: errors.iter().copied().fold(0.0, f64::max),
            torques: errors.len(),
            omitted: cases.len() - cases.iter().filter(fits).count(),
        }
    }

    /// Compares the torques of each case with the words that a cell would send.
    pub(crate) fn of_words(
        jacobian: impl Fn(&Parameters, &[Q1_14; MAX_JOINTS]) -> [Q1_14; MAX_JOINTS],
    ) -> Self {
        Self::of(|case| {
            let force = Force::from_steps((case.force * 65_536.0) as i64);
            let jacobian = jacobian(&case.parameters(), &case.words());
            let torque = Torque::new(&jacobian, force);
            torque.torque_words(TorqueFormat::Q3_12).map(|word| TorqueFormat::Q3_12.to_real(word))
        })
    }
}

/// Returns the UR5's table in words.
pub(crate) fn ur5() -> [Row; MAX_ROWS] {
    let d = [0.089_159, 0.0, 0.0, 0.109_15, 0.094_65, 0.082_3];
    let a = [0.0, -0.425, -0.392_25, 0.0, 0.0, 0.0];
    let alpha = [1.0, 0.0, 0.0, 1.0, -1.0, 0.0];
    let [a, d, alpha] = [a, d, alpha].map(|column: [f64; 6]| column.map(Q1_14::nearest));
    let mut rows = [Row::default(); MAX_ROWS];
    for row in 0..6 {
        rows[row] = Row { a: a[row], d: d[row], alpha: alpha[row], ..Row::default() };
    }
    rows
}

/// Returns an array with one value per joint, filled with defaults for joints that the robot does not have.
pub(crate) fn per_joint<T: Copy + Default>(values: &[T]) -> [T; MAX_JOINTS] {
    std::array::from_fn(|joint| values.get(joint).copied().unwrap_or_default())
}

type Transform = [[f64; 4]; 4];

fn product(lhs: &Transform, rhs: &Transform) -> Transform {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..4).map(|n| lhs[i][n] * rhs[n][j]).sum()))
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Returns the matrix Rz(theta) Tz(d) Tx(a) Rx(alpha), as the product of four matrices.
fn transform(row: &Row, position: Q1_14) -> Transform {
    let (theta, d) = match row.kind {
        RowKind::Revolute => (position.wrapping_add(row.theta_offset), row.d),
        RowKind::Prismatic => (row.theta_offset, row.d.saturating_add(position)),
        RowKind::Fixed => (row.theta_offset, row.d),
    };
    let (st, ct) = theta.to_radians().sin_cos();
    let (sa, ca) = row.alpha.to_radians().sin_cos();
    let about_z = [[ct, -st, 0.0, 0.0], [st, ct, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    let along = [
        [1.0, 0.0, 0.0, row.a.to_f64()],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, d.to_f64()],
        [0.0, 0.0, 0.0, 1.0],
    ];
    let about_x = [[1.0, 0.0, 0.0, 0.0], [0.0, ca, -sa, 0.0], [0.0, sa, ca, 0.0], [0.0, 0.0, 0.0, 1.0]];
    product(&product(&about_z, &along), &about_x)
}

/// Computes Eq. 8 literally: frames as products of 4x4 matrices, then `(z_(l-1) x (t_i - t_(l-1))) . f`, or
/// `z_(l-1) . f` for a prismatic joint.
pub(crate) fn equation_8(parameters: &Parameters, positions: &[Q1_14; MAX_JOINTS]) -> [f64; MAX_JOINTS] {
    let mut frames: Vec<Transform> =
        vec![std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))))];
    let mut positions = positions.iter();
    for row in parameters.rows_to_cell() {
        let position = if row.has_joint() { *positions.next().unwrap_or(&Q1_14::ZERO) } else { Q1_14::ZERO };
        frames.push(product(frames.last().unwrap(), &transform(row, position)));
    }
    let axis = |frame: &Transform, column: usize| -> [f64; 3] { std::array::from_fn(|i| frame[i][column]) };
    let last = frames.last().unwrap();
    let turn = |v: [f64; 3]| -> [f64; 3] { std::array::from_fn(|i| (0..3).map(|j| last[i][j] * v[j]).sum()) };
    let force = turn(parameters.pose.normal.map(|n| -n.to_f64()));
    let local = turn(parameters.pose.position.map(Q1_14::to_f64));
    let cell: [f64; 3] = std::array::from_fn(|i| local[i] + last[i][3]);

    let mut jacobian = [0.0; MAX_JOINTS];
    let moving = parameters.rows_to_cell().iter().zip(&frames).filter(|(row, _)| row.has_joint());
    for (row, (of, frame)) in jacobian.iter_mut().zip(moving) {
        if of.kind == RowKind::Prismatic {
            *row = axis(frame, 2).iter().zip(force).map(|(z, f)| z * f).sum();
            continue;
        }
        let origin = axis(frame, 3);
        let moment = cross(axis(frame, 2), std::array::from_fn(|i| cell[i] - origin[i]));
        *row = moment.iter().zip(force).map(|(m, f)| m * f).sum();
    }
    jacobian
}
