//! Chains: the joints between two links, with rows and the frame of each link.

mod build;
mod path;

use nalgebra::Isometry3;
use protocol::parameters::RowKind;
use protocol::skin::{ChainRow, JointKind};

use crate::error::{RobotProblem, RobotError};
use crate::nearest::nearest;
use crate::rows::{DhRow, frames};
use crate::urdf::Urdf;

pub(crate) use path::{CarriedLink, behind};

/// The joints between two links.
#[derive(Clone, Debug, PartialEq)]
pub struct UrdfChain {
    /// The fixed link at the start.
    pub root: String,
    /// The link at the end.
    pub tip: String,
    /// The moving joints from root to tip; 1 to [`protocol::parameters::MAX_JOINTS`].
    pub joints: Vec<ChainJoint>,
    /// The rows from root to tip; at most [`protocol::parameters::MAX_ROWS`]. Moving rows are in the order of `joints`.
    pub rows: Vec<DhRow>,
    /// The transform from the root link's frame to frame 0, whose z axis is that of the first joint.
    pub base: Isometry3<f64>,
    /// The transform from the URDF's root to the root link, with the joints between at rest.
    pub below: Isometry3<f64>,
    /// The largest difference found between rows and URDF, in m or rad.
    pub residual: f64,
    /// The links that move with the chain, those of the path first.
    carried: Vec<(String, LinkFrame)>,
    /// The links that do not move with the chain, each with the reason.
    apart: Vec<(String, NotCarried)>,
    /// The name of the file.
    file: String,
}

/// A moving joint.
#[derive(Clone, Debug, PartialEq)]
pub struct ChainJoint {
    /// The name.
    pub name: String,
    /// The kind of motion.
    pub kind: JointKind,
    /// The minimum and maximum position in rad or m; -pi and pi for a continuous joint.
    pub limits: [f64; 2],
    /// The maximum speed in rad/s or m/s; `None` unless the URDF has one above zero.
    pub max_speed: Option<f64>,
}

/// The position of a link on a chain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkFrame {
    /// The last joint before the link, from 1.
    pub joint: usize,
    /// The row whose frame the link is fixed to, from 1. Of the rows that move with the link, it is the one whose
    /// origin is nearest.
    pub row: usize,
    /// The transform from that row's frame to the link's.
    pub frame: Isometry3<f64>,
}

/// The reason why a link cannot carry a cell.
#[derive(Clone, Debug, PartialEq)]
enum NotCarried {
    /// The link is before the first joint.
    Still,
    /// This joint, which is not in the chain, moves the link.
    MovedBy(String),
    /// The link is not below the root.
    Elsewhere,
}

impl UrdfChain {
    /// Returns the position of a link after the first joint, on the path or fixed to it.
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
                RobotProblem::NoSuchLink { nearest: nearest(&link, names), link }
            }
            Some(NotCarried::Still) => {
                let joint = self.joints.first().map_or_else(String::new, |joint| joint.name.clone());
                RobotProblem::BeforeFirstJoint { link, joint }
            }
            Some(NotCarried::MovedBy(joint)) => RobotProblem::OutsideChain { link, joint: joint.clone(), root, tip },
            Some(NotCarried::Elsewhere) => RobotProblem::AboveChain { link, root },
        };
        Err(RobotError::new(&self.file, None, problem))
    }

    /// Returns the links that can carry a cell: those of the path first, then those fixed to it.
    pub fn links(&self) -> impl Iterator<Item = (&str, LinkFrame)> {
        self.carried.iter().map(|(name, frame)| (name.as_str(), *frame))
    }

    /// Returns the frames 0 to `rows.len()` in the root link's coordinates, with the joints at `positions` in rad or m.
    #[must_use]
    pub fn frames(&self, positions: &[f64]) -> Vec<Isometry3<f64>> {
        frames(&self.base, &self.rows, positions)
    }

    /// Returns the rows in the form of a skin's chain, with their joints' limits.
    #[must_use]
    pub fn chain_rows(&self) -> Vec<ChainRow> {
        let mut joints = self.joints.iter();
        let row = |row: &DhRow| {
            let joint = if row.kind == RowKind::Fixed { None } else { joints.next() };
            row.with_limits(joint.map_or([0.0; 2], |joint| joint.limits))
        };
        self.rows.iter().map(row).collect()
    }

    /// Returns the limits of the joints, in their order, in rad or m.
    #[must_use]
    pub fn limits(&self) -> Vec<[f64; 2]> {
        self.joints.iter().map(|joint| joint.limits).collect()
    }
}

impl Urdf {
    /// Builds the chain from a link, or from the robot's root, to another link below it.
    ///
    /// # Errors
    /// Returns [`RobotError`] if one of the links does not exist or the tip is not below the root; if a joint between
    /// them is not revolute, continuous, prismatic or fixed, mimics another one, or cannot move within its limits; if
    /// no joint moves or too many do; if the chain is too long; or if rows and URDF differ.
    pub fn chain(&self, root: Option<&str>, tip: &str) -> Result<UrdfChain, RobotError> {
        build::build(self, root, tip)
    }
}
