use super::*;
use model::testing;

const ARM: &str = r#"<robot name="arm">
  <link name="world"/> <link name="upper"/> <link name="finger"/> <link name="other"/>
  <joint name="hinge" type="revolute">
    <parent link="world"/> <child link="upper"/> <origin xyz="0 0 0.5"/> <axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/>
  </joint>
  <joint name="grip" type="prismatic">
    <parent link="upper"/> <child link="finger"/> <axis xyz="1 0 0"/>
    <limit lower="0.02" upper="0.04" velocity="1" effort="1"/>
  </joint>
  <joint name="follows" type="prismatic">
    <parent link="upper"/> <child link="other"/> <axis xyz="1 0 0"/> <mimic joint="hinge" multiplier="0.1" offset="0.2"/>
  </joint>
</robot>"#;

/// Returns a skin with a cell at the end of the arm, whose only row begins at `height`.
fn skin(height: f64) -> Skin {
    let text = format!(
        r#"
[robot]
[[robot.joint]]
name = "hinge"
limits = [-2.0, 2.0]
[[robot.chain]]
name = "upper"
base = {{ position = [0.0, 0.0, {height:?}], orientation = [-0.7071067811865476, 0.0, 0.0, 0.7071067811865476] }}
rows = [{{ joint = "hinge", alpha = 1.5707963267948966 }}]
[[cell]]
node = 7
joint = 1
position = [0.1, 0.0, 0.3]
normal = [1.0, 0.0, 0.0]
"#
    );
    Skin::parse("skin.toml", &text).unwrap()
}

fn arm(skin: &Skin) -> Result<RecordedRobot, RobotError> {
    RecordedRobot::from_urdf(skin, Urdf::parse("arm.urdf", ARM).unwrap(), ARM.to_owned())
}

fn near(one: &[f64], other: &[f64]) -> bool {
    one.iter().zip(other).all(|(one, other)| (one - other).abs() < 1e-9)
}

#[test]
fn a_robot_is_shown_by_the_urdf_that_its_skin_names() {
    let robot = arm(&skin(0.5)).unwrap();
    assert_eq!(
        (robot.root_link_name(), robot.link_moved_by((0, 1)), robot.link_moved_by((0, 2))),
        ("world", Some("upper"), None)
    );
    let moving = robot.moving_transforms(&[0.3]);
    let names: Vec<_> = moving.iter().map(|it| (it.parent, it.child)).collect();
    assert_eq!(names, [("world", "upper"), ("upper", "other")]);
    assert!(near(&moving[0].translation, &[0.0, 0.0, 0.5]));
    assert!(near(&moving[0].rotation, &[0.0, 0.15_f64.sin(), 0.0, 0.15_f64.cos()]));
    assert!(near(&moving[1].translation, &[0.23, 0.0, 0.0]), "a tenth of the hinge's, and 0.2 m");
    let still = robot.fixed_transforms();
    let names: Vec<_> = still.iter().map(|it| (it.parent, it.child)).collect();
    assert_eq!(names, [("upper", "finger"), ("upper", "vcan0/7")]);
    assert!(near(&still[0].translation, &[0.03, 0.0, 0.0]), "in the middle of its limits");
    // The row's frame is the link's here.
    assert!(near(&still[1].translation, &[0.1, 0.0, 0.3]), "{:?}", still[1]);
    let [x, y, z, w] = still[1].rotation;
    let normal = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z)) * Vector3::z();
    assert!(near(normal.as_slice(), &[1.0, 0.0, 0.0]));
}

#[test]
fn a_urdf_of_another_robot_is_refused() {
    let mut other = skin(0.5);
    other.robot.joints[0].name = "elbow".to_owned();
    let error = arm(&other).unwrap_err().to_string();
    assert_eq!(error, "arm.urdf: there is no moving joint \"elbow\"; similar names: \"grip\" or \"hinge\"");
    let error = arm(&skin(0.6)).unwrap_err().to_string();
    assert!(
        error.starts_with(
            "arm.urdf: the URDF and chain \"upper\" of the skin place the link behind joint \"hinge\""
        ),
        "{error}"
    );
    assert!(RecordedRobot::from_rows(&skin(0.6)).is_ok());
}

#[test]
fn each_cell_of_a_skin_without_a_urdf_is_on_its_link() {
    let skin = testing::one_cell_skin();
    let robot = RecordedRobot::from_rows(&skin).unwrap();
    let still = robot.fixed_transforms();
    let cells = still.iter().filter(|it| it.child.contains('/')).count();
    assert_eq!(cells, skin.cells.len());
    assert_eq!(robot.moving_transforms(&[0.0; 6]).len(), skin.robot.joints.len());
}
