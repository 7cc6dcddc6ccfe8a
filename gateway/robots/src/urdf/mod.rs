//! A URDF file: links, joints and shapes, and the kinematics of the file itself.

mod read;
mod shape;
mod tree;
mod xml;

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};

use crate::error::{RobotError, RobotProblem};
use crate::nearest::nearest_names;

pub use shape::{Geometry, Shape};
pub use xml::decode_text;

/// A checked URDF. Its links form one tree, and each joint moves one link.
#[derive(Clone, Debug, PartialEq)]
pub struct Urdf {
    /// The name of the file, as it was given.
    pub file: String,
    /// The name of the robot; empty if it has none.
    pub name: String,
    /// The links, in the order of the file.
    links: Vec<UrdfLink>,
    /// The joints, in the order of the file.
    joints: Vec<UrdfJoint>,
    /// The index of the link without a parent.
    root: usize,
}

/// The shapes of a link. If one of them is invalid, this is the error, which is returned only when the shapes are used.
type ParsedShapes = Result<Vec<Shape>, RobotError>;

/// A link of the robot.
#[derive(Clone, Debug, PartialEq)]
struct UrdfLink {
    name: String,
    visuals: ParsedShapes,
    collisions: ParsedShapes,
    /// Index of the joint that moves the link; `None` for the root.
    parent: Option<usize>,
}

/// A joint of the robot, of any type.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct UrdfJoint {
    pub(crate) name: String,
    pub(crate) kind: UrdfJointKind,
    /// Index of the parent link.
    pub(crate) parent: usize,
    /// Index of the child link, which the joint moves.
    pub(crate) child: usize,
    /// The transform from the parent to the child, with the joint at position zero.
    pub(crate) origin: Isometry3<f64>,
    /// The axis in the coordinates of the child; z if the file gives none.
    pub(crate) axis: Unit<Vector3<f64>>,
    /// The lower and upper limit in rad or m, as in the file; a missing limit is zero.
    pub(crate) limits: [f64; 2],
    /// True if the file has a `limit` element with a lower or an upper limit.
    pub(crate) has_limit: bool,
    /// The maximum speed in rad/s or m/s, as in the file.
    pub(crate) velocity: Option<f64>,
    pub(crate) mimic: Option<Mimic>,
    /// Line of the joint in the file.
    pub(crate) line: u32,
}

/// The type of a joint.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum UrdfJointKind {
    Revolute,
    Continuous,
    Prismatic,
    Fixed,
    Floating,
    Planar,
}

/// The joint that another joint mimics, with factor and offset.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Mimic {
    pub(crate) joint: String,
    pub(crate) multiplier: f64,
    pub(crate) offset: f64,
}

impl UrdfJoint {
    /// Returns the transform from the parent to the child, with the joint at this position in rad or m. The position
    /// has no effect on floating and planar joints.
    pub(crate) fn transform(&self, position: f64) -> Isometry3<f64> {
        match self.kind {
            UrdfJointKind::Revolute | UrdfJointKind::Continuous => {
                self.origin * UnitQuaternion::from_axis_angle(&self.axis, position)
            }
            UrdfJointKind::Prismatic => self.origin * Translation3::from(self.axis.into_inner() * position),
            UrdfJointKind::Fixed | UrdfJointKind::Floating | UrdfJointKind::Planar => self.origin,
        }
    }

    /// Returns the name of the joint if it moves; `None` if it is fixed.
    pub(crate) fn name_if_moving(&self) -> Option<String> {
        (self.kind != UrdfJointKind::Fixed).then(|| self.name.clone())
    }
}

impl Urdf {
    /// Parses the text of a file. `file` names the file in errors. [`decode_text`] decodes bytes to text.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the text is not XML or not a URDF, if a value is not allowed, or if the links do not
    /// form one tree.
    pub fn parse(file: &str, xml: &str) -> Result<Self, RobotError> {
        read::read(file, xml)
    }

    /// Returns the link that has no parent.
    #[must_use]
    pub fn root(&self) -> &str {
        self.link_name(self.root)
    }

    /// Returns the names of the links, in the order of the file.
    pub fn links(&self) -> impl Iterator<Item = &str> {
        self.links.iter().map(|link| link.name.as_str())
    }

    /// Returns the links that no joint has as its parent: the ends of the tree, in the order of the file.
    pub fn leaves(&self) -> impl Iterator<Item = &str> {
        let is_leaf = |index: &usize| self.joints.iter().all(|joint| joint.parent != *index);
        let indices = (0..self.links.len()).filter(is_leaf);
        indices.filter_map(|index| self.links.get(index)).map(|link| link.name.as_str())
    }

    /// Returns the visual shapes of a link.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the link does not exist, or if one of its shapes is invalid.
    pub fn visuals(&self, link: &str) -> Result<&[Shape], RobotError> {
        self.find_link(link)?.1.visuals.as_deref().map_err(Clone::clone)
    }

    /// Returns the collision shapes of a link.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the link does not exist, or if one of its shapes is invalid.
    pub fn collisions(&self, link: &str) -> Result<&[Shape], RobotError> {
        self.find_link(link)?.1.collisions.as_deref().map_err(Clone::clone)
    }

    /// Returns the name of a link's parent; `None` for the root and for a link that does not exist.
    #[must_use]
    pub fn parent(&self, link: &str) -> Option<&str> {
        let (index, _) = self.find_link(link).ok()?;
        self.joints_above(index).next().map(|joint| self.link_name(joint.parent))
    }

    /// Returns the rest position of a joint in rad or m: zero, or the middle of its limits if zero is not between them.
    /// Returns zero for a joint that does not exist.
    #[must_use]
    pub fn rest_position(&self, joint: &str) -> f64 {
        let Some(joint) = self.joints.iter().find(|it| it.name == joint) else { return 0.0 };
        let [lower, upper] = joint.limits;
        let limited = matches!(joint.kind, UrdfJointKind::Revolute | UrdfJointKind::Prismatic);
        let middle = f64::midpoint(lower, upper);
        if limited && !(lower <= 0.0 && 0.0 <= upper) && middle.is_finite() { middle } else { 0.0 }
    }

    /// Returns the frame of a link in the coordinates of the root, by the kinematics of the file. `position` returns
    /// the position of the joint with the given name in rad or m. It is not called for joints that mimic others, nor
    /// does it affect floating and planar joints.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the link does not exist.
    pub fn pose(&self, link: &str, position: &dyn Fn(&str) -> f64) -> Result<Isometry3<f64>, RobotError> {
        let (index, _) = self.find_link(link)?;
        let transform = |joint: &UrdfJoint| match &joint.mimic {
            None => joint.transform(position(&joint.name)),
            Some(Mimic { joint: of, multiplier, offset }) => {
                joint.transform(multiplier * position(of) + offset)
            }
        };
        Ok(self.joints_above(index).map(transform).fold(Isometry3::identity(), |pose, joint| joint * pose))
    }

    /// Returns a link and its index, by its name.
    fn find_link(&self, name: &str) -> Result<(usize, &UrdfLink), RobotError> {
        let found = self.links.iter().enumerate().find(|(_, link)| link.name == name);
        found.ok_or_else(|| {
            self.error(RobotProblem::NoSuchLink {
                link: name.to_owned(),
                nearest: nearest_names(name, self.links()),
            })
        })
    }

    /// Returns the joints, in the order of the file.
    pub(crate) fn joints(&self) -> &[UrdfJoint] {
        &self.joints
    }

    /// Returns the index of the link with this name.
    pub(crate) fn index(&self, link: &str) -> Result<usize, RobotError> {
        Ok(self.find_link(link)?.0)
    }

    /// Returns the name of the link with this index.
    pub(crate) fn link_name(&self, index: usize) -> &str {
        self.links.get(index).map_or("", |link| &link.name)
    }

    /// Returns the joints between a link and the root, beginning with the joint that moves the link.
    pub(crate) fn joints_above(&self, link: usize) -> impl Iterator<Item = &UrdfJoint> {
        let up = move |link: usize| self.joints.get(self.links.get(link)?.parent?);
        core::iter::successors(up(link), move |joint| up(joint.parent))
    }

    /// Creates an error in this file without a line.
    pub(crate) fn error(&self, problem: RobotProblem) -> RobotError {
        RobotError::new(&self.file, None, problem)
    }

    /// Creates an error in this file at the line of a joint.
    pub(crate) fn error_at(&self, joint: &UrdfJoint, problem: RobotProblem) -> RobotError {
        RobotError::new(&self.file, Some(joint.line), problem)
    }
}
