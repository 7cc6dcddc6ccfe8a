//! The results of a calibration, in the form in which they are printed and written to files.

use nalgebra::{Matrix3, SymmetricEigen, UnitQuaternion, Vector3};
use protocol::skin::{Cell, Skin};
use serde::Serialize;

use crate::help::MotionAdvice;
use crate::refusal::GapSummary;
use crate::rounded::rounded;
use crate::zero::ZeroOffset;
use model::accelerometer::kinematics::ArmKinematics;

/// The limits of the 95 % uncertainty of a determined pose: of the position in m, and of the orientation in rad.
const MAX_POSE_UNCERTAINTIES_95: [f64; 2] = [0.02, 0.09];

/// The results of the calibration of a skin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Calibration {
    /// The results for all cells together.
    pub summary: Summary,
    /// The result for each cell of the skin.
    pub cells: Vec<CellResult>,
    /// The zero offset of each joint of the robot, if requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_offsets: Option<Vec<ZeroOffset>>,
}

/// The results for all cells together.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// The number of cells of the skin.
    pub cells: usize,
    /// The number of cells with a pose that can be used.
    pub determined: usize,
    /// The number of cells with a problem.
    pub troubled: usize,
    /// The median of the 95 % radius of positions, in mm; `None` without a pose that can be used.
    pub position_mm: Option<f64>,
    /// The median of the 95 % angle of orientations, in degrees; `None` without a pose that can be used.
    pub orientation_deg: Option<f64>,
    /// The median of the scatter of readings, in mg.
    pub noise_mg: Option<f64>,
    /// The gaps in the broadcasts of joints.
    pub joints: GapSummary,
    /// The number of wires whose length improved positions.
    pub wires: usize,
}

/// The result for one cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellResult {
    /// The name of the cell's bus.
    pub bus: String,
    /// The cell's node id.
    pub node: u8,
    /// The cell's serial number.
    pub serial: u32,
    /// The number of readings of the cell.
    pub readings: usize,
    /// The problems with the cell; empty for most cells.
    pub troubles: Vec<Diagnosis>,
    /// The place of the cell, as it is written to a skin file.
    #[serde(flatten)]
    pub found: Option<EstimatedCellPlace>,
    /// The errors of the cell's accelerometer.
    #[serde(flatten)]
    pub sensor: SensorResult,
    /// The pose of the cell in the frame of the joint's row.
    #[serde(skip)]
    pub pose: Option<Pose>,
}

/// The estimated errors of an accelerometer; `None` if it was not estimated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SensorResult {
    /// The reading of each axis without a force, in g.
    pub bias_g: Option<[f64; 3]>,
    /// The reading of each axis per unit of force along it.
    pub gain: Option<[f64; 3]>,
    /// The scatter of an axis' readings, in g, derived from the median.
    pub noise_g: Option<f64>,
    /// The scatter of an axis' readings, in g, derived from the 90 % quantile.
    pub rough_g: Option<f64>,
}

/// The place of a cell, in the terms of a skin file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EstimatedCellPlace {
    /// The joint that moves the cell.
    pub joint: u8,
    /// The row in whose frame position and orientation are given.
    pub row: u8,
    /// The position in m.
    pub position: [f64; 3],
    /// The orientation as a quaternion x, y, z, w.
    pub orientation: [f64; 4],
    /// The 95 % radius of the position, in mm.
    pub position_mm: f64,
    /// The 95 % angle of the orientation, in degrees.
    pub orientation_deg: f64,
    /// The distance from the position in the skin, in mm; `None` if that position is on another link.
    pub moved_mm: Option<f64>,
    /// The angle between the estimated normal and that in the skin, in degrees.
    pub turned_deg: Option<f64>,
}

/// A pose with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// The joint that moves the cell.
    pub joint: u8,
    /// The position in the frame of the joint's row, in m.
    pub position: Vector3<f64>,
    /// The rotation from the cell's frame to that of the row.
    pub rotation: UnitQuaternion<f64>,
    /// The covariance of the position, in m².
    pub position_covariance: Matrix3<f64>,
    /// The covariance of the orientation as a rotation vector in the frame of the cell, in rad².
    pub turn_covariance: Matrix3<f64>,
}

/// The reason to distrust a cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "trouble", rename_all = "kebab-case")]
pub enum Diagnosis {
    /// The cell sent nothing.
    Dead,
    /// All readings of the cell have the same value.
    Stuck,
    /// The cell sent much fewer readings than expected.
    Silent {
        /// The fraction of the expected readings that came.
        share: f64,
    },
    /// No joint moves the cell.
    Still,
    /// Another joint explains the cell's readings nearly as well.
    Joint {
        /// The joint that explains the readings slightly better.
        joint: u8,
    },
    /// The readings scatter more than those of most cells, so the cell is loose or damaged.
    Loose {
        /// The scatter, as a multiple of that of most cells.
        times: f64,
    },
    /// The cell and another one are at each other's described places.
    Swapped {
        /// The node id of the other cell.
        node: u8,
    },
    /// The cell is at the described place of another cell.
    Elsewhere {
        /// The node id of the other cell.
        node: u8,
    },
    /// The motion did not determine the cell's pose.
    NotObservable {
        /// The 95 % radius of the position, in mm.
        position_mm: f64,
        /// The 95 % angle of the orientation, in degrees.
        orientation_deg: f64,
        /// The motion that would help to determine the pose.
        help: MotionAdvice,
    },
}

impl core::fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Dead => f.write_str("dead: it sent no acceleration; its pose in the skin is kept"),
            Self::Stuck => {
                f.write_str("stuck: it always sent the same acceleration; its pose in the skin is kept")
            }
            Self::Silent { share } => {
                write!(f, "silent: only {:.0} % of its readings arrived; check its wires", share * 100.0)
            }
            Self::Still => f.write_str("no joint moves it; its pose in the skin is kept"),
            Self::Joint { joint } => {
                write!(
                    f,
                    "uncertain joint: joint {joint} explains its readings only slightly better than another \
                     joint; move joint {joint} more"
                )
            }
            Self::Loose { times } => {
                write!(
                    f,
                    "loose or damaged: its readings scatter {times} times as much as those of most cells; \
                     its pose in the skin is kept"
                )
            }
            Self::Swapped { node } => {
                write!(
                    f,
                    "swapped with node {node}: each of the two cells is mounted where the skin places the other"
                )
            }
            Self::Elsewhere { node } => {
                write!(f, "in a wrong place: it is mounted where the skin places node {node}")
            }
            Self::NotObservable { position_mm, orientation_deg, help } => write!(
                f,
                "not observable: its pose is known only within {position_mm} mm and {orientation_deg} \
                 degrees; {help}; its pose in the skin is kept"
            ),
        }
    }
}

impl CellResult {
    pub(crate) fn without_estimate(skin: &Skin, cell: &Cell, readings: usize) -> Self {
        Self {
            bus: skin.buses.get(cell.bus).map_or_else(String::new, |bus| bus.name.clone()),
            node: cell.node.get(),
            serial: cell.serial,
            readings,
            troubles: Vec::new(),
            found: None,
            sensor: SensorResult::default(),
            pose: None,
        }
    }

    /// Returns true if the cell's new pose is written to a skin file.
    #[must_use]
    pub fn is_pose_written(&self) -> bool {
        let kept = |trouble: &Diagnosis| {
            matches!(
                trouble,
                Diagnosis::Dead
                    | Diagnosis::Stuck
                    | Diagnosis::Still
                    | Diagnosis::Joint { .. }
                    | Diagnosis::Loose { .. }
                    | Diagnosis::NotObservable { .. }
            )
        };
        self.found.is_some() && !self.troubles.iter().any(kept)
    }

    /// Stores the pose in the terms of a skin file: in the frame of the row that carries the cell in the skin, if that
    /// row belongs to the same joint.
    pub(crate) fn store_pose(&mut self, skin: &Skin, cell: &Cell, arm: Option<&ArmKinematics>) {
        let sensor = &mut self.sensor;
        sensor.bias_g = sensor.bias_g.map(|bias| bias.map(|it| rounded(it, 5)));
        sensor.gain = sensor.gain.map(|gain| gain.map(|it| rounded(it, 5)));
        (sensor.noise_g, sensor.rough_g) =
            (sensor.noise_g.map(|it| rounded(it, 5)), sensor.rough_g.map(|it| rounded(it, 5)));
        let (Some(pose), Some(arm)) = (&self.pose, arm) else { return };
        if self.troubles.iter().any(|trouble| matches!(trouble, Diagnosis::Loose { .. })) {
            // The uncertainty of its pose follows from noise, which these residuals are not.
            return;
        }
        let own = skin.chain(cell.bus).row_of(pose.joint).unwrap_or_default();
        let row = if cell.joint == pose.joint { cell.row } else { own };
        let change = arm.transform_between(own, row);
        let placed = pose.in_other_frame((&change.rotation, &change.translation.vector));
        let quaternion = placed.rotation.quaternion();
        let sign = if quaternion.w < 0.0 { -1.0 } else { 1.0 };
        let same_link = cell.joint == pose.joint;
        let way = (placed.position - Vector3::from(cell.position)).norm();
        let turn = (placed.rotation * Vector3::z()).angle(&Vector3::from(cell.normal));
        self.found = Some(EstimatedCellPlace {
            joint: pose.joint,
            row,
            position: placed.position.map(|part| rounded(part, 5)).into(),
            orientation: [quaternion.i, quaternion.j, quaternion.k, quaternion.w]
                .map(|part| rounded(part * sign, 6)),
            position_mm: rounded(pose.position_radius_95_m() * 1e3, 2),
            orientation_deg: rounded(pose.rotation_angle_95_rad().to_degrees(), 2),
            moved_mm: same_link.then(|| rounded(way * 1e3, 2)),
            turned_deg: same_link.then(|| rounded(turn.to_degrees(), 2)),
        });
    }
}

impl Pose {
    /// Returns the 95 % radius of the position, in m.
    #[must_use]
    pub fn position_radius_95_m(&self) -> f64 {
        covariance_radius_95(&self.position_covariance)
    }

    /// Returns the 95 % angle of the orientation, in rad.
    #[must_use]
    pub fn rotation_angle_95_rad(&self) -> f64 {
        covariance_radius_95(&self.turn_covariance)
    }

    /// Returns true if the pose is certain enough to be used.
    #[must_use]
    pub fn is_determined(&self) -> bool {
        let [position, turn] = MAX_POSE_UNCERTAINTIES_95;
        self.position_radius_95_m() < position && self.rotation_angle_95_rad() < turn
    }

    /// Returns the same pose, seen from another frame of the same link.
    pub(crate) fn in_other_frame(&self, (turn, shift): (&UnitQuaternion<f64>, &Vector3<f64>)) -> Self {
        let matrix: Matrix3<f64> = turn.to_rotation_matrix().matrix().to_owned();
        Self {
            position: turn * self.position + shift,
            rotation: turn * self.rotation,
            position_covariance: matrix * self.position_covariance * matrix.transpose(),
            ..*self
        }
    }
}

/// Returns the 95 % radius of a normally distributed vector. The sum of squares is approximated by a scaled chi-squared
/// distribution with the same mean and variance (Welch and Satterthwaite), whose quantile follows Wilson and Hilferty.
fn covariance_radius_95(covariance: &Matrix3<f64>) -> f64 {
    let variances = SymmetricEigen::new(*covariance).eigenvalues.map(|it| it.max(0.0));
    let (mean, half) = (variances.sum(), variances.norm_squared());
    if half <= 0.0 {
        return 0.0;
    }
    let degrees = mean * mean / half;
    let part = 2.0 / (9.0 * degrees);
    (mean * (1.0 - part + 1.644_854 * part.sqrt()).powi(3)).sqrt()
}

impl Summary {
    pub(crate) fn from_cells(cells: &[CellResult], wires: usize, joints: GapSummary) -> Self {
        let median = |pick: &dyn Fn(&CellResult) -> Option<f64>| {
            let mut all: Vec<_> =
                cells.iter().filter(|cell| cell.is_pose_written()).filter_map(pick).collect();
            all.sort_by(f64::total_cmp);
            all.get(all.len() / 2).copied()
        };
        Self {
            cells: cells.len(),
            determined: cells.iter().filter(|cell| cell.is_pose_written()).count(),
            troubled: cells.iter().filter(|cell| !cell.troubles.is_empty()).count(),
            position_mm: median(&|cell| Some(cell.found?.position_mm)),
            orientation_deg: median(&|cell| Some(cell.found?.orientation_deg)),
            noise_mg: median(&|cell| cell.sensor.noise_g).map(|noise| rounded(noise * 1e3, 2)),
            joints,
            wires,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_radius_is_that_of_chi_squared_where_it_is_known() {
        let of =
            |variances: [f64; 3]| covariance_radius_95(&Matrix3::from_diagonal(&Vector3::from(variances)));
        assert!((of([1.0, 1.0, 1.0]) - 7.815_f64.sqrt()).abs() < 0.01);
        assert!((of([1.0, 1.0, 0.0]) - 5.991_f64.sqrt()).abs() < 0.02);
        assert!((of([4.0, 0.0, 0.0]) - 2.0 * 1.96).abs() < 0.06);
        assert!(of([0.0; 3]).abs() < 1e-12);
    }
}
