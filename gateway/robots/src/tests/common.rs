//! Helpers of the tests. Where tests check the crate's results, torques and differences are computed without its code.

use std::collections::BTreeMap;
use std::path::PathBuf;

use crate::{RowKind, UrdfChain};
use nalgebra::{Isometry3, Point3, Vector3};

/// Returns the folder of the package example-robot-data, from the environment variable `SKINBUS_ROBOTS`.
pub(crate) fn folder() -> PathBuf {
    let folder = std::env::var_os("SKINBUS_ROBOTS");
    PathBuf::from(folder.expect("SKINBUS_ROBOTS is the folder `robots` of example-robot-data"))
}

/// Returns the torque of each joint in Nm, or the force in N, that a contact with `force` newtons causes. The contact
/// acts against `normal` at `point`, both in the frame of a link. The torques follow from the transposed Jacobian of
/// the rows.
pub(crate) fn torques(
    chain: &UrdfChain,
    link: &str,
    point: &Point3<f64>,
    normal: &Vector3<f64>,
    force: f64,
    positions: &[f64],
) -> Vec<f64> {
    let place = chain.link(link).unwrap();
    let frames = chain.frames(positions);
    let pose = frames[place.row] * place.frame;
    let (point, force) = (pose * point, pose * normal * -force);
    let mut all = Vec::new();
    for (row, frame) in chain.rows.iter().zip(&frames) {
        let axis = frame * Vector3::z();
        let lever = point.coords - frame.translation.vector;
        match row.kind {
            RowKind::Revolute => all.push(axis.cross(&lever).dot(&force)),
            RowKind::Prismatic => all.push(axis.dot(&force)),
            RowKind::Fixed => {}
        }
    }
    for beyond in all.iter_mut().skip(place.joint) {
        *beyond = 0.0;
    }
    all
}

/// Returns the difference between two frames: the greater of the distance in m and the difference of the rotation
/// matrices.
pub(crate) fn difference(one: &Isometry3<f64>, other: &Isometry3<f64>) -> f64 {
    let turn = one.rotation.to_rotation_matrix().matrix() - other.rotation.to_rotation_matrix().matrix();
    (one.translation.vector - other.translation.vector).norm().max(turn.norm())
}

/// Returns a function that returns the position of a joint, given the name of the joint.
pub(crate) fn named<'a>(chain: &'a UrdfChain, positions: &[f64]) -> impl Fn(&str) -> f64 + use<'a> {
    let names = chain.joints.iter().map(|joint| joint.name.as_str());
    let all: BTreeMap<_, _> = names.zip(positions.to_vec()).collect();
    move |name| all.get(name).copied().unwrap_or_default()
}
