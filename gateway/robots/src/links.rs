//! The poses of a robot's links relative to their parent links, for given positions of some joints.

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};

use crate::error::{RobotError, RobotProblem};
use crate::nearest::nearest_names;
use crate::urdf::{Urdf, UrdfJoint, UrdfJointKind};

/// The pose of a link relative to its parent link.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkPose {
    /// Name of the parent link.
    pub parent: String,
    /// Name of the link.
    pub child: String,
    /// The transform from the parent to the link, with the joint at position zero.
    origin: Isometry3<f64>,
    motion: Option<LinkMotion>,
}

/// The motion of a link relative to its parent, by a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
struct LinkMotion {
    /// Index of the joint in the list of given joints.
    joint: usize,
    slides: bool,
    axis: Unit<Vector3<f64>>,
    multiplier: f64,
    offset: f64,
}

impl LinkPose {
    /// Returns true if one of the given joints moves the link.
    #[must_use]
    pub const fn is_moved_by_joint(&self) -> bool {
        self.motion.is_some()
    }

    /// Returns the transform from the parent to the link, with the given joints at these positions in rad or m.
    #[must_use]
    pub fn pose_in_parent(&self, positions: &[f64]) -> Isometry3<f64> {
        let Some(LinkMotion { joint, slides, axis, multiplier, offset }) = self.motion else {
            return self.origin;
        };
        let position = multiplier * positions.get(joint).copied().unwrap_or_default() + offset;
        if slides {
            self.origin * Translation3::from(axis.into_inner() * position)
        } else {
            self.origin * UnitQuaternion::from_axis_angle(&axis, position)
        }
    }
}

impl Urdf {
    /// Returns the pose of each link except the root, relative to its parent. The given joints and those that mimic
    /// them move; all others are at rest.
    ///
    /// # Errors
    /// Returns [`RobotError`] if one of the joints does not exist, or does not move by itself.
    pub fn link_poses(&self, joints: &[&str]) -> Result<Vec<LinkPose>, RobotError> {
        for name in joints {
            self.moving_joint(name)?;
        }
        let place = |name: &str| joints.iter().position(|it| *it == name);
        let pose = |joint: &UrdfJoint| {
            let (of, multiplier, offset) = match &joint.mimic {
                Some(mimic) => (mimic.joint.as_str(), mimic.multiplier, mimic.offset),
                None => (joint.name.as_str(), 1.0, 0.0),
            };
            let slides = joint.kind == UrdfJointKind::Prismatic;
            let moves = matches!(
                joint.kind,
                UrdfJointKind::Revolute | UrdfJointKind::Continuous | UrdfJointKind::Prismatic
            );
            let motion = place(of).filter(|_| moves);
            let motion =
                motion.map(|of| LinkMotion { joint: of, slides, axis: joint.axis, multiplier, offset });
            let origin = match motion {
                Some(_) => joint.origin,
                None => joint.transform(multiplier * self.rest_position(of) + offset),
            };
            let name = |link| self.link_name(link).to_owned();
            LinkPose { parent: name(joint.parent), child: name(joint.child), origin, motion }
        };
        Ok(self.joints().iter().map(pose).collect())
    }

    /// Returns the name of the link that a joint moves.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the joint does not exist, or does not move by itself.
    pub fn link_moved_by(&self, joint: &str) -> Result<&str, RobotError> {
        Ok(self.link_name(self.moving_joint(joint)?.child))
    }

    fn moving_joint(&self, name: &str) -> Result<&UrdfJoint, RobotError> {
        let moves = |joint: &&UrdfJoint| {
            let kind = matches!(
                joint.kind,
                UrdfJointKind::Revolute | UrdfJointKind::Continuous | UrdfJointKind::Prismatic
            );
            kind && joint.mimic.is_none()
        };
        let found = self.joints().iter().filter(moves).find(|joint| joint.name == name);
        found.ok_or_else(|| {
            let names = self.joints().iter().filter(moves).map(|joint| joint.name.as_str());
            let nearest = nearest_names(name, names);
            self.error(RobotProblem::NoSuchJoint { joint: name.to_owned(), nearest })
        })
    }
}
