//! The robot: its joints, and the chains of joints that carry skin.

use core::f64::consts::TAU;

use serde::Deserialize;

use super::cells::unit;
use super::check::Checked;
use super::raw;
use crate::document::Place;
use crate::fixed::Q1_14;
use crate::parameters::{MAX_JOINTS, MAX_ROWS, RowKind};

/// Joints that a robot can have, over all of its chains.
pub const MAX_ROBOT_JOINTS: usize = 32;
/// Positions in m that a word holds: [-2, 2), less some steps for rounding.
const SLIDE: f64 = 2.0 - 1e-3;
/// How far a chain begins from the robot's base, in m.
const FAR: f64 = 100.0;

/// A tree of joints, as chains from its base that may share their first joints.
#[derive(Clone, Debug, PartialEq)]
pub struct Robot {
    /// Its name.
    pub name: String,
    /// The file that describes what it looks like: a path from the skin's file.
    pub urdf: Option<String>,
    /// Its joints, in the order in which controllers and recordings have them.
    pub joints: Vec<Joint>,
    /// Its chains, each of which has a joint at least.
    pub chains: Vec<Chain>,
}

/// One joint.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Its name.
    pub name: String,
    /// What it does.
    pub kind: JointKind,
    /// Minimum and maximum position, in the unit of its kind.
    pub limits: [f64; 2],
}

/// What a joint does.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum JointKind {
    /// It turns: positions in rad, torques in Nm.
    #[default]
    Revolute,
    /// It slides: positions in m, forces in N.
    Prismatic,
}

impl JointKind {
    /// Its name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.row().name()
    }

    /// The kind of its row.
    #[must_use]
    pub const fn row(self) -> RowKind {
        match self {
            Self::Revolute => RowKind::Revolute,
            Self::Prismatic => RowKind::Prismatic,
        }
    }

    /// The unit of its position.
    #[must_use]
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Revolute => "rad",
            Self::Prismatic => "m",
        }
    }

    /// The unit of its torque or force.
    #[must_use]
    pub const fn torque_unit(self) -> &'static str {
        match self {
            Self::Revolute => "Nm",
            Self::Prismatic => "N",
        }
    }

    /// A position as a word: quarter turns or m. `None` when it is not finite.
    #[must_use]
    pub fn word(self, position: f64) -> Option<Q1_14> {
        match self {
            Self::Revolute => Q1_14::from_radians(position),
            Self::Prismatic => position.is_finite().then(|| Q1_14::nearest(position)),
        }
    }

    /// The position that a word stands for, in rad or m.
    #[must_use]
    pub fn position(self, word: Q1_14) -> f64 {
        match self {
            Self::Revolute => word.to_radians(),
            Self::Prismatic => word.to_f64(),
        }
    }
}

/// A chain of joints, base to tip.
#[derive(Clone, Debug, PartialEq)]
pub struct Chain {
    /// Its name.
    pub name: String,
    /// Where frame 0 of its table is, seen from the robot's base.
    pub base: Base,
    /// Its joints as indices into [`Robot::joints`]; 1 to 14.
    pub joints: Vec<usize>,
    /// Its table, base to tip: a row for each joint, and fixed ones; at most 32.
    pub rows: Vec<ChainRow>,
}

/// A pose: where a chain begins. No cell computes with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Base {
    /// In m.
    pub position: [f64; 3],
    /// A unit quaternion: x, y, z, w.
    pub orientation: [f64; 4],
}

impl Default for Base {
    fn default() -> Self {
        Self { position: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0] }
    }
}

impl Base {
    /// From frame 0 to the robot's base, as a matrix of 4 by 4 in columns, lengths in m.
    #[must_use]
    pub fn matrix(&self) -> [[f64; 4]; 4] {
        let norm = self.orientation.iter().map(|it| it * it).sum::<f64>().sqrt();
        let [x, y, z, w] = self.orientation.map(|it| it / norm);
        let [px, py, pz] = self.position;
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z), 2.0 * (x * z - w * y), 0.0],
            [2.0 * (x * y - w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z + w * x), 0.0],
            [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z, 0.0],
            [px, py, pz, 1.0],
        ]
    }
}

/// One row of a chain's table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChainRow {
    /// What its joint does.
    pub kind: RowKind,
    /// Its constants.
    pub table: DenavitHartenberg,
    /// The range of its joint's position; zeros of a fixed row.
    pub limits: [f64; 2],
}

/// One row of a table, `Rz(theta + theta_offset) Tz(d) Tx(a) Rx(alpha)`; what is not said is 0.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq)]
#[serde(deny_unknown_fields, default)]
pub struct DenavitHartenberg {
    /// Length of the link in m.
    pub a: f64,
    /// Twist in rad.
    pub alpha: f64,
    /// Offset along the joint's axis in m; the position of a prismatic joint is added to it.
    pub d: f64,
    /// What is added to the position of a revolute joint, in rad; the whole angle of other rows.
    pub theta_offset: f64,
}

impl Chain {
    /// The row of a joint, which is counted from 1; from 1.
    #[must_use]
    pub fn row_of(&self, joint: u8) -> Option<u8> {
        let moving = (1..).zip(&self.rows).filter(|(_, row)| row.kind != RowKind::Fixed);
        moving.map(|(number, _)| number).nth(usize::from(joint).checked_sub(1)?)
    }

    /// The joint that moves the link of a row, both counted from 1; 0 below the first joint.
    #[must_use]
    pub fn joint_below(&self, row: u8) -> u8 {
        let moving = self.rows.iter().take(row.into()).filter(|row| row.kind != RowKind::Fixed);
        u8::try_from(moving.count()).unwrap_or(u8::MAX)
    }
}

/// The robot of the file's words.
pub(super) fn robot(raw: raw::Robot) -> Checked<Robot> {
    let at = Place::named("robot");
    if raw.urdf.as_ref().is_some_and(String::is_empty) {
        return Err(at.key("urdf").fault("\"\"", "the path of a file, from the skin's file"));
    }
    match (raw.joints, raw.joint.is_empty() && raw.chain.is_empty()) {
        (Some(rows), true) => Ok(Robot { urdf: raw.urdf, ..serial(&at, raw.name, &rows, raw.limits_rad)? }),
        (None, false) => {
            if raw.limits_rad.is_some() {
                return Err(at.key("limits_rad").fault("", "with [[robot.joint]] each joint has its limits"));
            }
            let joints = joints(&at, &raw.joint)?;
            let chains = chains(&at, &raw.chain, &joints)?;
            Ok(Robot { name: raw.name, urdf: raw.urdf, joints, chains })
        }
        (Some(_), false) => {
            let why = "either joints, or [[robot.joint]] and [[robot.chain]], not both";
            Err(at.key("joints").fault("", why))
        }
        (None, true) => {
            let why = "give the rows of its joints, or [[robot.joint]] and [[robot.chain]]";
            Err(at.key("joints").fault("", why))
        }
    }
}

/// A robot of one chain of revolute joints, a row each.
fn serial(
    at: &Place,
    name: String,
    rows: &[DenavitHartenberg],
    limits: Option<Vec<[f64; 2]>>,
) -> Checked<Robot> {
    let count = rows.len();
    if count == 0 || count > MAX_JOINTS {
        let why = format!("a robot has 1 to {MAX_JOINTS} revolute joints here");
        return Err(at.key("joints").fault(format_args!("{count} joints"), why));
    }
    for (index, row) in rows.iter().enumerate() {
        fits(&at.key("joints").nth(index), row)?;
    }
    let all = limits.unwrap_or_else(|| vec![[-TAU, TAU]; count]);
    super::check::same_length(&at.key("limits_rad"), all.len(), count)?;
    for (index, &limits) in all.iter().enumerate() {
        self::limits(&at.key("limits_rad").nth(index), limits, JointKind::Revolute)?;
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
        base: Base::default(),
        joints: (0..count).collect(),
        rows: rows.collect(),
    };
    Ok(Robot { name, urdf: None, joints: all.iter().enumerate().map(joint).collect(), chains: vec![chain] })
}

/// Whether the lengths of a row fit their words, and its angles are numbers.
fn fits(at: &Place, row: &DenavitHartenberg) -> Checked<()> {
    at.key("a").fit(row.a, Q1_14::try_nearest)?;
    at.key("d").fit(row.d, Q1_14::try_nearest)?;
    at.key("alpha").finite(row.alpha)?;
    at.key("theta_offset").finite(row.theta_offset)?;
    Ok(())
}

fn limits(at: &Place, [min, max]: [f64; 2], kind: JointKind) -> Checked<[f64; 2]> {
    let got = format!("[{min}, {max}]");
    // Written so that NaN is refused too.
    if !(min.is_finite() && max.is_finite() && min < max) {
        return Err(at.fault(got, "the smaller position comes first"));
    }
    if kind == JointKind::Prismatic && (min < -SLIDE || max > SLIDE) {
        return Err(at.fault(got, format_args!("a joint slides within -{SLIDE} to {SLIDE} m")));
    }
    Ok([min, max])
}

fn joints(at: &Place, raw: &[raw::Joint]) -> Checked<Vec<Joint>> {
    let count = raw.len();
    if count == 0 || count > MAX_ROBOT_JOINTS {
        let why = format!("a robot has 1 to {MAX_ROBOT_JOINTS} joints");
        return Err(at.key("joint").fault(format_args!("{count} joints"), why));
    }
    let mut joints: Vec<Joint> = Vec::with_capacity(count);
    for (index, raw) in raw.iter().enumerate() {
        let at = at.key("joint").nth(index);
        if raw.name.is_empty() || joints.iter().any(|joint| joint.name == raw.name) {
            let why = "each joint has a name of its own";
            return Err(at.key("name").fault(format_args!("{:?}", raw.name), why));
        }
        let kinds = [JointKind::Revolute, JointKind::Prismatic].map(|kind| (kind.name(), kind));
        let kind = at.key("kind").word(&raw.kind, &kinds)?;
        let given = match (raw.limits, kind) {
            (Some(limits), _) => limits,
            (None, JointKind::Revolute) => [-TAU, TAU],
            (None, JointKind::Prismatic) => {
                return Err(at.key("limits").fault("", "a prismatic joint needs them, in m"));
            }
        };
        let limits = limits(&at.key("limits"), given, kind)?;
        joints.push(Joint { name: raw.name.clone(), kind, limits });
    }
    Ok(joints)
}

fn chains(at: &Place, raw: &[raw::Chain], joints: &[Joint]) -> Checked<Vec<Chain>> {
    if raw.is_empty() {
        return Err(at.key("chain").fault("[]", "at least one chain is needed"));
    }
    let mut chains: Vec<Chain> = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let at = at.key("chain").nth(index);
        if raw.name.is_empty() || chains.iter().any(|chain| chain.name == raw.name) {
            let why = "each chain has a name of its own";
            return Err(at.key("name").fault(format_args!("{:?}", raw.name), why));
        }
        chains.push(chain(&at, raw, joints)?);
    }
    let unused = |(index, _): &(usize, &Joint)| chains.iter().all(|chain| !chain.joints.contains(index));
    if let Some((index, joint)) = joints.iter().enumerate().find(unused) {
        let at = at.key("joint").nth(index).key("name");
        return Err(at.fault(format_args!("{:?}", joint.name), "no chain has this joint"));
    }
    Ok(chains)
}

fn base(at: &Place, raw: &raw::Base) -> Checked<Base> {
    if let Some((index, value)) =
        raw.position.iter().enumerate().find(|(_, it)| it.is_nan() || it.abs() > FAR)
    {
        return Err(at
            .key("position")
            .nth(index)
            .fault(value, format_args!("it must be within -{FAR} to {FAR} m")));
    }
    let orientation = raw.orientation.map(|it| unit(&at.key("orientation"), "quaternion", it));
    Ok(Base {
        position: raw.position,
        orientation: orientation.unwrap_or_else(|| Ok(Base::default().orientation))?,
    })
}

fn chain(at: &Place, raw: &raw::Chain, joints: &[Joint]) -> Checked<Chain> {
    let count = raw.rows.len();
    if count > MAX_ROWS {
        let why = format!("a chain has at most {MAX_ROWS} rows");
        return Err(at.key("rows").fault(format_args!("{count} rows"), why));
    }
    let mut chain = Chain {
        name: raw.name.clone(),
        base: raw.base.as_ref().map_or_else(|| Ok(Base::default()), |raw| base(&at.key("base"), raw))?,
        joints: Vec::new(),
        rows: Vec::with_capacity(raw.rows.len()),
    };
    for (index, raw) in raw.rows.iter().enumerate() {
        let at = at.key("rows").nth(index);
        let table =
            DenavitHartenberg { a: raw.a, alpha: raw.alpha, d: raw.d, theta_offset: raw.theta_offset };
        fits(&at, &table)?;
        let Some(name) = &raw.joint else {
            chain.rows.push(ChainRow { kind: RowKind::Fixed, table, limits: [0.0; 2] });
            continue;
        };
        let at = at.key("joint");
        let known = joints.iter().position(|joint| joint.name == *name);
        let known = known.and_then(|number| Some((number, joints.get(number)?)));
        let (number, joint) = known
            .ok_or_else(|| at.fault(format_args!("{name:?}"), "no such joint: name one of robot.joint"))?;
        if chain.joints.contains(&number) {
            return Err(at.fault(format_args!("{name:?}"), "this chain has the joint already"));
        }
        let [min, max] = joint.limits;
        if joint.kind == JointKind::Prismatic && [min, max].iter().any(|q| (table.d + q).abs() > SLIDE) {
            let why = format!("d and its position together stay within -{SLIDE} to {SLIDE} m");
            return Err(at.fault(format_args!("{name:?} from {min} to {max} with d = {}", table.d), why));
        }
        chain.joints.push(number);
        chain.rows.push(ChainRow { kind: joint.kind.row(), table, limits: joint.limits });
    }
    let moving = chain.joints.len();
    if moving == 0 || moving > MAX_JOINTS {
        let why = format!("a chain has 1 to {MAX_JOINTS} joints: rows with the name of one");
        return Err(at.key("rows").fault(format_args!("{moving} joints"), why));
    }
    Ok(chain)
}
