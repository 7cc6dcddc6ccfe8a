//! Writes a URDF for the chains of a skin, for skins that do not name a URDF.
//!
//! Each row becomes one joint. The origin of the joint is the constant part of the row before it, `Rz(theta_offset)
//! Tz(d) Tx(a) Rx(alpha)`, and the axis is z. After the last row there is a link `tip`. Chains that begin with the same
//! joints and rows share links. If two chains have a joint in different places, the joint of the second chain is
//! written as another joint that mimics the first.

use core::fmt::Write;

use nalgebra::{UnitQuaternion, Vector3};
use protocol::parameters::RowKind;
use protocol::skin::{JointKind, Skin};
use protocol::xml::escaped;

use crate::rows::{DhRow, chain_base_pose};
use crate::taken::chain_prefixes;

/// Name of the link that is the base of all chains.
const BASE_LINK: &str = "base";
/// Radius of the cylinders that stand for segments, in m.
const SEGMENT_RADIUS_M: f64 = 0.04;
/// Minimum length of a segment that is drawn, in m.
const MIN_DRAWN_LENGTH_M: f64 = 1e-3;
/// The effort limit in Nm or N. URDF requires one, and a skin has none.
const EFFORT_LIMIT: f64 = 1000.0;

/// A written URDF, and the names of its links.
#[derive(Clone, Debug, PartialEq)]
pub struct WrittenUrdf {
    /// The text of the URDF.
    pub xml: String,
    /// For each chain, the names of the links that its joints move.
    pub links: Vec<Vec<String>>,
}

/// The origin of a URDF joint: the transform from the parent link, with lengths in m and roll, pitch and yaw in rad.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Origin {
    xyz: [f64; 3],
    rpy: [f64; 3],
}

impl Origin {
    /// Returns the pose of a row at joint position 0, as the origin of a URDF joint.
    fn from_row(row: &DhRow) -> Self {
        let (sine, cosine) = row.theta_offset.sin_cos();
        Self { xyz: [row.a * cosine, row.a * sine, row.d], rpy: [row.alpha, 0.0, row.theta_offset] }
    }

    fn of_base(base: &protocol::skin::ChainBase) -> Self {
        let pose = chain_base_pose(base);
        Self { xyz: pose.translation.vector.into(), rpy: pose.rotation.euler_angles().into() }
    }

    fn origin_xml(&self) -> String {
        format!("<origin xyz=\"{}\" rpy=\"{}\"/>", format_three(self.xyz), format_three(self.rpy))
    }
}

fn format_three(numbers: [f64; 3]) -> String {
    // Adding zero removes the sign of a negative zero.
    numbers.map(|number| format!("{}", number + 0.0)).join(" ")
}

/// A joint to write, and the link that it moves.
struct WrittenJoint {
    parent: String,
    origin: Origin,
    /// Index of the robot's joint; `None` if the joint is fixed.
    moved: Option<usize>,
    link: String,
    /// The attributes and contents of the joint element, without origin and links.
    name: String,
    kind: &'static str,
    inner: String,
}

/// Writes a URDF for the chains of a skin.
#[must_use]
pub fn write_urdf(skin: &Skin) -> WrittenUrdf {
    let robot = &skin.robot;
    let mut joints: Vec<WrittenJoint> = Vec::new();
    let mut links = Vec::new();
    for (chain, word) in robot.chains.iter().zip(chain_prefixes(skin)) {
        let prefix = if word.is_empty() { word } else { word + "_" };
        let (mut parent, mut origin) = (BASE_LINK.to_owned(), Origin::of_base(&chain.base));
        let (mut of_chain, mut moving) = (Vec::new(), chain.joints.iter());
        for (index, row) in chain.rows.iter().enumerate() {
            let moved = if row.kind == RowKind::Fixed { None } else { moving.next().copied() };
            let number = of_chain.len() + usize::from(moved.is_some());
            let shared =
                joints.iter().find(|it| (&it.parent, it.origin, it.moved) == (&parent, origin, moved));
            let link = if let Some(shared) = shared {
                shared.link.clone()
            } else {
                let fixed = moved.is_none().then(|| format!("_row{}", index + 1));
                let link = format!("{prefix}link{number}{}", fixed.unwrap_or_default());
                let joint = joint_to_write(skin, &joints, (parent, origin, moved), link.clone());
                joints.push(joint);
                link
            };
            if moved.is_some() {
                of_chain.push(link.clone());
            }
            (parent, origin) = (link, Origin::from_row(&DhRow::from(row)));
        }
        joints.push(joint_to_write(skin, &joints, (parent, origin, None), format!("{prefix}tip")));
        links.push(of_chain);
    }
    WrittenUrdf { xml: urdf_xml(&robot.name, &joints), links }
}

/// Returns the joint to write between a link and a new link.
fn joint_to_write(
    skin: &Skin,
    before: &[WrittenJoint],
    (parent, origin, moved): (String, Origin, Option<usize>),
    link: String,
) -> WrittenJoint {
    let robot = &skin.robot;
    let known = moved.and_then(|index| Some((index, robot.joints.get(index)?)));
    let Some((index, joint)) = known else {
        let names = || robot.joints.iter().map(|joint| &joint.name);
        let mut name = format!("{link}_fixed");
        while names().any(|it| *it == name) {
            name.push('_');
        }
        return WrittenJoint { parent, origin, moved, link, name, kind: "fixed", inner: String::new() };
    };
    let [lower, upper] = joint.limits;
    let speed = skin.controller.max_speed.get(index).copied().unwrap_or(1.0);
    let mut inner = format!(
        "    <axis xyz=\"0 0 1\"/>\n    <limit lower=\"{lower}\" upper=\"{upper}\" velocity=\"{speed}\" effort=\"{EFFORT_LIMIT}\"/>\n"
    );
    let mut name = joint.name.clone();
    if before.iter().any(|it| it.moved == moved) {
        let _ = writeln!(inner, "    <mimic joint=\"{}\"/>", escaped(&name));
        name = format!("{name}_of_{link}");
        while robot.joints.iter().any(|it| it.name == name) {
            name.push('_');
        }
    }
    let kind = match joint.kind {
        JointKind::Revolute => "revolute",
        JointKind::Prismatic => "prismatic",
    };
    WrittenJoint { parent, origin, moved, link, name, kind, inner }
}

fn urdf_xml(name: &str, joints: &[WrittenJoint]) -> String {
    let name = escaped(if name.is_empty() { "robot" } else { name });
    let mut out = format!(
        "<?xml version=\"1.0\"?>\n<robot name=\"{name}\">\n  <material name=\"grey\"><color rgba=\"0.6 0.6 0.6 1\"/></material>\n"
    );
    for link in core::iter::once(BASE_LINK).chain(joints.iter().map(|joint| joint.link.as_str())) {
        let _ = writeln!(out, "  <link name=\"{link}\">");
        write_shape(&mut out, [0.0; 3], [0.0; 3], &format!("<sphere radius=\"{SEGMENT_RADIUS_M}\"/>"));
        for joint in joints.iter().filter(|joint| joint.parent == link) {
            write_segment(&mut out, joint.origin.xyz);
        }
        out.push_str("  </link>\n");
    }
    for WrittenJoint { parent, origin, link, name, kind, inner, .. } in joints {
        let name = escaped(name);
        let _ = write!(
            out,
            "  <joint name=\"{name}\" type=\"{kind}\">\n    <parent link=\"{parent}\"/>\n    <child link=\"{link}\"/>\n    \
             {}\n{inner}  </joint>\n",
            origin.origin_xml()
        );
    }
    out.push_str("</robot>\n");
    out
}

/// Writes a shape for the segment between the origin of a link and the next joint.
fn write_segment(out: &mut String, to: [f64; 3]) {
    let way = Vector3::from(to);
    let length = way.norm();
    if length < MIN_DRAWN_LENGTH_M {
        return;
    }
    let turn = UnitQuaternion::rotation_between(&Vector3::z(), &way)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), core::f64::consts::PI));
    let cylinder = format!("<cylinder radius=\"{SEGMENT_RADIUS_M}\" length=\"{length}\"/>");
    write_shape(out, (way / 2.0).into(), turn.euler_angles().into(), &cylinder);
}

fn write_shape(out: &mut String, xyz: [f64; 3], rpy: [f64; 3], geometry: &str) {
    let origin = Origin { xyz, rpy }.origin_xml();
    let _ = writeln!(
        out,
        "    <visual>{origin}<geometry>{geometry}</geometry><material name=\"grey\"/></visual>"
    );
}
