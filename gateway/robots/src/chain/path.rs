//! The path of a chain in its URDF, and the links fixed to it.

use nalgebra::Isometry3;
use protocol::skin::JointKind;

use crate::error::{RobotProblem, RobotError};
use crate::urdf::{UrdfJointKind, Urdf, UrdfJoint};

/// A link that moves with a chain.
pub(crate) struct CarriedLink {
    /// The name of the link.
    pub(crate) link: String,
    /// The number of moving joints of the chain before it.
    pub(crate) joint: usize,
    /// The constant transform from the link after that joint (or the root) to this one.
    pub(crate) fixed: Isometry3<f64>,
}

/// Returns the joints from the root to the tip.
pub(super) fn path(urdf: &Urdf, root: usize, tip: usize) -> Result<Vec<&UrdfJoint>, RobotError> {
    let mut path = Vec::new();
    if root == tip {
        return Ok(path);
    }
    for joint in urdf.above(tip) {
        path.push(joint);
        if joint.parent == root {
            path.reverse();
            return Ok(path);
        }
    }
    let mut names: Vec<_> = path.iter().rev().map(|joint| urdf.link_name(joint.parent)).collect();
    names.push(urdf.link_name(tip));
    let [root, tip] = [root, tip].map(|link| urdf.link_name(link).to_owned());
    Err(urdf.error(RobotProblem::NotBelow { tip, root, path: names.join(" > ") }))
}

/// Returns the motion of a joint on a path; `None` if it is fixed.
pub(super) fn moves(joint: &UrdfJoint) -> Option<JointKind> {
    match joint.kind {
        UrdfJointKind::Revolute | UrdfJointKind::Continuous => Some(JointKind::Revolute),
        UrdfJointKind::Prismatic => Some(JointKind::Prismatic),
        UrdfJointKind::Fixed | UrdfJointKind::Floating | UrdfJointKind::Planar => None,
    }
}

/// Returns the frames of the links directly after the moving joints of the path, in the root's coordinates. Joints
/// without a position are at zero.
pub(crate) fn behind(path: &[&UrdfJoint], positions: &[f64]) -> Vec<Isometry3<f64>> {
    let mut positions = positions.iter();
    let mut pose = Isometry3::identity();
    let mut all = Vec::new();
    for joint in path {
        if moves(joint).is_some() {
            pose *= joint.transform(positions.next().copied().unwrap_or_default());
            all.push(pose);
        } else {
            pose *= joint.origin;
        }
    }
    all
}
