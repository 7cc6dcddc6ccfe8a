//! Tests of the rows of hand-written chains.

use core::f64::consts::{FRAC_PI_2, PI};

use crate::{DhRow, JointKind, RowKind, Urdf, UrdfChain};
use nalgebra::{Isometry3, Point3};
use protocol::skin::max_frame_distance;

use super::common::{difference, named};
use super::written::{TWELVE_DIGITS, TestJoint, robot};

fn chain(joints: &[TestJoint]) -> UrdfChain {
    let chain = Urdf::parse("t.urdf", &robot(joints)).unwrap().chain(None, &format!("l{}", joints.len()));
    let chain = chain.unwrap();
    assert!(chain.residual < 1e-10, "{chain:?}");
    chain
}

fn kinds(chain: &UrdfChain) -> Vec<RowKind> {
    chain.rows.iter().map(|row| row.kind).collect()
}

#[track_caller]
fn assert_row(row: &DhRow, [a, alpha, d, theta_offset]: [f64; 4]) {
    for (got, expected) in [(row.a, a), (row.d, d)] {
        assert!((got - expected).abs() < 1e-11, "{row:?}");
    }
    // The comparison is exact, so that no twist of nearly a quarter turn remains.
    assert_eq!(
        [row.alpha, row.theta_offset].map(f64::to_bits),
        [alpha, theta_offset].map(f64::to_bits),
        "{row:?}"
    );
}

/// The arm of the skin examples, written as a URDF, yields its known table.
#[test]
fn a_known_table_comes_back() {
    let chain = chain(&[
        TestJoint::hinge([0.0, 0.0, 0.0892], [0.0; 3]),
        TestJoint::hinge([0.0; 3], [TWELVE_DIGITS, 0.0, 0.0]),
        TestJoint::hinge([-0.425, 0.0, 0.0], [0.0; 3]),
        TestJoint::hinge([-0.392, 0.0, 0.109], [0.0; 3]),
        TestJoint::hinge([0.0, -0.095, 0.0], [TWELVE_DIGITS, 0.0, 0.0]),
        TestJoint::hinge([0.0, 0.082, 0.0], [-TWELVE_DIGITS, 0.0, 0.0]),
        TestJoint::fixed([0.0, 0.0, 0.05], [0.0; 3]),
    ]);
    let expected = [
        [0.0, FRAC_PI_2, 0.0892, 0.0],
        [-0.425, 0.0, 0.0, 0.0],
        [-0.392, 0.0, 0.109, 0.0],
        [0.0, FRAC_PI_2, 0.0, 0.0],
        [0.0, -FRAC_PI_2, 0.095, 0.0],
        [0.0, 0.0, 0.082 + 0.05, 0.0],
    ];
    assert_eq!(chain.rows.len(), expected.len());
    for (row, expected) in chain.rows.iter().zip(expected) {
        assert_row(row, expected);
    }
    assert!(difference(&chain.base, &Isometry3::identity()) < 1e-15, "{:?}", chain.base);
}

#[test]
fn opposite_and_equal_axes_need_one_row() {
    let opposite =
        chain(&[TestJoint::hinge([0.0; 3], [0.0; 3]), TestJoint::hinge([0.3, 0.0, 0.1], [PI, 0.0, 0.0])]);
    assert_row(&opposite.rows[0], [0.3, PI, 0.1, 0.0]);
    let same =
        chain(&[TestJoint::hinge([0.0; 3], [0.0; 3]), TestJoint::hinge([0.0, 0.0, 0.2], [0.0, 0.0, 0.7])]);
    assert_row(&same.rows[0], [0.0, 0.0, 0.2, 0.0]);
    let beside = chain(&[TestJoint::hinge([0.0; 3], [0.0; 3]), TestJoint::hinge([0.0, 0.4, 0.0], [0.0; 3])]);
    assert_row(&beside.rows[0], [0.4, 0.0, 0.0, FRAC_PI_2]);
}

/// The common normal of nearly parallel axes is far away: a fixed row takes another path.
#[test]
fn a_tilt_of_any_size_keeps_rows_short() {
    // 1e-11 itself is left out, because either result is correct.
    for exponent in (1..=10).chain(12..=13) {
        let tilt = 10_f64.powi(-exponent);
        for turn in [0.0, PI] {
            let chain = chain(&[
                TestJoint::hinge([0.0, 0.0, 0.3], [0.0; 3]),
                TestJoint::hinge([0.5, 0.1, 0.2], [turn, tilt, 0.0]),
                TestJoint::hinge([0.4, 0.0, -0.1], [0.0, 0.0, 0.0]),
            ]);
            let needed = tilt > 1e-11 && 0.5 / tilt > 1.0;
            let inserted = kinds(&chain).iter().filter(|kind| **kind == RowKind::Fixed).count();
            assert_eq!(inserted, usize::from(needed), "{tilt}: {:?}", chain.rows);
            assert!(
                chain.rows.iter().all(|row| row.a.abs() <= 1.0 && row.d.abs() <= 1.0),
                "{:?}",
                chain.rows
            );
            assert!(chain.residual < if tilt > 1e-11 { 2e-14 } else { 2e-12 }, "{tilt}: {}", chain.residual);
        }
    }
}

/// Axes that meet nearby at a small angle would lose digits, although no row is long.
#[test]
fn axes_that_meet_at_a_small_angle_lose_no_digits() {
    for exponent in 2..=9 {
        let tilt = 10_f64.powi(-exponent);
        let joints = [
            TestJoint::hinge([0.0; 3], [0.0; 3]),
            TestJoint::hinge([0.0, 0.0, 0.2], [tilt, 0.3 * tilt, 0.0]),
        ];
        let chain = chain(&joints);
        assert!(chain.residual < 1e-13, "{tilt}: {}", chain.residual);
    }
}

/// A common normal may be far away although the angle is large: here two axes in one plane meet 1.5 m farther out.
#[test]
fn a_far_foot_is_avoided() {
    let meets = TestJoint::hinge([0.4, 0.0, 0.0], [0.0, -(0.4_f64 / 1.5).atan(), 0.0]);
    let chain =
        chain(&[TestJoint::hinge([0.0; 3], [0.0; 3]), meets, TestJoint::hinge([0.2, 0.0, 0.0], [0.0; 3])]);
    assert_eq!(kinds(&chain)[..2], [RowKind::Revolute, RowKind::Fixed]);
    assert!(chain.rows.iter().all(|row| row.a.abs() <= 0.5 && row.d.abs() <= 0.5), "{:?}", chain.rows);
}

/// Returns the waist and the left arm of a humanoid whose shoulder axis is tilted against the waist's by 16 degrees, so
/// that their common normal is 0.9 m beside the robot. `forearm` is the distance of the tip from the elbow.
fn tilted_shoulder(forearm: f64) -> Vec<TestJoint> {
    let [x, y, z] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    vec![
        TestJoint::hinge([0.0; 3], [0.0; 3]).axis(z),
        TestJoint::hinge([-0.004, 0.0, 0.044], [0.0; 3]).axis(x),
        TestJoint::hinge([0.0; 3], [0.0; 3]).axis(y),
        TestJoint::hinge([0.004, 0.1002, 0.2478], [0.2793, 5.5e-5, -1.9e-4]).axis(y),
        TestJoint::hinge([0.0, 0.038, -0.0138], [-0.2793, 0.0, 0.0]).axis(x),
        TestJoint::hinge([0.0, 0.0062, -0.1032], [0.0; 3]).axis(z),
        TestJoint::hinge([0.0158, 0.0, -0.0805], [0.0; 3]).axis(y),
        TestJoint::fixed([forearm, 0.0, -0.01], [0.0; 3]),
    ]
}

/// Returns the greatest distance of the tip from any joint before it, over many positions, in m.
fn farthest(urdf: &Urdf, chain: &UrdfChain) -> f64 {
    let (mut most, mut state) = (0.0_f64, 1_u32);
    for _ in 0..1000 {
        let positions: Vec<_> = chain
            .joints
            .iter()
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (f64::from(state >> 8) / f64::from(1 << 24) - 0.5) * 2.0 * PI
            })
            .collect();
        let position = named(chain, &positions);
        let at = |link: &str| urdf.pose(link, &position).unwrap().translation.vector;
        let tip = at(&chain.tip);
        let joints = (1..=chain.joints.len()).map(|joint| at(&format!("l{joint}")));
        most = joints.map(|joint| (tip - joint).norm()).fold(most, f64::max);
    }
    most
}

#[test]
fn rows_do_not_fold_back_beside_the_robot() {
    for forearm in [0.3, 1.0, 1.3] {
        let urdf = Urdf::parse("t.urdf", &robot(&tilted_shoulder(forearm))).unwrap();
        let chain = urdf.chain(None, "l8").unwrap();
        let place = chain.link("l8").unwrap();
        let bound =
            max_frame_distance(&chain.chain_rows()[..place.row], place.frame.translation.vector.into());
        let seen = farthest(&urdf, &chain);
        assert!((0.9..1.15).contains(&(bound / seen)), "{bound} m for {seen} m");
        assert!(chain.rows[..7].iter().all(|row| row.a.abs().max(row.d.abs()) < 0.26), "{:?}", chain.rows);
        assert!(chain.residual < 1e-14, "{}", chain.residual);
    }
    let long = Urdf::parse("t.urdf", &robot(&tilted_shoulder(1.7))).unwrap().chain(None, "l8").unwrap_err();
    assert!(long.to_string().contains("the distance can reach 2."), "{long}");
}

/// The path from joint to joint, with a fixed row for each, is an upper bound.
#[test]
fn rows_are_no_longer_than_the_way_from_joint_to_joint() {
    let mut state = 7_u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / f64::from(1 << 24) - 0.5
    };
    for tilt in [1e-9, 1e-3, 0.03, 0.3, 3.0] {
        for _ in 0..40 {
            let joints: Vec<_> = (0..6)
                .map(|_| {
                    TestJoint::hinge([(); 3].map(|()| 0.4 * random()), [(); 3].map(|()| tilt * random()))
                })
                .collect();
            let way: f64 = joints
                .iter()
                .skip(1)
                .map(|joint| joint.xyz.iter().map(|it| it * it).sum::<f64>().sqrt())
                .sum();
            let chain = chain(&joints);
            let rows: f64 = chain.rows.iter().map(|row| row.a.abs() + row.d.abs()).sum();
            let first = Point3::from(joints[0].xyz);
            let base = (first - Point3::from(chain.base.translation.vector)).norm();
            let fixed = 0.2 * f64::from(u32::try_from(joints.len()).unwrap());
            assert!(
                rows < 3.0_f64.sqrt() * way + base + fixed,
                "{tilt}: {rows} {way} {base}: {:?}",
                chain.rows
            );
        }
    }
}

#[test]
fn slides_are_rows_of_their_own() {
    let chain = chain(&[
        TestJoint::slide([0.0, 0.1, 0.5], [0.0; 3]),
        TestJoint::hinge([0.1, 0.0, 0.2], [0.0; 3]),
        TestJoint::slide([0.3, 0.0, 0.0], [0.0, FRAC_PI_2, 0.0]),
        TestJoint::slide([0.0, 0.0, 0.2], [0.0; 3]),
        TestJoint::hinge([0.0, 0.1, 0.0], [0.3, 0.2, 0.1]),
        TestJoint::slide([0.1, 0.1, 0.1], [0.0, 0.4, 0.0]).axis([0.0, -3.0, 4.0]),
    ]);
    use RowKind::{Prismatic, Revolute};
    let moving: Vec<_> = kinds(&chain).into_iter().filter(|kind| *kind != RowKind::Fixed).collect();
    assert_eq!(moving, [Prismatic, Revolute, Prismatic, Prismatic, Revolute, Prismatic]);
    let kinds: Vec<_> = chain.joints.iter().map(|joint| joint.kind == JointKind::Prismatic).collect();
    assert_eq!(kinds, [true, false, true, true, false, true]);
    assert!(chain.residual < 1e-14, "{}", chain.residual);
}

#[test]
fn joints_say_what_the_file_says() {
    let mut joints = vec![TestJoint::hinge([0.1, 0.0, 0.0], [0.0; 3]); 3];
    joints[0].kind = "continuous";
    joints[1].limits = [-0.5, 7.0];
    joints[2].kind = "prismatic";
    let xml = robot(&joints).replacen("velocity=\"1.5\"", "velocity=\"0\"", 1);
    let chain = Urdf::parse("t.urdf", &xml).unwrap().chain(Some("l0"), "l3").unwrap();
    assert_eq!(chain.limits(), [[-PI, PI], [-0.5, 7.0], [-1.0, 1.0]]);
    let speeds: Vec<_> = chain.joints.iter().map(|joint| joint.max_speed).collect();
    assert_eq!(speeds, [None, Some(1.5), Some(1.5)]);
    assert_eq!((chain.root.as_str(), chain.tip.as_str()), ("l0", "l3"));
    assert_eq!(chain.joints[1].name, "j2");
}

/// With fixed joints before, between and after, and with a branch, each link's frame is that of the URDF.
#[test]
fn links_are_where_the_file_has_them() {
    let joints = [
        TestJoint::fixed([0.0, 0.1, 0.3], [0.1, 0.2, 0.3]),
        TestJoint::hinge([0.1, 0.0, 0.2], [0.0, 0.3, 0.0]),
        TestJoint::fixed([0.2, 0.0, 0.1], [0.0, 0.0, 0.4]),
        TestJoint::fixed([0.2, 0.0, 0.0], [1.0, 0.0, 0.4]),
        TestJoint::slide([0.1, 0.2, 0.0], [0.5, 0.0, 0.0]),
        TestJoint::hinge([0.0, 0.2, 0.1], [0.5, 0.0, 0.0]).axis([1.0, 1.0, 0.0]),
        TestJoint::fixed([0.0, 0.0, 0.1], [0.0, 0.5, 0.0]),
    ];
    let branch = r#"
<link name="cover"/><joint name="to_cover" type="fixed"><parent link="l3"/><child link="cover"/><origin xyz="0 0.1 0"/></joint>
<link name="badge"/><joint name="to_badge" type="fixed"><parent link="cover"/><child link="badge"/><origin rpy="0 0.5 0"/></joint>
<link name="finger"/><joint name="grip" type="prismatic"><parent link="badge"/><child link="finger"/><limit lower="0" upper="1"/></joint>
<link name="nail"/><joint name="to_nail" type="fixed"><parent link="finger"/><child link="nail"/></joint>
<link name="camera"/><joint name="to_camera" type="fixed"><parent link="l7"/><child link="camera"/></joint>
<link name="foot"/><joint name="to_foot" type="fixed"><parent link="l1"/><child link="foot"/></joint>
</robot>"#;
    let urdf = Urdf::parse("t.urdf", &robot(&joints).replace("</robot>", branch)).unwrap();
    let chain = urdf.chain(None, "l7").unwrap();
    let names: Vec<_> = chain.links().map(|(name, _)| name).collect();
    assert_eq!(names, ["l2", "l3", "l4", "l5", "l6", "l7", "cover", "badge", "camera"]);
    assert_eq!(chain.link("cover").unwrap().joint, 1);
    assert_eq!(chain.link("camera").unwrap().joint, 3);
    for positions in [[0.0; 3], [0.7, 0.05, -0.9]] {
        let frames = chain.frames(&positions);
        for (name, place) in chain.links() {
            let expected = urdf.pose(name, &named(&chain, &positions)).unwrap();
            assert!(difference(&(frames[place.row] * place.frame), &expected) < 1e-13, "{name}");
        }
    }
    let why = |link: &str| chain.link(link).unwrap_err().to_string();
    assert_eq!(
        why("foot"),
        r#"t.urdf: link "foot" is before the chain's first joint "j2", so no joint moves it: put the cell on a link behind that joint"#
    );
    assert_eq!(why("l0"), why("foot").replace("foot", "l0"));
    assert_eq!(
        why("nail"),
        r#"t.urdf: link "nail" is moved by joint "grip", which is not between "l0" and "l7": choose another tip, or a link of the chain"#
    );
    assert_eq!(why("l8"), r#"t.urdf: there is no link "l8"; similar names: "l2", "l3" or "l4""#);
    let part = urdf.chain(Some("l4"), "l6").unwrap();
    let above = part.link("cover").unwrap_err().to_string();
    assert_eq!(above, r#"t.urdf: link "cover" is not below the chain's root "l4": choose a root above it"#);
    let pose = part.frames(&[0.0, 0.0])[part.link("l6").unwrap().row] * part.link("l6").unwrap().frame;
    let expected = urdf.pose("l4", &|_| 0.0).unwrap().inverse() * urdf.pose("l6", &|_| 0.0).unwrap();
    assert!(difference(&pose, &expected) < 1e-13);
}

/// After a fixed row's helper axis, the row whose origin is nearest carries the link.
#[test]
fn the_nearest_row_carries_a_link() {
    let joints = [
        TestJoint::hinge([0.0; 3], [0.0; 3]),
        TestJoint::hinge([0.6, 0.0, 0.3], [1e-4, 0.0, 0.0]),
        TestJoint::fixed([0.0, 0.0, 0.1], [0.0; 3]),
    ];
    let side = |name: &str, xyz: &str| {
        format!(
            "<link name=\"{name}\"/><joint name=\"to_{name}\" type=\"fixed\"><parent link=\"l1\"/><child link=\"{name}\"/><origin xyz=\"{xyz}\"/></joint>\n"
        )
    };
    let sides = side("low", "0 0 0.29") + &side("high", "0.59 0 0.3") + "</robot>";
    let urdf = Urdf::parse("t.urdf", &robot(&joints).replace("</robot>", &sides)).unwrap();
    let chain = urdf.chain(None, "l3").unwrap();
    assert_eq!(kinds(&chain), [RowKind::Revolute, RowKind::Fixed, RowKind::Revolute]);
    let origins: Vec<_> = chain.frames(&[0.0, 0.0]).iter().map(|frame| frame * Point3::origin()).collect();
    for (name, at) in [("low", Point3::new(0.0, 0.0, 0.29)), ("high", Point3::new(0.59, 0.0, 0.3))] {
        let place = chain.link(name).unwrap();
        assert_eq!(place.joint, 1);
        let others = [1, 2].map(|row: usize| (origins[row] - at).norm());
        assert_eq!(place.row, if others[0] < others[1] { 1 } else { 2 }, "{name}: {others:?}");
    }
    assert_ne!(chain.link("low").unwrap().row, chain.link("high").unwrap().row);
}
