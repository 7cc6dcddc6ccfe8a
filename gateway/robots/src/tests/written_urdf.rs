//! Tests that the URDF written for a skin has the same kinematics as the rows of the skin.

use crate::{DhRow, Isometry3, SkinImport, Urdf, chain_base_pose, frames, write_urdf};
use protocol::skin::Skin;

const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples");

fn imported(file: &str, tips: &[&str]) -> Skin {
    let text = std::fs::read_to_string(format!("{EXAMPLES}/{file}")).unwrap();
    let urdf = Urdf::parse(file, &text).unwrap();
    let chains: Vec<_> = tips.iter().map(|tip| urdf.chain(None, tip).unwrap()).collect();
    let import = SkinImport { name: "robot", command: "", urdf: None, chains: &chains, cells: &[] };
    Skin::parse("skin.toml", &import.toml().unwrap()).unwrap()
}

/// Returns the difference between two poses: the distance in m plus the angle in rad.
fn apart(one: &Isometry3<f64>, other: &Isometry3<f64>) -> f64 {
    (one.translation.vector - other.translation.vector).norm() + one.rotation.angle_to(&other.rotation)
}

/// Writes the URDF of a skin and compares the poses of all its chains at several joint positions within the limits.
/// Returns the URDF.
fn check(skin: &Skin) -> Urdf {
    let text = write_urdf(skin);
    let urdf = Urdf::parse("robot.urdf", &text.xml).unwrap_or_else(|error| panic!("{error}\n{}", text.xml));
    for step in 0..20 {
        let part = |joint: usize| (f64::from(step) * 0.37 + joint as f64 * 0.61).fract();
        let joints = skin.robot.joints.iter().enumerate();
        let q: Vec<_> = joints
            .map(|(at, joint)| joint.limits[0] + part(at) * (joint.limits[1] - joint.limits[0]))
            .collect();
        let position = |name: &str| {
            // Fixed joints are requested too.
            skin.robot.joints.iter().position(|joint| joint.name == name).map_or(0.0, |found| q[found])
        };
        for (chain, links) in skin.robot.chains.iter().zip(&text.links) {
            assert_eq!(links.len(), chain.joints.len());
            let rows: Vec<_> = chain.rows.iter().map(DhRow::from).collect();
            let of_chain: Vec<_> = chain.joints.iter().map(|&joint| q[joint]).collect();
            let expected = *frames(&chain_base_pose(&chain.base), &rows, &of_chain).last().unwrap();
            let prefix = if text.links.len() > 1 { format!("{}_", chain.name) } else { String::new() };
            let tip = urdf.pose(&format!("{prefix}tip"), &position).unwrap();
            assert!(apart(&tip, &expected) < 1e-9, "{} {}", chain.name, apart(&tip, &expected));
        }
    }
    urdf
}

#[test]
fn a_written_urdf_moves_as_the_rows_do() {
    let panda = check(&imported("panda.urdf", &["hand"]));
    assert!(panda.links().any(|link| link == "link7"));
    check(&imported("ur10.urdf", &["tool0"]));
    check(&imported("lift.urdf", &["tool"]));
    let text = std::fs::read_to_string(format!("{EXAMPLES}/ur5-253.toml")).unwrap();
    let ur5 = check(&Skin::parse("ur5-253.toml", &text).unwrap());
    assert_eq!((ur5.name.as_str(), ur5.root()), ("UR5", "base"));
}

#[test]
fn chains_share_the_links_that_they_begin_with() {
    let skin = imported("two-arms.urdf", &["left_palm", "right_palm"]);
    let urdf = check(&skin);
    let text = write_urdf(&skin);
    let [left, right] = [&text.links[0], &text.links[1]];
    assert_eq!(left[..2], right[..2], "the waist");
    assert_ne!(left[2], right[2]);
    assert!(!text.xml.contains("<mimic"));
    assert_eq!(urdf.link_moved_by(&skin.robot.joints[0].name), Ok(left[0].as_str()));
}

#[test]
fn a_joint_in_two_places_is_one_that_mimics_the_other() {
    let skin = Skin::parse(
        "skin.toml",
        r#"
[robot]
[[robot.joint]]
name = "a"
[[robot.joint]]
name = "<b & c>"
[[robot.chain]]
name = "one"
rows = [{ joint = "a", d = 0.1, alpha = 1.5 }, { joint = "<b & c>", a = 0.5 }]
[[robot.chain]]
name = "two"
rows = [{ d = 0.05 }, { joint = "a", d = 0.1, theta_offset = 0.3 }, { a = 0.2 }]
[[bus]]
name = "vcan0"
chain = "one"
[[bus]]
name = "vcan1"
chain = "two"
[[cell]]
bus = "vcan0"
node = 1
joint = 1
position = [0.0, 0.0, 0.0]
normal = [0.0, 1.0, 0.0]
[[cell]]
bus = "vcan1"
node = 1
joint = 1
position = [0.0, 0.0, 0.0]
normal = [0.0, 1.0, 0.0]
"#,
    )
    .unwrap();
    let urdf = check(&skin);
    assert!(write_urdf(&skin).xml.contains("<mimic joint=\"a\"/>"));
    assert_eq!(urdf.link_moved_by("<b & c>"), Ok("one_link2"));
    let poses = urdf.link_poses(&["a", "<b & c>"]).unwrap();
    assert_eq!(poses.iter().filter(|pose| pose.is_moved_by_joint()).count(), 3);
    // Two names map to the same word.
    let mut skin = skin;
    for (chain, name) in skin.robot.chains.iter_mut().zip(["le ft", "le_ft"]) {
        name.clone_into(&mut chain.name);
    }
    let text = write_urdf(&skin);
    let named = Urdf::parse("robot.urdf", &text.xml).unwrap();
    assert_eq!((named.links().count(), text.links[1][0].as_str()), (urdf.links().count(), "le_ft_2_link1"));
    let error = urdf.link_poses(&["d"]).unwrap_err().to_string();
    assert!(error.starts_with("robot.urdf: there is no moving joint \"d\"; similar names: "), "{error}");
}
