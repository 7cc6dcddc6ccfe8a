//! The path of a chain through its URDF, and the links that are fixed to the path.

use nalgebra::Isometry3;
use protocol::skin::JointKind;

use crate::error::{RobotError, RobotProblem};
use crate::urdf::{Urdf, UrdfJoint, UrdfJointKind};

/// A link that moves with a chain.
pub(crate) struct CarriedLink {
    /// The name of the link.
    pub(crate) link: String,
    /// Number of moving joints of the chain between the root and this link.
    pub(crate) joint: usize,
    /// The constant transform to this link from the link directly after the last of these joints, or from the root.
    pub(crate) fixed: Isometry3<f64>,
}

/// Returns the joints from the root to the tip.
pub(super) fn path(urdf: &Urdf, root: usize, tip: usize) -> Result<Vec<&UrdfJoint>, RobotError> {
    let mut path = Vec::new();
    if root == tip {
        return Ok(path);
    }
    for joint in urdf.joints_above(tip) {
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

/// Returns the kind of a joint on a path; `None` if the joint is fixed.
pub(super) fn motion_kind(joint: &UrdfJoint) -> Option<JointKind> {
    match joint.kind {
        UrdfJointKind::Revolute | UrdfJointKind::Continuous => Some(JointKind::Revolute),
        UrdfJointKind::Prismatic => Some(JointKind::Prismatic),
        UrdfJointKind::Fixed | UrdfJointKind::Floating | UrdfJointKind::Planar => None,
    }
}

/// Returns the frame of the link directly after each moving joint of the path, in the coordinates of the root. Joints
/// without a value in `positions` are at zero.
pub(crate) fn frames_after_joints(path: &[&UrdfJoint], positions: &[f64]) -> Vec<Isometry3<f64>> {
    let mut positions = positions.iter();
    let mut pose = Isometry3::identity();
    let mut all = Vec::new();
    for joint in path {
        if motion_kind(joint).is_some() {
            pose *= joint.transform(positions.next().copied().unwrap_or_default());
            all.push(pose);
        } else {
            pose *= joint.origin;
        }
    }
    all
}
