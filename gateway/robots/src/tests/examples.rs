//! Tests of the robots in `gateway/examples`.

use std::fs;

use crate::{Geometry, JointKind, RowKind, Urdf, UrdfChain};
use nalgebra::Point3;
use protocol::skin::max_frame_distance;

use super::common::{difference, folder};

const PANDA: &str = include_str!("../../../examples/panda.urdf");
const UR10: &str = include_str!("../../../examples/ur10.urdf");
const TWO_ARMS: &str = include_str!("../../../examples/two-arms.urdf");
const LIFT: &str = include_str!("../../../examples/lift.urdf");

fn chain(xml: &str, tip: &str) -> UrdfChain {
    let urdf = Urdf::parse("example.urdf", xml).unwrap();
    for link in urdf.links() {
        let shapes = urdf.visuals(link).unwrap();
        let simple =
            |geometry: &Geometry| matches!(geometry, Geometry::Box { .. } | Geometry::Cylinder { .. });
        assert!(shapes.iter().all(|shape| simple(&shape.geometry)), "{link}");
    }
    let chain = urdf.chain(None, tip).unwrap();
    assert!(chain.residual < 1e-14, "{}", chain.residual);
    assert!(
        chain.rows.iter().all(|row| row.kind != RowKind::Fixed),
        "all axes are parallel or at right angles"
    );
    assert!(chain.joints.iter().all(|joint| joint.max_speed.is_some()));
    chain
}

/// Returns the reach of the tip in m: its maximum distance from the joints that move it.
fn far(chain: &UrdfChain) -> f64 {
    let place = chain.link(&chain.tip).unwrap();
    max_frame_distance(&chain.chain_rows()[..place.row], place.frame.translation.vector.into())
}

/// Returns the position of the tip with the joints at these positions, in m.
fn at(chain: &UrdfChain, positions: &[f64]) -> Point3<f64> {
    let place = chain.link(&chain.tip).unwrap();
    chain.frames(positions)[place.row] * place.frame * Point3::origin()
}

#[track_caller]
fn assert_at(chain: &UrdfChain, positions: &[f64], expected: [f64; 3]) {
    let got = at(chain, positions);
    assert!((got - Point3::from(expected)).norm() < 1e-9, "{got} for {expected:?}");
}

#[test]
fn panda_is_as_its_table_says() {
    let chain = chain(PANDA, "hand");
    assert_eq!(chain.joints.len(), 7);
    // The arm is stretched upward, except for the elbow's 82.5 mm, which cancel, and the flange's 88 mm.
    assert_at(&chain, &[0.0; 7], [0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107]);
    let expected = 0.316_f64.hypot(0.0825) + 0.384_f64.hypot(0.0825) + 0.088_f64.hypot(0.107);
    assert!(far(&chain) > 0.8 && far(&chain) < expected + 0.08, "{} {expected}", far(&chain));
}

#[test]
fn ur10_is_as_its_table_says() {
    let chain = chain(UR10, "tool0");
    assert_eq!(chain.joints.len(), 6);
    assert_at(&chain, &[0.0; 6], [-0.612 - 0.5723, -0.163941 - 0.0922, 0.1273 - 0.1157]);
    let table: Vec<_> = chain.rows.iter().map(|row| row.a).collect();
    for (a, expected) in table.iter().zip([0.0, -0.612, -0.5723, 0.0, 0.0, 0.0]) {
        assert!((a - expected).abs() < 1e-12, "{table:?}");
    }
}

#[test]
fn two_arms_are_two_chains_on_one_torso() {
    let [left, right] = ["left_palm", "right_palm"].map(|tip| chain(TWO_ARMS, tip));
    for arm in [&left, &right] {
        assert_eq!(arm.joints.len(), 7);
        assert_eq!((&arm.joints[..2], &arm.rows[..1]), (&left.joints[..2], &left.rows[..1]));
        assert!(far(arm) < 1.2, "{}", far(arm));
    }
    let names = left.joints.iter().chain(&right.joints).map(|joint| joint.name.as_str());
    assert_eq!(names.collect::<std::collections::BTreeSet<_>>().len(), 12);
    // The arms are mirror images.
    let [mut left_at, right_at] = [(&left, 1.0), (&right, -1.0)]
        .map(|(arm, side)| at(arm, &[0.0, 0.3, -0.5, side * 0.4, side * 0.2, -1.0, 0.0]));
    left_at.y = -left_at.y;
    assert!((left_at - right_at).norm() < 1e-12, "{left_at} {right_at}");
}

#[test]
fn the_lift_lifts() {
    let chain = chain(LIFT, "tool");
    let kinds: Vec<_> = chain.joints.iter().map(|joint| joint.kind).collect();
    assert_eq!((kinds[0], kinds.len()), (JointKind::Prismatic, 8));
    assert!(kinds[1..].iter().all(|kind| *kind == JointKind::Revolute));
    let [low, high] = [0.0, 0.35].map(|lift| at(&chain, &[lift, 0.1, 0.2, -0.3, 0.4, 0.5, 0.6, 0.7]));
    assert!((high - low - nalgebra::Vector3::z() * 0.35).norm() < 1e-12);
    assert!(far(&chain) < 1.0, "{}", far(&chain));
}

/// Compares the examples with other descriptions of the same robots.
#[test]
#[ignore = "needs example-robot-data"]
fn examples_agree_with_the_files_of_others() {
    for (ours, tip, file, [root, other_tip]) in [
        (PANDA, "hand", "panda_description/urdf/panda.urdf", ["panda_link0", "panda_hand"]),
        (UR10, "tool0", "ur_description/urdf/ur10_robot.urdf", ["base", "tool0"]),
    ] {
        let xml = fs::read_to_string(folder().join(file)).unwrap();
        let theirs = Urdf::parse(file, &xml).unwrap();
        let ours = Urdf::parse("example.urdf", ours).unwrap();
        let [chain, other] = [ours.chain(None, tip).unwrap(), theirs.chain(None, other_tip).unwrap()];
        let names: Vec<_> = other.joints.iter().map(|joint| joint.name.clone()).collect();
        for round in 0_u32..50 {
            // Positions are spread within the limits by multiples of the golden ratio.
            let part = |joint: usize| (f64::from(round) * 0.618_034 + joint as f64 * 0.414_214).fract();
            let limits = chain.joints.iter().map(|joint| joint.limits).enumerate();
            let q: Vec<_> = limits.map(|(at, [lower, upper])| lower + (upper - lower) * part(at)).collect();
            let place = chain.link(tip).unwrap();
            let got = chain.frames(&q)[place.row] * place.frame;
            let position = |name: &str| names.iter().position(|other| other == name).map_or(0.0, |at| q[at]);
            let [from, to] = [root, other_tip].map(|link| theirs.pose(link, &position).unwrap());
            let apart = difference(&got, &from.inv_mul(&to));
            assert!(apart < 1e-6, "{file}, round {round}: {apart}");
        }
    }
}
