//! The description of the columns in JSON.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use protocol::skin::{Skin, SkinReply};
use serde::Serialize;
use trace::capture::RecordingExtras;
use trace::columns::{FORMAT_VERSION, GroupRange};

use super::accounts::CaptureAccount;
use super::bus_and_node;

/// The value of one step of a sum, in Nm or N: sums are always Q7.8.
const SUM_STEP: f64 = 1.0 / 256.0;

/// The state of a file from which the columns were made. If it changes, the columns are no longer those of the file.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct SourceFile {
    path: String,
    bytes: u64,
    modified_ns: i64,
    inode: u64,
}

impl SourceFile {
    /// Reads the state of a file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be queried.
    pub fn of(path: &Path) -> io::Result<Self> {
        let about = fs::metadata(path)?;
        Ok(Self {
            path: path.display().to_string(),
            bytes: about.len(),
            modified_ns: about.mtime().saturating_mul(1_000_000_000).saturating_add(about.mtime_nsec()),
            inode: about.ino(),
        })
    }
}

#[derive(Serialize)]
struct JointFacts<'a> {
    name: &'a str,
    position_unit: &'static str,
    torque_unit: &'static str,
    /// True if torques on the joint come in sums, so that the distributed torque is NaN.
    summed: bool,
}

#[derive(Serialize)]
struct BusFacts<'a> {
    name: &'a str,
    is_in_skin: bool,
    reply: &'static str,
    /// The joints of the bus' chain, as indices.
    joints: Vec<usize>,
    /// The value of a step of a torque, in Nm or N.
    torque_step: f64,
    sum_step: f64,
}

#[derive(Serialize)]
struct CellFacts {
    bus: usize,
    node: u8,
    serial: u32,
    /// The joint that moves the cell, as an index.
    joint: Option<usize>,
}

#[derive(Debug, Serialize)]
struct GroupFacts {
    bus: u32,
    node: u8,
    begin: u64,
    end: u64,
}

/// The rows of a table, and those of each group if it is sorted by group.
#[derive(Debug, Serialize)]
pub(super) struct TableFacts {
    rows: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    groups: Option<Vec<GroupFacts>>,
}

impl TableFacts {
    pub(super) const fn with_rows(rows: u64) -> Self {
        Self { rows, groups: None }
    }

    pub(super) fn with_groups(ranges: &[GroupRange]) -> Self {
        let groups = ranges.iter().map(|&GroupRange { group, begin, end }| {
            let (bus, node) = bus_and_node(group);
            GroupFacts { bus, node, begin, end }
        });
        let rows = ranges.last().map_or(0, |last| last.end);
        Self { rows, groups: Some(groups.collect()) }
    }
}

/// The whole description. The name of its first field marks a folder of columns.
#[derive(Serialize)]
struct Description<'a> {
    skinbus_columns: u32,
    program: &'a str,
    sources: &'a [SourceFile],
    skin_file: Option<&'a SourceFile>,
    skin: &'a str,
    robot: &'a str,
    began_ns: u64,
    broadcast_hz: f64,
    /// The part that is missing at the end of a capture that was not finished.
    unfinished: Option<&'a str>,
    joints: Vec<JointFacts<'a>>,
    buses: Vec<BusFacts<'a>>,
    cells: Vec<CellFacts>,
    tables: &'a BTreeMap<&'static str, TableFacts>,
    accounts: &'a CaptureAccount,
    metadata: BTreeMap<&'a str, BTreeMap<&'a str, &'a str>>,
}

/// The files from which the columns were made, and the program that makes them.
#[derive(Clone, Copy, Debug)]
pub struct ColumnOrigin<'a> {
    /// The version of the program.
    pub program: &'a str,
    /// The captures.
    pub sources: &'a [SourceFile],
    /// The skin's file; `None` if the skin is that of the recording.
    pub skin_file: Option<&'a SourceFile>,
}

/// Returns the description as JSON.
pub(super) fn describe(
    origin: &ColumnOrigin<'_>,
    skin: &Skin,
    extras: &RecordingExtras,
    began_ns: u64,
    tables: &BTreeMap<&'static str, TableFacts>,
    accounts: &CaptureAccount,
) -> Result<String, serde_json::Error> {
    let joints = skin.robot.joints.iter().enumerate().map(|(at, joint)| JointFacts {
        name: &joint.name,
        position_unit: joint.kind.unit(),
        torque_unit: joint.kind.torque_unit(),
        summed: crate::explain::series::is_summed(skin, at),
    });
    let buses = accounts.buses.iter().enumerate().map(|(at, account)| {
        let bus = skin.buses.get(at);
        BusFacts {
            name: &account.name,
            is_in_skin: bus.is_some(),
            reply: match bus.map(|bus| bus.reply) {
                None => "unknown",
                Some(SkinReply::Torque) => "torque",
                Some(SkinReply::Sum { .. }) => "sum",
            },
            joints: bus.map_or_else(Vec::new, |_| skin.joints_on_bus(at).map(|(joint, _)| joint).collect()),
            torque_step: bus.map_or(0.0, |bus| bus.torque_format.step_size()),
            sum_step: SUM_STEP,
        }
    });
    let cells = skin.cells.iter().map(|cell| CellFacts {
        bus: cell.bus,
        node: cell.node.get(),
        serial: cell.serial,
        joint: skin.joints_on_bus(cell.bus).nth(usize::from(cell.joint) - 1).map(|(joint, _)| joint),
    });
    let metadata = extras.metadata.iter().map(|(name, facts)| {
        (name.as_str(), facts.iter().map(|(key, value)| (key.as_str(), value.as_str())).collect())
    });
    serde_json::to_string_pretty(&Description {
        skinbus_columns: FORMAT_VERSION,
        program: origin.program,
        sources: origin.sources,
        skin_file: origin.skin_file,
        skin: &skin.name,
        robot: &skin.robot.name,
        began_ns,
        broadcast_hz: skin.timing.broadcast_hz(),
        unfinished: extras.unfinished.as_deref(),
        joints: joints.collect(),
        buses: buses.collect(),
        cells: cells.collect(),
        tables,
        accounts,
        metadata: metadata.collect(),
    })
}
