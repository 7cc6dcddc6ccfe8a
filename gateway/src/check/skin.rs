//! Output of `skinbus check` for a skin.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use protocol::fixed::TorqueFormat;
use protocol::packet::crc16;
use protocol::skin::{Cell, CellName, ControllerKind, Skin, SkinReply};
use protocol::usage::{Failure, printable};
use serde_json::{Value, json};

use crate::arguments::bus_names;
use crate::print::{comma_separated, count_with_noun, or_else_text, space_separated};
use crate::robot_file::{SkinRobot, urdf_path};

/// Selection of the cells that are listed with or without the summary.
#[derive(Clone, Copy, Debug)]
pub(super) enum ListedCells<'a> {
    None,
    All,
    /// List this cell only, without the summary.
    Only(&'a CellName),
}

/// Checks a skin and its URDF as a run with a recording does. Returns the summary.
pub(super) fn check_and_summarize(
    file: &Path,
    skin: &Skin,
    listed: ListedCells<'_>,
    as_json: bool,
) -> Result<String, Failure> {
    if let Some(urdf) = &skin.robot.urdf {
        SkinRobot::read(skin, Some(&urdf_path(file, urdf)))?;
    }
    let is_listed = |cell: &&Cell| match listed {
        ListedCells::None => false,
        ListedCells::All => true,
        ListedCells::Only(named) => named.matches_cell(bus_name(skin, cell), cell.node),
    };
    let cells: Vec<_> = skin.cells.iter().filter(is_listed).collect();
    if let ListedCells::Only(named) = listed
        && cells.is_empty()
    {
        let (file, buses) = (file.display(), comma_separated(bus_names(skin)));
        return Err(Failure::usage_error(format!(
            "--cell {named}: {file} does not have this cell on {buses}; --list lists all cells"
        )));
    }
    if as_json {
        return crate::print::to_pretty_json(&skin_json(file, skin, &cells));
    }
    let lines: String = cells.iter().map(|cell| cell_line(skin, cell)).collect();
    Ok(if let ListedCells::Only(_) = listed { lines } else { describe(skin) + &lines })
}

fn describe(skin: &Skin) -> String {
    let Skin { name, robot, timing, events: _, buses, controller, safety: _, cells } = skin;
    let controller = match &controller.kind {
        ControllerKind::Kinesthetic { .. } => "kinesthetic controller".to_owned(),
        ControllerKind::External { socket, .. } => format!("external controller at {socket}"),
    };
    let every = cells.first().map(|cell| format!(" (every {} us)", skin.parameters(cell).period_us));
    let (name, robot_name) = (printable(name), printable(&robot.name));
    let mut text = format!(
        "{name}: {}, {}\nrobot: {}, {}\ntiming: control loop {} Hz, joints {} Hz{}, {controller}\n",
        count_with_noun(cells.len(), "cell"),
        count_with_noun(buses.len(), "bus"),
        robot_name,
        count_with_noun(robot.joints.len(), "joint"),
        timing.control_hz,
        timing.broadcast_hz(),
        or_else_text(every, ""),
    );
    for chain in
        robot.chains.iter().filter(|chain| robot.chains.len() > 1 || chain.rows.len() > chain.joints.len())
    {
        let names = space_separated(
            chain.joints.iter().filter_map(|joint| robot.joints.get(*joint)).map(|joint| &joint.name),
        );
        let (joints, rows) =
            (count_with_noun(chain.joints.len(), "joint"), count_with_noun(chain.rows.len(), "row"));
        text += &format!("chain {}: {joints} in {rows}: {}\n", printable(&chain.name), printable(&names));
    }
    for (index, bus) in buses.iter().enumerate() {
        let format = bus.format.name();
        let reply = match bus.reply {
            SkinReply::Torque => "torque".to_owned(),
            SkinReply::Sum { slot_us, carry: true } => format!("sum in slots of {slot_us} us"),
            SkinReply::Sum { slot_us, carry: false } => format!("sum without carry, slots of {slot_us} us"),
        };
        let mut by_joint = BTreeMap::<_, usize>::new();
        for cell in skin.cells_on_bus(index) {
            *by_joint.entry(cell.joint).or_default() += 1;
        }
        let cells = count_with_noun(by_joint.values().sum::<usize>(), "cell");
        let parts =
            comma_separated(by_joint.iter().map(|(joint, cells)| format!("{cells} on joint {joint}")));
        let roots: Vec<_> = skin.cells_on_bus(index).filter(|cell| cell.root).map(|cell| cell.node).collect();
        // Cells that send torques have no use for a root.
        let roots = match roots.as_slice() {
            _ if bus.reply == SkinReply::Torque => String::new(),
            [] => "; no root".to_owned(),
            [root] => format!("; root: cell {root}"),
            roots => format!("; roots: cells {}", space_separated(roots)),
        };
        let rates = bus.bitrate.map(|nominal| match bus.data_bitrate {
            Some(data) => format!(", {nominal} and {data} bit/s"),
            None => format!(", {nominal} bit/s"),
        });
        let rates = or_else_text(rates, "");
        let chain = if robot.chains.len() > 1 {
            format!(", chain {}", skin.chain(index).name)
        } else {
            String::new()
        };
        let torques = match bus.torque_format {
            TorqueFormat::Q3_12 => String::new(),
            format @ (TorqueFormat::Q5_10 | TorqueFormat::Q7_8) => format!(", torques in {}", format.name()),
        };
        text += &format!(
            "bus {} ({format}{rates}{chain}, {reply}{torques}): {cells}: {parts}{roots}\n",
            bus.name
        );
    }
    for [first, second] in coincident_cells(skin) {
        let name = |cell: &Cell| format!("{} on {}", cell.node, bus_name(skin, cell));
        text += &format!("note: cells {} and {} have the same position\n", name(first), name(second));
    }
    text + &format!(
        "hash of the parameters of all cells: {:04X}; --list shows that of each cell\n",
        hash(skin)
    )
}

/// Returns pairs of cells that have the same position.
fn coincident_cells(skin: &Skin) -> Vec<[&Cell; 2]> {
    let mut known = HashMap::new();
    let place = |cell: &Cell| {
        (
            skin.buses.get(cell.bus).map(|bus| bus.chain),
            cell.row,
            cell.position.map(|metres| (metres + 0.0).to_bits()),
        )
    };
    let pair = |cell| match known.entry(place(cell)) {
        Entry::Occupied(first) => Some([*first.get(), cell]),
        Entry::Vacant(free) => {
            free.insert(cell);
            None
        }
    };
    skin.cells.iter().filter_map(pair).collect()
}

fn bus_name<'a>(skin: &'a Skin, cell: &Cell) -> &'a str {
    skin.buses.get(cell.bus).map_or("", |bus| bus.name.as_str())
}

/// Describes a cell in one line.
fn cell_line(skin: &Skin, cell: &Cell) -> String {
    let on_bus = bus_name(skin, cell);
    let Cell { node, serial, joint, row, position, normal, neighbors, root, .. } = cell;
    let (position, ports) =
        (space_separated(position), space_separated(neighbors.map(|port| or_else_text(port, "-"))));
    let normal = space_separated(rounded_normal(normal));
    let root = if *root { " root" } else { "" };
    let row = Some(*row).filter(|row| skin.chain(cell.bus).row_of(*joint) != Some(*row));
    let row = or_else_text(row.map(|row| format!(" row {row}")), "");
    let hash = skin.parameters(cell).hash();
    format!(
        "{on_bus} {node} joint {joint}{row} at {position} m normal {normal} ports {ports}{root} serial {serial} hash {hash:04X}\n"
    )
}

/// Rounds a unit vector to four decimals, which is as precise as can be measured. A vector computed from a quaternion
/// has more.
fn rounded_normal(normal: &[f64; 3]) -> [f64; 3] {
    normal.map(|part| (part * 1e4).round() / 1e4 + 0.0)
}

/// Returns a hash over the parameters of all cells.
fn hash(skin: &Skin) -> u16 {
    let images: Vec<u8> = skin.cells.iter().flat_map(|cell| skin.parameters(cell).encode_image()).collect();
    crc16(&images)
}

/// Returns the skin and these cells as JSON.
fn skin_json(file: &Path, skin: &Skin, cells: &[&Cell]) -> Value {
    let buses = skin.buses.iter().enumerate().map(|(index, bus)| {
        let roots = skin.cells_on_bus(index).filter(|cell| cell.root).map(|cell| cell.node.get());
        json!({
            "name": bus.name,
            "format": bus.format.name(),
            "reply": if bus.reply == SkinReply::Torque { "torque" } else { "sum" },
            "bitrate": bus.bitrate,
            "data_bitrate": bus.data_bitrate,
            "cells": skin.cells_on_bus(index).count(),
            "roots": roots.collect::<Vec<_>>(),
        })
    });
    let cells = cells.iter().map(|cell| {
        json!({
            "bus": bus_name(skin, cell),
            "node": cell.node.get(),
            "joint": cell.joint,
            "position_m": cell.position,
            "normal": rounded_normal(&cell.normal),
            "neighbors": cell.neighbors.map(|port| port.map(protocol::id::CellId::get)),
            "root": cell.root,
            "serial": cell.serial,
            "hash": format!("{:04X}", skin.parameters(cell).hash()),
        })
    });
    json!({
        "file": file.display().to_string(),
        "kind": "skin",
        "name": skin.name,
        "robot": skin.robot.name,
        "joints": skin.robot.joints.iter().map(|joint| &joint.name).collect::<Vec<_>>(),
        "control_hz": skin.timing.control_hz,
        "broadcast_hz": skin.timing.broadcast_hz(),
        "cell_count": skin.cells.len(),
        "buses": buses.collect::<Vec<_>>(),
        "hash": format!("{:04X}", hash(skin)),
        "cells": cells.collect::<Vec<_>>(),
    })
}
