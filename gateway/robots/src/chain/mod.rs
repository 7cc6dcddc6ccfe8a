//! The joints between two links, with rows and the frame of each link.

mod build;
mod path;

use nalgebra::Isometry3;
use protocol::parameters::RowKind;
use protocol::skin::{ChainRow, JointKind};

use crate::error::{Problem, RobotError};
use crate::nearest::nearest;
use crate::rows::{Row, frames};
use crate::urdf::Urdf;

pub(crate) use path::{Hanging, behind};

/// The joints between two links.
#[derive(Clone, Debug, PartialEq)]
pub struct Chain {
    /// The link that is held still.
    pub root: String,
    /// The link at the end.
    pub tip: String,
    /// The joints that move, from root to tip; 1 to [`protocol::parameters::MAX_JOINTS`].
    pub joints: Vec<Joint>,
    /// Rows, from root to tip; at most [`protocol::parameters::MAX_ROWS`]. Those that move are in the order of `joints`.
    pub rows: Vec<Row>,
    /// From the root link's frame to frame 0, whose z axis is the first joint's.
    pub base: Isometry3<f64>,
    /// From the URDF's root to the root link, with joints between at rest.
    pub below: Isometry3<f64>,
    /// The largest difference between rows and URDF that was found, in m or rad.
    pub residual: f64,
    /// The links that move with the chain, the path's first.
    carried: Vec<(String, LinkFrame)>,
    /// Links below the root that do not: the ones before the first joint, and the others.
    apart: Vec<(String, Apart)>,
    /// The file's name.
    file: String,
}

/// A joint that moves.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Its name.
    pub name: String,
    /// How it moves.
    pub kind: JointKind,
    /// Minimum and maximum position in rad or m; of a continuous joint -pi and pi.
    pub limits: [f64; 2],
    /// The maximum speed in rad/s or m/s, where the URDF has one above zero.
    pub max_speed: Option<f64>,
}

/// Where a link is on a chain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkFrame {
    /// The last joint before the link, from 1.
    pub joint: usize,
    /// The row whose frame the link is fixed to, from 1: of those from the joint's own on that move with the link, the one whose origin is
    /// nearest.
    pub row: usize,
    /// From that row's frame to the link's.
    pub frame: Isometry3<f64>,
}

/// Why a link cannot carry a cell.
#[derive(Clone, Debug, PartialEq)]
enum Apart {
    /// It is before the first joint.
    Still,
    /// This joint moves it, which is not in the chain.
    MovedBy(String),
    /// It is not below the root.
    Elsewhere,
}

impl Chain {
    /// Where a link is: one behind the first joint, on the path or fixed to it.
    ///
    /// # Errors
    /// When there is no such link, or when it does not move with the chain.
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
                Problem::NoSuchLink { nearest: nearest(&link, names), link }
            }
            Some(Apart::Still) => {
                let joint = self.joints.first().map_or_else(String::new, |joint| joint.name.clone());
                Problem::BeforeFirstJoint { link, joint }
            }
            Some(Apart::MovedBy(joint)) => Problem::OutsideChain { link, joint: joint.clone(), root, tip },
            Some(Apart::Elsewhere) => Problem::AboveChain { link, root },
        };
        Err(RobotError::new(&self.file, None, problem))
    }

    /// The links that can carry a cell: those of the path first, then those that are fixed to it.
    pub fn links(&self) -> impl Iterator<Item = (&str, LinkFrame)> {
        self.carried.iter().map(|(name, frame)| (name.as_str(), *frame))
    }

    /// The frames 0 to `rows.len()` in the root link's coordinates, with the joints at `positions` in rad or m.
    #[must_use]
    pub fn frames(&self, positions: &[f64]) -> Vec<Isometry3<f64>> {
        frames(&self.base, &self.rows, positions)
    }

    /// The rows as those of a skin's chain, with their joints' limits.
    #[must_use]
    pub fn chain_rows(&self) -> Vec<ChainRow> {
        let mut joints = self.joints.iter();
        let row = |row: &Row| {
            let joint = if row.kind == RowKind::Fixed { None } else { joints.next() };
            row.with_limits(joint.map_or([0.0; 2], |joint| joint.limits))
        };
        self.rows.iter().map(row).collect()
    }

    /// The joints' limits, in their order, in rad or m.
    #[must_use]
    pub fn limits(&self) -> Vec<[f64; 2]> {
        self.joints.iter().map(|joint| joint.limits).collect()
    }
}

impl Urdf {
    /// The chain from a link, or the robot's root, to another link below it.
    ///
    /// # Errors
    /// When one of the links does not exist or the tip is not below the root, when a joint between them is not revolute, continuous,
    /// prismatic or fixed, mimics another one or cannot move within its limits, when there is none that moves or there are too many,
    /// when the chain is too long, or when rows and URDF differ.
    pub fn chain(&self, root: Option<&str>, tip: &str) -> Result<Chain, RobotError> {
        build::build(self, root, tip)
    }
}
