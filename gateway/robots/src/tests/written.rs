//! URDF files that the tests write.

use core::f64::consts::FRAC_PI_2;
use core::fmt::Write;

/// Pi / 2 as written in many files: 1.57079632679.
pub(crate) const TWELVE_DIGITS: f64 = FRAC_PI_2 - 4.9e-12;

/// Pi / 2 as written in other files: 1.5708.
pub(crate) const FIVE_DIGITS: f64 = FRAC_PI_2 + 3.673_205e-6;

/// A joint of a chain in a written URDF.
#[derive(Clone, Debug)]
pub(crate) struct TestJoint {
    pub(crate) kind: &'static str,
    pub(crate) xyz: [f64; 3],
    pub(crate) rpy: [f64; 3],
    pub(crate) axis: [f64; 3],
    pub(crate) limits: [f64; 2],
}

impl TestJoint {
    /// Returns a revolute joint about z with limits of -1 and 1 rad.
    pub(crate) fn hinge(xyz: [f64; 3], rpy: [f64; 3]) -> Self {
        Self { kind: "revolute", xyz, rpy, axis: [0.0, 0.0, 1.0], limits: [-1.0, 1.0] }
    }

    /// Returns a prismatic joint along z, with a range of 0.2 m.
    pub(crate) fn slide(xyz: [f64; 3], rpy: [f64; 3]) -> Self {
        Self { kind: "prismatic", limits: [-0.1, 0.1], ..Self::hinge(xyz, rpy) }
    }

    pub(crate) fn fixed(xyz: [f64; 3], rpy: [f64; 3]) -> Self {
        Self { kind: "fixed", axis: [0.0; 3], ..Self::hinge(xyz, rpy) }
    }

    /// Returns the joint with another axis.
    pub(crate) fn axis(self, axis: [f64; 3]) -> Self {
        Self { axis, ..self }
    }
}

/// Returns a robot with these joints in a row: joint `j1` moves link `l1`, and so on, from link `l0`.
pub(crate) fn robot(joints: &[TestJoint]) -> String {
    let mut inner = "<link name=\"l0\"/>\n".to_owned();
    for (index, joint) in joints.iter().enumerate() {
        let ([x, y, z], [roll, pitch, yaw], [u, v, w]) = (joint.xyz, joint.rpy, joint.axis);
        let (kind, [lower, upper], number) = (joint.kind, joint.limits, index + 1);
        writeln!(
            inner,
            "<link name=\"l{number}\"/>
<joint name=\"j{number}\" type=\"{kind}\">
  <parent link=\"l{index}\"/><child link=\"l{number}\"/>
  <origin xyz=\"{x:e} {y:e} {z:e}\" rpy=\"{roll:e} {pitch:e} {yaw:e}\"/><axis xyz=\"{u:e} {v:e} {w:e}\"/>
  <limit lower=\"{lower:e}\" upper=\"{upper:e}\" velocity=\"1.5\" effort=\"9\"/>
</joint>"
        )
        .unwrap();
    }
    wrap(&inner)
}

/// Returns a robot with these links and joints.
pub(crate) fn wrap(inner: &str) -> String {
    format!("<?xml version=\"1.0\"?>\n<robot name=\"test\">\n{inner}</robot>\n")
}
