//! What a calibration found, as it is printed and written.

use nalgebra::{Matrix3, SymmetricEigen, UnitQuaternion, Vector3};
use protocol::skin::{Cell, Skin};
use serde::Serialize;

use crate::help::Help;
use crate::refusal::Disturbance;
use crate::rounded::rounded;
use crate::zero::ZeroOffset;
use model::accelerometer::kinematics::Arm;

/// Poses that are less certain than this are not determined: in m, and in rad.
const ENOUGH: [f64; 2] = [0.02, 0.09];

/// What was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Calibration {
    /// All cells together.
    pub summary: Summary,
    /// By cell of the skin.
    pub cells: Vec<CellResult>,
    /// By joint of the robot, if that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_offsets: Option<Vec<ZeroOffset>>,
}

/// All cells together.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Cells of the skin.
    pub cells: usize,
    /// Of these, with a pose that can be used.
    pub determined: usize,
    /// Of these, to be distrusted.
    pub troubled: usize,
    /// Median of what positions are certain within, 95 of 100 times, in mm; `None` without a pose that can be used.
    pub position_mm: Option<f64>,
    /// The same of orientations, in degrees.
    pub orientation_deg: Option<f64>,
    /// Median of what readings scatter, in mg.
    pub noise_mg: Option<f64>,
    /// Gaps in the broadcasts of joints.
    pub joints: Disturbance,
    /// Wires whose length made positions better.
    pub wires: usize,
}

/// One cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CellResult {
    /// The name of its bus.
    pub bus: String,
    /// Its node id.
    pub node: u8,
    /// Its serial number.
    pub serial: u32,
    /// Readings of it.
    pub readings: usize,
    /// What is wrong with it; nothing for most.
    pub troubles: Vec<Trouble>,
    /// Where it was found, as it is written.
    #[serde(flatten)]
    pub found: Option<Found>,
    /// Its accelerometer.
    #[serde(flatten)]
    pub sensor: SensorResult,
    /// The pose in the frame of the joint's row.
    #[serde(skip)]
    pub pose: Option<Pose>,
}

/// An accelerometer as it was found; `None` for one that was not estimated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SensorResult {
    /// What each axis shows without a force, in g.
    pub bias_g: Option<[f64; 3]>,
    /// What each axis shows of a force along it.
    pub gain: Option<[f64; 3]>,
    /// How much a reading of an axis scatters, in g, from the median.
    pub noise_g: Option<f64>,
    /// The same from what nine of ten readings are below.
    pub rough_g: Option<f64>,
}

/// Where a cell was found: what a skin file has.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Found {
    /// The joint that moves it.
    pub joint: u8,
    /// The row in whose frame it is.
    pub row: u8,
    /// In m.
    pub position: [f64; 3],
    /// Quaternion x, y, z, w.
    pub orientation: [f64; 4],
    /// Within how much the position is certain, 95 of 100 times, in mm.
    pub position_mm: f64,
    /// The same of the orientation, in degrees.
    pub orientation_deg: f64,
    /// How far this is from where the skin has it, in mm; `None` if that is on another link.
    pub moved_mm: Option<f64>,
    /// The angle between the normals, in degrees.
    pub turned_deg: Option<f64>,
}

/// A pose with what is certain of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// The joint that moves the cell.
    pub joint: u8,
    /// In the frame of the joint's row, in m.
    pub position: Vector3<f64>,
    /// From the cell's frame to that of the row.
    pub rotation: UnitQuaternion<f64>,
    /// Of the position, in m2.
    pub position_covariance: Matrix3<f64>,
    /// Of the orientation as a rotation vector in the frame of the cell, in rad2.
    pub turn_covariance: Matrix3<f64>,
}

/// Why a cell is to be distrusted.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "trouble", rename_all = "kebab-case")]
pub enum Trouble {
    /// It sent nothing.
    Dead,
    /// It sent one value only.
    Stuck,
    /// It sent few readings.
    Silent {
        /// The part of the broadcasts that it answered.
        share: f64,
    },
    /// No joint moves it.
    Still,
    /// Another joint explains its readings nearly as well.
    Joint {
        /// The better one.
        joint: u8,
    },
    /// Its readings scatter.
    Loose {
        /// So many times as much as those of most cells.
        times: f64,
    },
    /// It sits where the skin has another cell, which sits where the skin has it.
    Swapped {
        /// The other one's node id.
        node: u8,
    },
    /// It sits where the skin has another cell.
    Elsewhere {
        /// The other one's node id.
        node: u8,
    },
    /// The motion did not tell its pose.
    NotObservable {
        /// Within how much the position is certain, in mm.
        position_mm: f64,
        /// The same of the orientation, in degrees.
        orientation_deg: f64,
        /// What would help.
        help: Help,
    },
}

impl core::fmt::Display for Trouble {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Dead => f.write_str("dead: it sent no acceleration; its description is kept"),
            Self::Stuck => f.write_str("stuck: it sent one acceleration only; its description is kept"),
            Self::Silent { share } => {
                write!(f, "silent: {:.0} % of its readings came; check its wires", share * 100.0)
            }
            Self::Still => f.write_str("no joint moves it; its description is kept"),
            Self::Joint { joint } => {
                write!(
                    f,
                    "joint {joint} explains its readings little better than another: move that joint more"
                )
            }
            Self::Loose { times } => {
                write!(
                    f,
                    "loose or damaged: its readings scatter {times} times as much as those of most cells; its description is kept"
                )
            }
            Self::Swapped { node } => {
                write!(f, "swapped with node {node}: each sits where the skin has the other")
            }
            Self::Elsewhere { node } => write!(f, "it sits where the skin has node {node}"),
            Self::NotObservable { position_mm, orientation_deg, help } => write!(
                f,
                "not observable: certain within {position_mm} mm and {orientation_deg} degrees; {help}; its description is kept"
            ),
        }
    }
}

impl CellResult {
    pub(crate) fn unknown(skin: &Skin, cell: &Cell, readings: usize) -> Self {
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

    /// Whether its pose goes into a new skin file.
    #[must_use]
    pub fn is_written(&self) -> bool {
        let kept = |trouble: &Trouble| {
            matches!(
                trouble,
                Trouble::Dead
                    | Trouble::Stuck
                    | Trouble::Still
                    | Trouble::Joint { .. }
                    | Trouble::Loose { .. }
                    | Trouble::NotObservable { .. }
            )
        };
        self.found.is_some() && !self.troubles.iter().any(kept)
    }

    /// The pose as a skin file has it: in the frame of the row that carries the cell by its description, if that is of
    /// the same joint.
    pub(crate) fn settle(&mut self, skin: &Skin, cell: &Cell, arm: Option<&Arm>) {
        let sensor = &mut self.sensor;
        sensor.bias_g = sensor.bias_g.map(|bias| bias.map(|it| rounded(it, 5)));
        sensor.gain = sensor.gain.map(|gain| gain.map(|it| rounded(it, 5)));
        (sensor.noise_g, sensor.rough_g) =
            (sensor.noise_g.map(|it| rounded(it, 5)), sensor.rough_g.map(|it| rounded(it, 5)));
        let (Some(pose), Some(arm)) = (&self.pose, arm) else { return };
        if self.troubles.iter().any(|trouble| matches!(trouble, Trouble::Loose { .. })) {
            // How far its pose is certain follows from noise, which its readings are not.
            return;
        }
        let own = skin.chain(cell.bus).row_of(pose.joint).unwrap_or_default();
        let row = if cell.joint == pose.joint { cell.row } else { own };
        let change = arm.between(own, row);
        let placed = pose.seen_from((&change.rotation, &change.translation.vector));
        let quaternion = placed.rotation.quaternion();
        let sign = if quaternion.w < 0.0 { -1.0 } else { 1.0 };
        let same_link = cell.joint == pose.joint;
        let way = (placed.position - Vector3::from(cell.position)).norm();
        let turn = (placed.rotation * Vector3::z()).angle(&Vector3::from(cell.normal));
        self.found = Some(Found {
            joint: pose.joint,
            row,
            position: placed.position.map(|part| rounded(part, 5)).into(),
            orientation: [quaternion.i, quaternion.j, quaternion.k, quaternion.w]
                .map(|part| rounded(part * sign, 6)),
            position_mm: rounded(pose.position_95() * 1e3, 2),
            orientation_deg: rounded(pose.turn_95().to_degrees(), 2),
            moved_mm: same_link.then(|| rounded(way * 1e3, 2)),
            turned_deg: same_link.then(|| rounded(turn.to_degrees(), 2)),
        });
    }
}

impl Pose {
    /// The radius within which the position is, 95 of 100 times, in m.
    #[must_use]
    pub fn position_95(&self) -> f64 {
        radius_95(&self.position_covariance)
    }

    /// The angle within which the orientation is, 95 of 100 times, in rad.
    #[must_use]
    pub fn turn_95(&self) -> f64 {
        radius_95(&self.turn_covariance)
    }

    /// Whether it is certain enough to be used.
    #[must_use]
    pub fn is_determined(&self) -> bool {
        let [position, turn] = ENOUGH;
        self.position_95() < position && self.turn_95() < turn
    }

    /// The same, seen from another frame of the same link.
    pub(crate) fn seen_from(&self, (turn, shift): (&UnitQuaternion<f64>, &Vector3<f64>)) -> Self {
        let matrix: Matrix3<f64> = turn.to_rotation_matrix().matrix().to_owned();
        Self {
            position: turn * self.position + shift,
            rotation: turn * self.rotation,
            position_covariance: matrix * self.position_covariance * matrix.transpose(),
            ..*self
        }
    }
}

/// The radius within which a normal vector is, 95 of 100 times: the sum of squares is taken for a scaled chi-squared number
/// with the same mean and variance (Welch and Satterthwaite), of which Wilson and Hilferty know the quantile.
fn radius_95(covariance: &Matrix3<f64>) -> f64 {
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
    pub(crate) fn of(cells: &[CellResult], wires: usize, joints: Disturbance) -> Self {
        let median = |pick: &dyn Fn(&CellResult) -> Option<f64>| {
            let mut all: Vec<_> = cells.iter().filter(|cell| cell.is_written()).filter_map(pick).collect();
            all.sort_by(f64::total_cmp);
            all.get(all.len() / 2).copied()
        };
        Self {
            cells: cells.len(),
            determined: cells.iter().filter(|cell| cell.is_written()).count(),
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
        let of = |variances: [f64; 3]| radius_95(&Matrix3::from_diagonal(&Vector3::from(variances)));
        assert!((of([1.0, 1.0, 1.0]) - 7.815_f64.sqrt()).abs() < 0.01);
        assert!((of([1.0, 1.0, 0.0]) - 5.991_f64.sqrt()).abs() < 0.02);
        assert!((of([4.0, 0.0, 0.0]) - 2.0 * 1.96).abs() < 0.06);
        assert!(of([0.0; 3]).abs() < 1e-12);
    }
}
