//! Checks of the robot's joints and chains in a skin file.

use core::f64::consts::TAU;

use super::raw;
use super::robot::{
    Chain, ChainBase, ChainRow, DenavitHartenberg, Joint, JointKind, MAX_ROBOT_JOINTS, Robot,
};
use crate::document::{Checked, KeyPath};
use crate::fixed::Q1_14;
use crate::parameters::{MAX_JOINTS, MAX_ROWS, RowKind};

/// Maximum position of a prismatic joint in m: the range of a Q1.14 word, 2 m, less a margin for rounding.
const MAX_PRISMATIC_POSITION_M: f64 = 2.0 - 1e-3;
/// Maximum absolute coordinate of a chain's base relative to the robot's base, in m.
const MAX_BASE_COORDINATE_M: f64 = 100.0;
/// Maximum deviation of the length of a unit vector or unit quaternion from one.
const UNIT_LENGTH_TOLERANCE: f64 = 1e-3;

/// Checks the joints and chains of the robot.
pub(super) fn check_robot(raw: raw::RawRobot) -> Checked<Robot> {
    let at = KeyPath::top_level_key("robot");
    if raw.urdf.as_ref().is_some_and(String::is_empty) {
        let why = "must be the path of a file, relative to the skin file";
        return Err(at.with_key("urdf").fault("\"\"", why));
    }
    match (raw.joints, raw.joint.is_empty() && raw.chain.is_empty()) {
        (Some(rows), true) => {
            Ok(Robot { urdf: raw.urdf, ..serial_robot(&at, raw.name, &rows, raw.limits_rad)? })
        }
        (None, false) => {
            if raw.limits_rad.is_some() {
                return Err(at
                    .with_key("limits_rad")
                    .fault("", "not allowed with [[robot.joint]]: give the limits of each joint there"));
            }
            let joints = check_joints(&at, &raw.joint)?;
            let chains = check_chains(&at, &raw.chain, &joints)?;
            Ok(Robot { name: raw.name, urdf: raw.urdf, joints, chains })
        }
        (Some(_), false) => {
            let why = "give either joints, or [[robot.joint]] and [[robot.chain]], not both";
            Err(at.with_key("joints").fault("", why))
        }
        (None, true) => {
            let why = "missing: give the rows of the robot's joints, or [[robot.joint]] and [[robot.chain]]";
            Err(at.with_key("joints").fault("", why))
        }
    }
}

/// Creates a robot with one chain of revolute joints, one row per joint.
fn serial_robot(
    at: &KeyPath,
    name: String,
    rows: &[DenavitHartenberg],
    limits: Option<Vec<[f64; 2]>>,
) -> Checked<Robot> {
    let count = rows.len();
    if count == 0 || count > MAX_JOINTS {
        let why = format!("must have 1 to {MAX_JOINTS} revolute joints");
        return Err(at.with_key("joints").fault(format_args!("{count} joints"), why));
    }
    for (index, row) in rows.iter().enumerate() {
        check_row(&at.with_key("joints").with_index(index), row)?;
    }
    let all = limits.unwrap_or_else(|| vec![[-TAU, TAU]; count]);
    check_joint_count(&at.with_key("limits_rad"), all.len(), count)?;
    for (index, &limits) in all.iter().enumerate() {
        check_limits(&at.with_key("limits_rad").with_index(index), limits, JointKind::Revolute)?;
    }
    let joint = |(index, &limits): (usize, &[f64; 2])| Joint {
        name: format!("joint{}", index + 1),
        kind: JointKind::Revolute,
        limits,
    };
    let rows = rows.iter().zip(&all);
    let rows = rows.map(|(&table, &limits)| ChainRow { kind: RowKind::Revolute, table, limits });
    let chain = Chain {
        name: "chain".to_owned(),
        base: ChainBase::default(),
        joints: (0..count).collect(),
        rows: rows.collect(),
    };
    Ok(Robot { name, urdf: None, joints: all.iter().enumerate().map(joint).collect(), chains: vec![chain] })
}

/// Checks that the lengths of a row, in m, fit Q1.14 words, and that the angles are finite.
fn check_row(at: &KeyPath, row: &DenavitHartenberg) -> Checked<()> {
    at.with_key("a").to_fixed(row.a, Q1_14::try_nearest)?;
    at.with_key("d").to_fixed(row.d, Q1_14::try_nearest)?;
    at.with_key("alpha").check_finite(row.alpha)?;
    at.with_key("theta_offset").check_finite(row.theta_offset)?;
    Ok(())
}

fn check_limits(at: &KeyPath, [min, max]: [f64; 2], kind: JointKind) -> Checked<[f64; 2]> {
    let got = format!("[{min}, {max}]");
    // This form also refuses NaN.
    if !(min.is_finite() && max.is_finite() && min < max) {
        return Err(at.fault(got, "the smaller position must come first"));
    }
    if kind == JointKind::Prismatic && (min < -MAX_PRISMATIC_POSITION_M || max > MAX_PRISMATIC_POSITION_M) {
        return Err(at.fault(
            got,
            format_args!(
                "a prismatic joint must stay within -{MAX_PRISMATIC_POSITION_M} to \
                 {MAX_PRISMATIC_POSITION_M} m"
            ),
        ));
    }
    Ok([min, max])
}

fn check_joints(at: &KeyPath, raw: &[raw::RawJoint]) -> Checked<Vec<Joint>> {
    let count = raw.len();
    if count == 0 || count > MAX_ROBOT_JOINTS {
        let why = format!("a robot must have 1 to {MAX_ROBOT_JOINTS} joints");
        return Err(at.with_key("joint").fault(format_args!("{count} joints"), why));
    }
    let mut joints: Vec<Joint> = Vec::with_capacity(count);
    for (index, raw) in raw.iter().enumerate() {
        let at = at.with_key("joint").with_index(index);
        if raw.name.is_empty() || joints.iter().any(|joint| joint.name == raw.name) {
            let why = "each joint must have a unique name";
            return Err(at.with_key("name").fault(format_args!("{:?}", raw.name), why));
        }
        let kinds = [JointKind::Revolute, JointKind::Prismatic].map(|kind| (kind.name(), kind));
        let kind = at.with_key("kind").parse_choice(&raw.kind, &kinds)?;
        let given = match (raw.limits, kind) {
            (Some(limits), _) => limits,
            (None, JointKind::Revolute) => [-TAU, TAU],
            (None, JointKind::Prismatic) => {
                return Err(at.with_key("limits").fault("", "a prismatic joint needs limits, in m"));
            }
        };
        let limits = check_limits(&at.with_key("limits"), given, kind)?;
        joints.push(Joint { name: raw.name.clone(), kind, limits });
    }
    Ok(joints)
}

fn check_chains(at: &KeyPath, raw: &[raw::RawChain], joints: &[Joint]) -> Checked<Vec<Chain>> {
    if raw.is_empty() {
        return Err(at.with_key("chain").fault("[]", "a robot must have at least one chain"));
    }
    let mut chains: Vec<Chain> = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let at = at.with_key("chain").with_index(index);
        if raw.name.is_empty() || chains.iter().any(|chain| chain.name == raw.name) {
            let why = "each chain must have a unique name";
            return Err(at.with_key("name").fault(format_args!("{:?}", raw.name), why));
        }
        chains.push(check_chain(&at, raw, joints)?);
    }
    let unused = |(index, _): &(usize, &Joint)| chains.iter().all(|chain| !chain.joints.contains(index));
    if let Some((index, joint)) = joints.iter().enumerate().find(unused) {
        let at = at.with_key("joint").with_index(index).with_key("name");
        return Err(at.fault(format_args!("{:?}", joint.name), "no chain contains this joint"));
    }
    Ok(chains)
}

fn check_base(at: &KeyPath, raw: &raw::RawBase) -> Checked<ChainBase> {
    if let Some((index, value)) =
        raw.position.iter().enumerate().find(|(_, it)| it.is_nan() || it.abs() > MAX_BASE_COORDINATE_M)
    {
        return Err(at.with_key("position").with_index(index).fault(
            value,
            format_args!("must be within -{MAX_BASE_COORDINATE_M} to {MAX_BASE_COORDINATE_M} m"),
        ));
    }
    let orientation = raw.orientation.map(|it| normalized(&at.with_key("orientation"), "quaternion", it));
    Ok(ChainBase {
        position: raw.position,
        orientation: orientation.unwrap_or_else(|| Ok(ChainBase::default().orientation))?,
    })
}

fn check_chain(at: &KeyPath, raw: &raw::RawChain, joints: &[Joint]) -> Checked<Chain> {
    let count = raw.rows.len();
    if count > MAX_ROWS {
        let why = format!("a chain can have at most {MAX_ROWS} rows");
        return Err(at.with_key("rows").fault(format_args!("{count} rows"), why));
    }
    let mut chain = Chain {
        name: raw.name.clone(),
        base: raw
            .base
            .as_ref()
            .map_or_else(|| Ok(ChainBase::default()), |raw| check_base(&at.with_key("base"), raw))?,
        joints: Vec::new(),
        rows: Vec::with_capacity(raw.rows.len()),
    };
    for (index, raw) in raw.rows.iter().enumerate() {
        let at = at.with_key("rows").with_index(index);
        let table =
            DenavitHartenberg { a: raw.a, alpha: raw.alpha, d: raw.d, theta_offset: raw.theta_offset };
        check_row(&at, &table)?;
        let Some(name) = &raw.joint else {
            chain.rows.push(ChainRow { kind: RowKind::Fixed, table, limits: [0.0; 2] });
            continue;
        };
        let at = at.with_key("joint");
        let known = joints.iter().position(|joint| joint.name == *name);
        let known = known.and_then(|number| Some((number, joints.get(number)?)));
        let (number, joint) = known.ok_or_else(|| {
            at.fault(format_args!("{name:?}"), "the robot has no such joint: name one of [[robot.joint]]")
        })?;
        if chain.joints.contains(&number) {
            return Err(at.fault(format_args!("{name:?}"), "this chain already contains the joint"));
        }
        let [min, max] = joint.limits;
        if joint.kind == JointKind::Prismatic
            && [min, max].iter().any(|q| (table.d + q).abs() > MAX_PRISMATIC_POSITION_M)
        {
            let why = format!(
                "d plus the position must stay within -{MAX_PRISMATIC_POSITION_M} to {MAX_PRISMATIC_POSITION_M} m"
            );
            return Err(at.fault(format_args!("{name:?} from {min} to {max} with d = {}", table.d), why));
        }
        chain.joints.push(number);
        chain.rows.push(ChainRow { kind: joint.kind.row_kind(), table, limits: joint.limits });
    }
    let moving = chain.joints.len();
    if moving == 0 || moving > MAX_JOINTS {
        let why =
            format!("a chain must have 1 to {MAX_JOINTS} joints, which are its rows with the key joint");
        return Err(at.with_key("rows").fault(format_args!("{moving} joints"), why));
    }
    Ok(chain)
}

pub(super) fn check_joint_count(at: &KeyPath, got: usize, joints: usize) -> Checked<()> {
    if got == joints {
        return Ok(());
    }
    let why = format!("must have one value for each of the robot's {joints} joints");
    Err(at.fault(format_args!("{got} values"), why))
}

/// Normalises a vector or quaternion. Its length must be one, to within 1e-3.
pub(super) fn normalized<const N: usize>(at: &KeyPath, what: &str, parts: [f64; N]) -> Checked<[f64; N]> {
    let length = parts.iter().map(|part| part * part).sum::<f64>().sqrt();
    if length.is_nan() || (length - 1.0).abs() > UNIT_LENGTH_TOLERANCE {
        let got = parts.map(|part| part.to_string()).join(", ");
        let why =
            format!("this {what} has length {length:.6}; it must be 1 to within {UNIT_LENGTH_TOLERANCE}");
        return Err(at.fault(format_args!("[{got}]"), why));
    }
    Ok(parts.map(|part| part / length))
}
