//! Tests with files whose contents are unusual but valid, and must be read correctly.

use core::f64::consts::PI;

use crate::{Geometry, Urdf};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::common::difference;
use super::written::wrap;

const FILE: &str = r#"
<link name="base"> <visual/> </link>
<link name=" arm ">
  <visual name="shell">
    <origin xyz=" 0.1
      0.2	0.3 " rpy="0 0 1.5"/>
    <geometry><mesh filename="package://x/Arm.STL" scale="1 -1 0.001"/></geometry>
    <material name="grey"/>
  </visual>
  <visual><geometry><!-- a box --> <box size="1 2 3"/></geometry></visual>
  <visual><geometry><cylinder radius="0.1" length="0.5"/></geometry></visual>
  <visual><geometry><capsule radius="0.1" length="0.5"/></geometry></visual>
  <collision><geometry><sphere radius="0.25"/></geometry></collision>
  <collision><geometry><mesh filename="file:///arm.dae"/></geometry></collision>
</link>
<link name="hand"/>
<link name="tool"/>
<transmission name="t"><joint name="turn"><hardwareInterface>Effort</hardwareInterface></joint><joint name="ghost"/></transmission>
<gazebo><link name="ghost"/></gazebo>
<joint name="turn" type="continuous">
  <parent link="base"/><child link="arm"/>
  <limit lower="-0.1" upper="0.1" velocity=" 2.5 " effort="1"/>
</joint>
<joint name="lift" type="prismatic">
  <origin xyz="0 0 1" rpy="0.1 0.2 0.3"/>
  <parent link="arm"/><child link="hand"/><axis xyz="0 0 1.0000004"/><limit lower="0" upper="+0.5"/>
  <safety_controller soft_lower_limit="0" soft_upper_limit="0.1"/>
</joint>
<joint name="weld" type="fixed"><parent link="hand"/><child link="tool"/><axis xyz="0 0 0"/></joint>
"#;

#[test]
fn a_file_is_read_as_its_format_says() {
    let urdf = Urdf::parse("t.urdf", &wrap(FILE)).unwrap();
    assert_eq!((urdf.name.as_str(), urdf.root()), ("test", "base"));
    assert_eq!(urdf.links().collect::<Vec<_>>(), ["base", "arm", "hand", "tool"]);
    assert_eq!(urdf.leaves().collect::<Vec<_>>(), ["tool"]);
    let chain = urdf.chain(None, "tool").unwrap();
    // A continuous joint has no limits, even if the file gives some.
    assert_eq!(chain.limits(), [[-PI, PI], [0.0, 0.5]]);
    assert_eq!(chain.joints[0].max_speed, Some(2.5));
    assert_eq!(chain.joints[1].max_speed, None);
    // The default axis is x. Angles are about fixed axes, x first. An axis is normalized.
    let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.7);
    let origin = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.3)
        * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.2)
        * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.1);
    let expected = Isometry3::from_parts(Translation3::identity(), turn)
        * Isometry3::from_parts(Translation3::new(0.0, 0.0, 1.0), origin)
        * Translation3::new(0.0, 0.0, 0.4);
    let position = |name: &str| if name == "turn" { 0.7 } else { 0.4 };
    assert!(difference(&urdf.pose("tool", &position).unwrap(), &expected) < 1e-15);
}

#[test]
fn shapes_are_read_with_their_place() {
    let urdf = Urdf::parse("t.urdf", &wrap(FILE)).unwrap();
    assert_eq!(urdf.visuals("base").unwrap(), []);
    let visuals = urdf.visuals("arm").unwrap();
    let geometries: Vec<_> = visuals.iter().map(|shape| shape.geometry.clone()).collect();
    assert_eq!(
        geometries,
        [
            Geometry::Mesh { path: "package://x/Arm.STL".to_owned(), scale: [1.0, -1.0, 0.001] },
            Geometry::Box { size: [1.0, 2.0, 3.0] },
            Geometry::Cylinder { radius: 0.1, length: 0.5 },
            Geometry::Other { element: "capsule".to_owned() },
        ]
    );
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 1.5);
    let origin = Isometry3::from_parts(Translation3::new(0.1, 0.2, 0.3), turn);
    assert!(difference(&visuals[0].origin, &origin) < 1e-15);
    assert!(difference(&visuals[1].origin, &Isometry3::identity()) < 1e-15);
    let collisions: Vec<_> =
        urdf.collisions("arm").unwrap().iter().map(|shape| shape.geometry.clone()).collect();
    let mesh = Geometry::Mesh { path: "file:///arm.dae".to_owned(), scale: [1.0; 3] };
    assert_eq!(collisions, [Geometry::Sphere { radius: 0.25 }, mesh]);
}

#[test]
fn a_joint_that_mimics_follows() {
    let joints = |mimic: &str| {
        wrap(&format!(
            r#"<link name="a"/><link name="b"/><link name="c"/>
<joint name="j" type="prismatic"><parent link="a"/><child link="b"/><limit lower="0" upper="1"/></joint>
<joint name="k" type="prismatic"><parent link="a"/><child link="c"/>{mimic}<limit lower="0" upper="1"/></joint>"#
        ))
    };
    let x = |mimic: &str| {
        let urdf = Urdf::parse("t.urdf", &joints(mimic)).unwrap();
        urdf.pose("c", &|name| if name == "j" { 0.5 } else { 0.125 }).unwrap().translation.x
    };
    let found = [x(""), x(r#"<mimic joint="j"/>"#), x(r#"<mimic joint="j" multiplier="-2" offset="0.25"/>"#)];
    assert_eq!(found.map(f64::to_bits), [0.125_f64, 0.5, -0.75].map(f64::to_bits));
}

/// A default namespace changes nothing; elements of another namespace do not belong to the robot.
#[test]
fn namespaces_are_kept_apart() {
    let inner = r#"<link name="a"/><s:link name="ghost"/>"#;
    for default in ["", "xmlns=\"http://drake.mit.edu\""] {
        let xml = format!("<robot {default} xmlns:s=\"sensors\">{inner}</robot>");
        assert_eq!(Urdf::parse("t.urdf", &xml).unwrap().links().collect::<Vec<_>>(), ["a"]);
    }
}
