//! Chains: the joints between two links of a robot, their Denavit-Hartenberg rows, and the frame of each link.

mod build;
mod path;

use nalgebra::Isometry3;
use protocol::parameters::RowKind;
use protocol::skin::{ChainRow, JointKind};

use crate::error::{RobotError, RobotProblem};
use crate::nearest::nearest_names;
use crate::rows::{DhRow, frames};
use crate::urdf::Urdf;

pub(crate) use path::{CarriedLink, frames_after_joints};

/// A chain: the joints between two links of a robot, with their Denavit-Hartenberg rows.
#[derive(Clone, Debug, PartialEq)]
pub struct UrdfChain {
    /// Name of the link at the start, which does not move.
    pub root: String,
    /// Name of the link at the end.
    pub tip: String,
    /// The moving joints from root to tip; 1 to [`protocol::parameters::MAX_JOINTS`].
    pub joints: Vec<ChainJoint>,
    /// The rows from root to tip; at most [`protocol::parameters::MAX_ROWS`]. Rows with a joint are in the order of
    /// `joints`.
    pub rows: Vec<DhRow>,
    /// The transform from the root link's frame to frame 0, whose z axis is the axis of the first joint.
    pub base: Isometry3<f64>,
    /// The transform from the robot's root link to the root of the chain, with the joints between them at rest.
    pub below: Isometry3<f64>,
    /// The largest difference found between the kinematics of the rows and that of the URDF, in m or rad.
    pub residual: f64,
    /// The links that move with the chain and their positions on it, those of the path first.
    carried: Vec<(String, LinkFrame)>,
    /// The links that do not move with the chain, each with the reason.
    apart: Vec<(String, NotCarried)>,
    /// Name of the URDF file.
    file: String,
}

/// A moving joint.
#[derive(Clone, Debug, PartialEq)]
pub struct ChainJoint {
    /// Name of the joint.
    pub name: String,
    /// Kind of the joint: revolute or prismatic.
    pub kind: JointKind,
    /// The minimum and maximum position in rad or m; -pi and pi for a continuous joint.
    pub limits: [f64; 2],
    /// The maximum speed in rad/s or m/s; `None` if the URDF gives none above zero.
    pub max_speed: Option<f64>,
}

/// The place of a link on a chain: the row that carries it, and its transform.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkFrame {
    /// Number of the last joint before the link, from 1.
    pub joint: usize,
    /// Number of the row to whose frame the link is fixed, from 1. Several rows may move with the link; this is the one
    /// whose origin is nearest.
    pub row: usize,
    /// The transform from the frame of that row to the frame of the link.
    pub frame: Isometry3<f64>,
}

/// The reason for which a link cannot carry a cell of the chain.
#[derive(Clone, Debug, PartialEq)]
enum NotCarried {
    /// The link is before the first joint.
    Still,
    /// A joint that is not in the chain moves the link. The value is the name of the joint.
    MovedBy(String),
    /// The link is not below the root of the chain.
    Elsewhere,
}

impl UrdfChain {
    /// Returns the place of a link on the chain. The link must be after the first joint, on the path or fixed to it.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the link does not exist, or does not move with the chain.
    pub fn link(&self, link: &str) -> Result<LinkFrame, RobotError> {
        if let Some((_, found)) = self.carried.iter().find(|(name, _)| name == link) {
            return Ok(*found);
        }
        let (root, tip) = (self.root.clone(), self.tip.clone());
        let apart = self.apart.iter().find(|(name, _)| name == link).map(|(_, apart)| apart);
        let link = link.to_owned();
        let problem = match apart {
            None => {
                let names = self.carried.iter().map(|(name, _)| name.as_str());
                RobotProblem::NoSuchLink { nearest: nearest_names(&link, names), link }
            }
            Some(NotCarried::Still) => {
                let joint = self.joints.first().map_or_else(String::new, |joint| joint.name.clone());
                RobotProblem::BeforeFirstJoint { link, joint }
            }
            Some(NotCarried::MovedBy(joint)) => {
                RobotProblem::OutsideChain { link, joint: joint.clone(), root, tip }
            }
            Some(NotCarried::Elsewhere) => RobotProblem::AboveChain { link, root },
        };
        Err(RobotError::new(&self.file, None, problem))
    }

    /// Returns the links that can carry a cell, with their places on the chain: those of the path first, then those
    /// fixed to it.
    pub fn links(&self) -> impl Iterator<Item = (&str, LinkFrame)> {
        self.carried.iter().map(|(name, frame)| (name.as_str(), *frame))
    }

    /// Returns the frames 0 to `rows.len()` in the coordinates of the root link, with the joints at `positions` in rad
    /// or m.
    #[must_use]
    pub fn frames(&self, positions: &[f64]) -> Vec<Isometry3<f64>> {
        frames(&self.base, &self.rows, positions)
    }

    /// Returns the rows in the form of a skin's chain, with the limits of their joints.
    #[must_use]
    pub fn chain_rows(&self) -> Vec<ChainRow> {
        let mut joints = self.joints.iter();
        let row = |row: &DhRow| {
            let joint = if row.kind == RowKind::Fixed { None } else { joints.next() };
            row.with_limits(joint.map_or([0.0; 2], |joint| joint.limits))
        };
        self.rows.iter().map(row).collect()
    }

    /// Returns the minimum and maximum position of each joint in rad or m, in the order of the joints.
    #[must_use]
    pub fn limits(&self) -> Vec<[f64; 2]> {
        self.joints.iter().map(|joint| joint.limits).collect()
    }
}

impl Urdf {
    /// Builds the chain from a link, or from the robot's root, to another link below it.
    ///
    /// # Errors
    /// Returns [`RobotError`] if one of the links does not exist or the tip is not below the root. Returns it if a
    /// joint between the links is not revolute, continuous, prismatic or fixed, mimics another joint, or has limits
    /// between which it cannot move. Also returns it if the chain has no moving joint, too many joints, or a reach of 2
    /// m or more, or if the rows do not reproduce the URDF.
    pub fn chain(&self, root: Option<&str>, tip: &str) -> Result<UrdfChain, RobotError> {
        build::build(self, root, tip)
    }
}
