//! Compares the rows of random chains with kinematics that the tests compute with matrices.

use core::f64::consts::{FRAC_PI_2, PI};

use crate::{RobotProblem, RowKind, Urdf};
use nalgebra::{Matrix4, Point3, Rotation3, Unit, Vector3};
use proptest::prelude::*;
use protocol::skin::max_frame_distance;

use super::common::torques;
use super::written::{FIVE_DIGITS, TWELVE_DIGITS, TestJoint, robot};

/// Maximum difference between rows and matrices, in m or rad, or in Nm for a force of 1 N.
const ERROR: f64 = 5e-11;

fn angle() -> impl Strategy<Value = f64> {
    prop_oneof![
        3 => Just(0.0),
        2 => proptest::sample::select(vec![FRAC_PI_2, -FRAC_PI_2, PI, TWELVE_DIGITS, FIVE_DIGITS]),
        2 => -PI..PI,
        // Nearly straight angles.
        1 => (2..=13_i32, -1.0..1.0_f64).prop_map(|(exponent, factor)| factor * 10_f64.powi(-exponent)),
    ]
}

fn axis() -> impl Strategy<Value = [f64; 3]> {
    prop_oneof![
        4 => Just([0.0, 0.0, 1.0]),
        1 => Just([0.0, -1.0, 0.0]),
        1 => Just([1.0, 0.0, 0.0]),
        1 => Just([0.0, -1.0, -4.371_14e-8]),
        1 => [-1.0..1.0, -1.0..1.0, 0.1..1.0],
    ]
}

fn length() -> impl Strategy<Value = f64> {
    prop_oneof![1 => Just(0.0), 1 => -0.25..0.25]
}

/// Generates joints, each with two positions as fractions of the range between its limits.
fn written() -> impl Strategy<Value = (TestJoint, [f64; 2])> {
    let kind = proptest::sample::select(vec!["revolute", "revolute", "continuous", "prismatic", "fixed"]);
    let place = ([length(), length(), length()], [angle(), angle(), angle()], axis());
    (kind, place, -3.0..0.5, 0.1..3.0, [0.0..1.0, 0.0..1.0]).prop_map(
        |(kind, (xyz, rpy, axis), lower, span, way)| {
            let limits = if kind == "prismatic" {
                [lower / 20.0, (lower + span) / 20.0]
            } else {
                [lower, lower + span]
            };
            (TestJoint { kind, xyz, rpy, axis, limits }, way)
        },
    )
}

fn chains() -> impl Strategy<Value = Vec<(TestJoint, [f64; 2])>> {
    proptest::collection::vec(written(), 1..=14)
}

/// Returns the transform from the parent of a joint to its child, with the joint at this position.
fn step(joint: &TestJoint, position: f64) -> Matrix4<f64> {
    let [roll, pitch, yaw] = joint.rpy;
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), pitch)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), roll);
    let origin = Matrix4::new_translation(&Vector3::from(joint.xyz)) * turn.to_homogeneous();
    let moved = match joint.kind {
        "fixed" => Matrix4::identity(),
        "prismatic" => Matrix4::new_translation(&(Vector3::from(joint.axis).normalize() * position)),
        _ => Rotation3::from_axis_angle(&Unit::new_normalize(Vector3::from(joint.axis)), position)
            .to_homogeneous(),
    };
    origin * moved
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    #[test]
    fn rows_move_as_the_file_says(joints in chains(), cell in [-0.3..0.3, -0.3..0.3, -0.3..0.3]) {
        let written: Vec<_> = joints.iter().map(|(joint, _)| joint.clone()).collect();
        let urdf = Urdf::parse("t.urdf", &robot(&written)).unwrap();
        let tip = format!("l{}", written.len());
        let chain = match urdf.chain(None, &tip) {
            Ok(chain) => chain,
            Err(error) => {
                let fine = matches!(*error.problem, RobotProblem::NoMovingJoint { .. } | RobotProblem::Reach { .. });
                prop_assert!(fine, "{error}");
                return Ok(());
            }
        };
        prop_assert!(chain.residual < ERROR, "{}", chain.residual);
        prop_assert!(chain.rows.iter().all(|row| row.a.abs() <= 1.3 && row.d.abs() <= 1.3), "{:?}", chain.rows);
        let moves = |joint: &TestJoint| joint.kind != "fixed";
        for end in 0..2 {
            let moving = joints.iter().filter(|(joint, _)| moves(joint)).zip(chain.limits());
            let q: Vec<_> = moving.map(|((_, way), [lower, upper])| lower + (upper - lower) * way[end]).collect();
            let mut pose = Matrix4::identity();
            let (mut next, mut joint_frames) = (q.iter(), Vec::new());
            let frames = chain.frames(&q);
            for (index, joint) in written.iter().enumerate() {
                let position = if moves(joint) { *next.next().unwrap() } else { 0.0 };
                pose *= step(joint, position);
                if moves(joint) {
                    joint_frames.push((joint, pose));
                }
                let Ok(place) = chain.link(&format!("l{}", index + 1)) else { continue };
                let rows = (frames[place.row] * place.frame).to_homogeneous();
                prop_assert!((rows - pose).norm() < ERROR, "link {}: {}", index + 1, (rows - pose).norm());
            }
            // Torques at the tip, and its distance from the axes.
            let point = Point3::from(cell);
            let normal = Vector3::new(0.6, 0.0, 0.8);
            let got = torques(&chain, &tip, &point, &normal, 1.0, &q);
            let (at, force) = (pose.transform_point(&point), pose.transform_vector(&-normal));
            for ((joint, pose), torque) in joint_frames.iter().zip(got) {
                let axis = pose.transform_vector(&Vector3::from(joint.axis).normalize());
                let origin = pose.transform_point(&Point3::origin());
                let expected =
                    if joint.kind == "prismatic" { axis.dot(&force) } else { axis.cross(&(at - origin)).dot(&force) };
                prop_assert!((torque - expected).abs() < ERROR, "{torque} for {expected}");
            }
            let place = chain.link(&tip).unwrap();
            let position = place.frame * point;
            let far = max_frame_distance(&chain.chain_rows()[..place.row], position.coords.into());
            let first = chain.rows.iter().position(|row| row.kind == RowKind::Revolute);
            for (index, frame) in frames.iter().enumerate().take(chain.rows.len()).skip(first.unwrap_or(usize::MAX)) {
                let lever = at - frame * Point3::origin();
                let off_axis = (frame * Vector3::z()).cross(&lever).norm();
                let off_origin = if Some(index) == first { off_axis } else { lever.norm() };
                prop_assert!(off_origin <= far + 1e-9, "row {}: {off_origin} m, {far} m", index + 1);
            }
        }
    }

    /// Any text is accepted, or refused in one line.
    #[test]
    fn any_text_is_refused_in_one_line(text in "[ -~]{0,40}", cut in 0_usize..600, put in "[ -~]{0,6}") {
        let whole = robot(&[TestJoint::hinge([0.1, 0.0, 0.0], [0.0; 3]), TestJoint::slide([0.1, 0.0, 0.0], [0.0; 3])]);
        let at = cut.min(whole.len());
        let damaged = [&whole[..at], &put, whole.get(at + put.len()..).unwrap_or_default()].concat();
        for text in [text, damaged] {
            let read = Urdf::parse("t.urdf", &text).and_then(|urdf| urdf.chain(None, "l2"));
            if let Err(error) = read {
                let line = error.to_string();
                prop_assert!(line.starts_with("t.urdf:") && !line.contains('\n'), "{line}");
            }
        }
    }
}
