//! The robot in a recording: its description, the poses of its links, and the positions of cells on them.

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use protocol::skin::{Cell, Chain, Skin};
use robots::{DhRow, LinkPose, RobotError, RobotProblem, Urdf, chain_base_pose, frames, write_urdf};

use crate::ros2::robot::Transform;

/// The maximum distance between a row of the skin and the link of the description that should match it, in m.
const TOLERANCE_M: f64 = 1e-6;
/// The distance by which each joint is moved to compare the skin with the description, in rad or m.
const COMPARISON_STEP: f64 = 0.3;

/// The robot as it is described in a recording.
#[derive(Clone, Debug)]
pub struct RecordedRobot {
    /// The robot description: a URDF.
    pub description: String,
    base: String,
    poses: Vec<LinkPose>,
    /// By chain: the name of the link that each joint of the chain moves.
    links: Vec<Vec<String>>,
    /// The cells: the link, the cell's own frame, and the pose of that frame on the link.
    cells: Vec<(String, String, Isometry3<f64>)>,
}

/// A URDF, the poses of its links, and the names of its links.
struct LinkedUrdf {
    urdf: Urdf,
    poses: Vec<LinkPose>,
    links: Vec<Vec<String>>,
}

impl RecordedRobot {
    /// Describes the robot of a skin by its Denavit-Hartenberg rows.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the rows cannot be described, for example if chains share a joint that has different
    /// Returns [`RobotError`] if the rows cannot be described as a URDF, for example if two chains share a joint that
    /// has different
    pub fn from_rows(skin: &Skin) -> Result<Self, RobotError> {
        let written = write_urdf(skin);
        let urdf = Urdf::parse("the skin's robot", &written.xml)?;
        Self::new(skin, urdf, written.xml, written.links)
    }

    /// Describes the robot of a skin by its URDF.
    ///
    /// # Errors
    /// Returns [`RobotError`] if the URDF does not match the skin's rows.
    pub fn from_urdf(skin: &Skin, urdf: Urdf, text: String) -> Result<Self, RobotError> {
        let link = |joint: &usize| {
            let name = skin.robot.joints.get(*joint).map_or("", |joint| &joint.name);
            urdf.link_moved_by(name).map(str::to_owned)
        };
        let links = skin.robot.chains.iter().map(|chain| chain.joints.iter().map(link).collect());
        let links = links.collect::<Result<Vec<_>, _>>()?;
        Self::new(skin, urdf, text, links)
    }

    fn new(
        skin: &Skin,
        urdf: Urdf,
        description: String,
        links: Vec<Vec<String>>,
    ) -> Result<Self, RobotError> {
        let names: Vec<_> = skin.robot.joints.iter().map(|joint| joint.name.as_str()).collect();
        let poses = urdf.link_poses(&names)?;
        let base = urdf.root().to_owned();
        let described = LinkedUrdf { urdf, poses, links };
        let cells =
            skin.cells.iter().map(|cell| described.cell_frame(skin, cell)).collect::<Result<_, _>>()?;
        let LinkedUrdf { poses, links, .. } = described;
        Ok(Self { description, base, poses, links, cells })
    }

    /// Returns the name of the robot's root link.
    #[must_use]
    pub fn root_link_name(&self) -> &str {
        &self.base
    }

    /// Returns the name of the link that a joint moves. `chain` counts from 0 and `joint` from 1.
    #[must_use]
    pub fn link_moved_by(&self, (chain, joint): (usize, usize)) -> Option<&str> {
        self.links.get(chain)?.get(joint.checked_sub(1)?).map(String::as_str)
    }

    /// Returns the poses of all links that joints move, for the joint positions `q` in rad or m.
    #[must_use]
    pub fn moving_transforms(&self, q: &[f64]) -> Vec<Transform<'_>> {
        let moving = self.poses.iter().filter(|pose| pose.is_moved_by_joint());
        moving.map(|pose| transform(&pose.parent, &pose.child, &pose.pose_in_parent(q))).collect()
    }

    /// Returns the poses that never change: those of fixed links, and those of cells on their links.
    #[must_use]
    pub fn fixed_transforms(&self) -> Vec<Transform<'_>> {
        let links = self.poses.iter().filter(|pose| !pose.is_moved_by_joint());
        let links = links.map(|pose| transform(&pose.parent, &pose.child, &pose.pose_in_parent(&[])));
        links.chain(self.cells.iter().map(|(link, cell, pose)| transform(link, cell, pose))).collect()
    }
}

impl LinkedUrdf {
    /// Returns the link that a cell is on, the name of the cell's own frame, and the pose of that frame on the link.
    fn cell_frame(&self, skin: &Skin, cell: &Cell) -> Result<(String, String, Isometry3<f64>), RobotError> {
        let bus = skin.buses.get(cell.bus);
        let index = bus.map_or(0, |bus| bus.chain);
        let chain = skin.chain(cell.bus);
        let of_chain = usize::from(cell.joint).saturating_sub(1);
        let link = self.links.get(index).and_then(|links| links.get(of_chain)).map_or("", String::as_str);
        let near = |step: f64| -> Vec<f64> {
            let joints = skin.robot.joints.iter();
            joints.map(|joint| step.clamp(joint.limits[0], joint.limits[1])).collect()
        };
        let row = usize::from(cell.row);
        let [one, other] =
            [0.0, COMPARISON_STEP].map(|step| self.row_pose_on_link(link, chain, row, &near(step)));
        let apart = (one.translation.vector - other.translation.vector).norm()
            + one.rotation.angle_to(&other.rotation);
        if apart.is_nan() || apart > TOLERANCE_M {
            let joint = chain.joints.get(of_chain).and_then(|joint| skin.robot.joints.get(*joint));
            let joint = joint.map_or_else(String::new, |joint| joint.name.clone());
            let problem = Box::new(RobotProblem::OtherRows { joint, chain: chain.name.clone() });
            return Err(RobotError { file: self.urdf.file.clone(), line: None, problem });
        }
        let normal = Vector3::from(cell.normal);
        // The skin does not define the rotation of a cell about its normal.
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &normal)
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), core::f64::consts::PI));
        let place = Isometry3::from_parts(Point3::from(cell.position).into(), turn);
        let name = format!("{}/{}", bus.map_or("", |bus| &bus.name), cell.node);
        Ok((link.to_owned(), name, one * place))
    }

    /// Returns the pose of a row's frame relative to a link, for the joint positions `q`.
    fn row_pose_on_link(&self, link: &str, chain: &Chain, row: usize, q: &[f64]) -> Isometry3<f64> {
        let of_chain: Vec<_> =
            chain.joints.iter().map(|joint| q.get(*joint).copied().unwrap_or_default()).collect();
        let rows: Vec<_> = chain.rows.iter().map(DhRow::from).collect();
        let frames = frames(&chain_base_pose(&chain.base), &rows, &of_chain);
        let frame = frames.get(row).copied().unwrap_or_else(Isometry3::identity);
        let (mut pose, mut at) = (Isometry3::identity(), link);
        while let Some(above) = self.poses.iter().find(|pose| pose.child == at) {
            pose = above.pose_in_parent(q) * pose;
            at = &above.parent;
        }
        pose.inverse() * frame
    }
}

fn transform<'a>(parent: &'a str, child: &'a str, pose: &Isometry3<f64>) -> Transform<'a> {
    Transform {
        parent,
        child,
        translation: pose.translation.vector.into(),
        rotation: pose.rotation.coords.into(),
    }
}

#[cfg(test)]
mod tests;
