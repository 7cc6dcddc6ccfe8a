//! Construction of a chain from a URDF.

use core::f64::consts::PI;
use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3};
use protocol::parameters::{MAX_JOINTS, MAX_ROWS, RowKind};
use protocol::skin::{MAX_REACH, max_frame_distance};

use super::path::{CarriedLink, frames_after_joints, motion_kind, path};
use super::{ChainJoint, LinkFrame, NotCarried, UrdfChain};
use crate::error::{RobotError, RobotProblem};
use crate::residual::{self, LargestResidual};
use crate::rows::{self, Axis, DhRow, MAX_LENGTH_M, MAX_RESIDUAL, frames};
use crate::urdf::{Urdf, UrdfJoint, UrdfJointKind};

/// Builds the chain from a root link (by default that of the robot) to a tip link. Returns the reason if it cannot be
/// built.
pub(super) fn build(urdf: &Urdf, root: Option<&str>, tip: &str) -> Result<UrdfChain, RobotError> {
    let root = urdf.index(root.unwrap_or_else(|| urdf.root()))?;
    let path = path(urdf, root, urdf.index(tip)?)?;
    let joints = joints(urdf, urdf.link_name(root), tip, &path)?;
    let build = |row_cost| build_with_row_cost(urdf, root, tip, &path, &joints, row_cost);
    let [usual, smallest] = rows::FIXED_ROW_COSTS_M;
    build(usual).or_else(|error| {
        let is_long = matches!(*error.problem, RobotProblem::Reach { .. } | RobotProblem::Length { .. });
        if is_long { build(smallest) } else { Err(error) }
    })
}

/// Builds the chain. A fixed row is added only if it shortens the rows by at least `row_cost`, in m.
fn build_with_row_cost(
    urdf: &Urdf,
    root: usize,
    tip: &str,
    path: &[&UrdfJoint],
    joints: &[ChainJoint],
    row_cost: f64,
) -> Result<UrdfChain, RobotError> {
    let root_name = urdf.link_name(root).to_owned();
    let (base, rows) = rows_of_path(urdf, path, joints, tip, row_cost)?;

    let (hanging, apart) = carried_links(urdf, root, path);
    let at_zero = frames(&base, &rows, &[]);
    let behind = frames_after_joints(path, &[]);
    let carried = hanging.iter().map(|it| (it.link.clone(), link_frame(&rows, &at_zero, &behind, it)));
    let carried: Vec<_> = carried.collect();
    let below = urdf.pose(&root_name, &|joint| urdf.rest_position(joint))?;
    let mut chain = UrdfChain {
        below,
        root: root_name,
        tip: tip.to_owned(),
        joints: joints.to_vec(),
        rows,
        base,
        residual: 0.0,
        carried,
        apart,
        file: urdf.file.clone(),
    };
    let rows = chain.chain_rows();
    for (link, LinkFrame { row, frame, .. }) in &chain.carried {
        let reach = max_frame_distance(rows.get(..*row).unwrap_or_default(), frame.translation.vector.into());
        // Links beside the path may have no cells, so only the path must be within reach.
        if reach >= MAX_REACH && path.iter().any(|joint| urdf.link_name(joint.child) == link) {
            return Err(urdf.error(RobotProblem::Reach { link: link.clone(), reach }));
        }
    }
    let LargestResidual { residual, link } = residual::largest_residual(&chain, path, &hanging);
    if residual.is_nan() || residual > MAX_RESIDUAL {
        return Err(urdf.error(RobotProblem::Residual { link, residual }));
    }
    chain.residual = residual;
    Ok(chain)
}

/// Returns the joints of the path that move, with their limits.
fn joints(urdf: &Urdf, root: &str, tip: &str, path: &[&UrdfJoint]) -> Result<Vec<ChainJoint>, RobotError> {
    let mut joints = Vec::new();
    for joint in path {
        let name = joint.name.clone();
        if let UrdfJointKind::Floating | UrdfJointKind::Planar = joint.kind {
            let kind = if joint.kind == UrdfJointKind::Floating { "floating" } else { "planar" };
            return Err(urdf.error_at(joint, RobotProblem::Kind { joint: name, kind }));
        }
        let Some(kind) = motion_kind(joint) else { continue };
        if let Some(mimic) = &joint.mimic {
            return Err(urdf.error_at(joint, RobotProblem::Mimic { joint: name, of: mimic.joint.clone() }));
        }
        let limits = if joint.kind == UrdfJointKind::Continuous { [-PI, PI] } else { joint.limits };
        let [lower, upper] = limits;
        if !joint.has_limit && joint.kind != UrdfJointKind::Continuous {
            return Err(urdf.error_at(joint, RobotProblem::NoLimit { joint: name }));
        }
        if !(lower < upper && (upper - lower).is_finite()) {
            return Err(urdf.error_at(joint, RobotProblem::Limits { joint: name, lower, upper }));
        }
        let max_speed = joint.velocity.filter(|speed| *speed > 0.0 && speed.is_finite());
        joints.push(ChainJoint { name, kind, limits, max_speed });
    }
    let (root, tip) = (root.to_owned(), tip.to_owned());
    match joints.len() {
        0 => Err(urdf.error(RobotProblem::NoMovingJoint { root, tip })),
        count if count > MAX_JOINTS => Err(urdf.error(RobotProblem::TooManyJoints { count, root, tip })),
        _ => Ok(joints),
    }
}

/// Returns frame 0 and the Denavit-Hartenberg rows of a path.
fn rows_of_path(
    urdf: &Urdf,
    path: &[&UrdfJoint],
    joints: &[ChainJoint],
    tip: &str,
    row_cost: f64,
) -> Result<(Isometry3<f64>, Vec<DhRow>), RobotError> {
    let moving = path.iter().filter_map(|joint| Some((joint, motion_kind(joint)?)));
    let axes: Vec<_> = moving
        .zip(frames_after_joints(path, &[]))
        .map(|((joint, kind), pose)| {
            let point = pose.translation.vector.into();
            Axis { point, direction: pose * joint.axis.into_inner(), kind }
        })
        .collect();
    let end = path.iter().fold(Isometry3::identity(), |pose, joint| pose * joint.origin);
    let end = Point3::from(end.translation.vector);
    let (base, rows) = rows::rows_for_axes(&axes, &end, row_cost);
    if rows.len() > MAX_ROWS {
        return Err(urdf.error(RobotProblem::TooManyRows { count: rows.len(), tip: tip.to_owned() }));
    }
    let mut moved = Vec::new();
    for (index, row) in rows.iter().enumerate() {
        if row.kind != RowKind::Fixed {
            moved.extend(joints.get(moved.len()));
        }
        let mut lengths = vec![("a", row.a), ("d", row.d)];
        if let (RowKind::Prismatic, Some(joint)) = (row.kind, moved.last()) {
            lengths.extend(joint.limits.map(|limit| ("d with the joint at its limit", row.d + limit)));
        }
        for (what, value) in lengths {
            if !(-MAX_LENGTH_M..MAX_LENGTH_M).contains(&value) {
                let next = joints.get(moved.len()).map(|joint| format!("joint {:?}", joint.name));
                let to = next.unwrap_or_else(|| format!("link {tip:?}"));
                let hint = if what == "a" || what == "d" {
                    "choose a tip nearer to the root"
                } else {
                    "choose a root behind that joint, or narrow its limits"
                };
                return Err(urdf.error(RobotProblem::Length { row: index + 1, to, what, value, hint }));
            }
        }
    }
    Ok((base, rows))
}

/// Returns the links that move with the chain, those of the path first. Also returns all other links, each with the
/// reason why it does not.
fn carried_links(
    urdf: &Urdf,
    root: usize,
    path: &[&UrdfJoint],
) -> (Vec<CarriedLink>, Vec<(String, NotCarried)>) {
    // The values are the number of moving joints before the link, and its fixed transform after them.
    let (mut count, mut fixed) = (0, Isometry3::identity());
    let mut order = vec![root];
    let mut on_path = BTreeMap::from([(root, (count, fixed))]);
    for joint in path {
        (count, fixed) = match motion_kind(joint) {
            Some(_) => (count + 1, Isometry3::identity()),
            None => (count, fixed * joint.origin),
        };
        on_path.insert(joint.child, (count, fixed));
        order.push(joint.child);
    }
    order.extend((0..urdf.links().count()).filter(|link| !on_path.contains_key(link)));

    let (mut hanging, mut apart) = (Vec::new(), Vec::new());
    for index in order {
        let link = urdf.link_name(index).to_owned();
        let (mut at, mut behind, mut mover) = (index, Isometry3::identity(), None);
        let found = loop {
            if let Some(found) = on_path.get(&at) {
                break Some(found);
            }
            let Some(joint) = urdf.joints_above(at).next() else { break None };
            mover = mover.filter(|_| joint.kind == UrdfJointKind::Fixed).or_else(|| joint.name_if_moving());
            behind = joint.origin * behind;
            at = joint.parent;
        };
        match (found, mover) {
            (None, _) => apart.push((link, NotCarried::Elsewhere)),
            (_, Some(joint)) => apart.push((link, NotCarried::MovedBy(joint))),
            (Some((0, _)), None) => apart.push((link, NotCarried::Still)),
            (Some((joint, fixed)), None) => {
                hanging.push(CarriedLink { link, joint: *joint, fixed: fixed * behind });
            }
        }
    }
    (hanging, apart)
}

/// Returns the row that carries a link, and the transform from the frame of that row to the link.
fn link_frame(
    rows: &[DhRow],
    at_zero: &[Isometry3<f64>],
    behind: &[Isometry3<f64>],
    CarriedLink { joint, fixed, .. }: &CarriedLink,
) -> LinkFrame {
    let pose = joint.checked_sub(1).and_then(|index| behind.get(index)).map_or(*fixed, |pose| pose * fixed);
    let mut moving = 0;
    let mut candidates = Vec::new();
    for (index, (row, frame)) in rows.iter().zip(at_zero.iter().skip(1)).enumerate() {
        moving += usize::from(row.kind != RowKind::Fixed);
        if moving == *joint {
            let distance = (frame.translation.vector - pose.translation.vector).norm();
            candidates.push((distance, index + 1, frame));
        }
    }
    let nearest = candidates.into_iter().min_by(|(one, ..), (other, ..)| one.total_cmp(other));
    let (row, frame) = nearest.map_or((0, pose), |(_, row, frame)| (row, frame.inv_mul(&pose)));
    LinkFrame { joint: *joint, row, frame }
}
