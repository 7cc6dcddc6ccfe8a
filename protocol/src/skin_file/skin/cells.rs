//! Checks of the cells in a skin file.

use std::collections::HashMap;

use super::chains::normalized;
use super::reach::{MAX_REACH, max_frame_distance};
use super::{Cell, Robot, SkinBus, baseline, raw};
use crate::document::{Checked, KeyPath};
use crate::fixed::Q;
use crate::id::CellId;
use crate::parameters::{Baseline, Contact};

/// The settings of the skin that apply to a cell unless the cell overrides them.
#[derive(Clone, Copy)]
pub(super) struct CellDefaults {
    pub(super) contact: Contact,
    pub(super) baseline: Baseline,
}

pub(super) fn check_cells(
    raw: &[raw::RawCell],
    robot: &Robot,
    buses: &[SkinBus],
    base: CellDefaults,
) -> Checked<Vec<Cell>> {
    let mut taken = HashMap::new();
    let mut serials = HashMap::new();
    let mut cells = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let at = KeyPath::top_level_key("cell").with_index(index);
        let cell = check_cell(&at, raw, robot, buses, base)?;
        if let Some(first) = taken.insert((cell.bus, cell.node), index) {
            let bus = buses.get(cell.bus).map_or("", |bus| &bus.name);
            let why = format!("cell[{first}] already has this node id on {bus:?}");
            return Err(at.with_key("node").fault(raw.node, why));
        }
        if let Some(first) = serials.insert(cell.serial, index) {
            let why = format!("cell[{first}] already has this serial number");
            return Err(at.with_key("serial").fault(cell.serial, why));
        }
        cells.push(cell);
    }
    for (index, port, cell, neighbor) in neighbor_mentions(&cells) {
        if neighbor == cell.node || !taken.contains_key(&(cell.bus, neighbor)) {
            let why = "must be the node id of another cell on the same bus, or 0";
            return Err(KeyPath::top_level_key("cell")
                .with_index(index)
                .with_key("neighbors")
                .with_index(port)
                .fault(neighbor, why));
        }
    }
    check_wire_ends(&cells)?;
    Ok(cells)
}

/// Iterates over the neighbours that cells name. Each item is the index of a cell, one of its ports, the cell, and the
/// node id of the neighbour at that port.
fn neighbor_mentions(cells: &[Cell]) -> impl Iterator<Item = (usize, usize, &Cell, CellId)> {
    cells.iter().enumerate().flat_map(|(index, cell)| {
        let ports = cell.neighbors.iter().enumerate();
        ports.filter_map(move |(port, neighbor)| Some((index, port, cell, (*neighbor)?)))
    })
}

/// Checks that every wire has two ends: if a cell names a neighbour, the neighbour must name the cell equally often.
fn check_wire_ends(cells: &[Cell]) -> Checked<()> {
    let mut all = HashMap::new();
    for (.., cell, neighbor) in neighbor_mentions(cells) {
        *all.entry((cell.bus, cell.node, neighbor)).or_insert(0) += 1;
    }
    let mut named = HashMap::new();
    for (index, port, cell, neighbor) in neighbor_mentions(cells) {
        let node = cell.node;
        let so_far = named.entry((cell.bus, node, neighbor)).or_insert(0);
        *so_far += 1;
        if *so_far > all.get(&(cell.bus, neighbor, node)).copied().unwrap_or(0) {
            let why = format!(
                "the other end of this wire is missing: name node {node} once more in the neighbors of node {neighbor}, \
                 or put 0 here"
            );
            return Err(KeyPath::top_level_key("cell")
                .with_index(index)
                .with_key("neighbors")
                .with_index(port)
                .fault(neighbor, why));
        }
    }
    Ok(())
}

fn check_cell(
    at: &KeyPath,
    raw: &raw::RawCell,
    robot: &Robot,
    buses: &[SkinBus],
    base: CellDefaults,
) -> Checked<Cell> {
    let bus = bus_index(at, raw, buses)?;
    let node = CellId::new(raw.node);
    let why = "must be 1 to 254; further cells need another bus";
    let node = node.map_err(|_| at.with_key("node").fault(raw.node, why))?;
    let (joint, row) = joint_and_row(at, raw, robot, buses.get(bus).map_or(0, |bus| bus.chain))?;
    for (axis, &value) in raw.position.iter().enumerate() {
        at.with_key("position").with_index(axis).check_finite(value)?;
    }
    let chain = buses.get(bus).and_then(|bus| robot.chains.get(bus.chain));
    let rows = chain.and_then(|chain| chain.rows.get(..usize::from(row))).unwrap_or_default();
    let reach = max_frame_distance(rows, raw.position);
    if reach >= MAX_REACH {
        let [x, y, z] = raw.position;
        let why = format!(
            "the distance from node {node} to a joint frame of its chain can reach {reach:.3} m, {:.3} m \
             more than Q1.14 can hold ({MAX_REACH} m)",
            reach - MAX_REACH
        );
        return Err(at.with_key("position").fault(format_args!("[{x}, {y}, {z}]"), why));
    }
    let mut neighbors = [None; 4];
    for (port, (neighbor, &got)) in neighbors.iter_mut().zip(&raw.neighbors).enumerate() {
        if got != 0 {
            let wrong =
                |_| at.with_key("neighbors").with_index(port).fault(got, "must be 1 to 254, or 0 for none");
            *neighbor = Some(CellId::new(got).map_err(wrong)?);
        }
    }
    let serial = raw.serial.unwrap_or_else(|| default_serial_number(bus, node));
    Ok(Cell {
        bus,
        node,
        serial: at.with_key("serial").check_range(serial, 0..=u32::MAX, "")?,
        joint,
        row,
        position: raw.position,
        normal: cell_normal(at, raw)?,
        orientation: raw
            .orientation
            .map(|it| normalized(&at.with_key("orientation"), "quaternion", it))
            .transpose()?,
        neighbors,
        root: raw.root,
        contact: contact_with_overrides(at, raw.contact(), base.contact)?,
        baseline: baseline::cell_baseline(at, raw, base.baseline)?,
    })
}

/// Returns `base` with the gains and thresholds that are given.
pub(super) fn contact_with_overrides(at: &KeyPath, raw: raw::RawContact, base: Contact) -> Checked<Contact> {
    let raw::RawContact { alpha_c, alpha_p, contact_threshold_n, proximity_threshold, force_threshold_n } =
        raw;
    let mut to = base;
    at.with_key("alpha_c").set_fixed_if_given(alpha_c, &mut to.alpha_c, Q::try_nearest)?;
    at.with_key("alpha_p").set_fixed_if_given(alpha_p, &mut to.alpha_p, Q::try_nearest)?;
    at.with_key("contact_threshold_n").set_fixed_if_given(
        contact_threshold_n,
        &mut to.contact_threshold,
        Q::try_round_up,
    )?;
    at.with_key("proximity_threshold").set_fixed_if_given(
        proximity_threshold,
        &mut to.proximity_threshold,
        Q::try_round_up,
    )?;
    at.with_key("force_threshold_n").set_fixed_if_given(
        force_threshold_n,
        &mut to.force_threshold,
        Q::try_round_up,
    )?;
    Ok(to)
}

/// Returns the serial number of a cell whose file gives none. Default serial numbers are unique within a skin.
fn default_serial_number(bus: usize, node: CellId) -> i64 {
    i64::try_from(bus).unwrap_or(0) * 1_000 + i64::from(node.get())
}

/// Returns the joint that moves a cell and the row that carries it. The file may omit either, but not both.
fn joint_and_row(at: &KeyPath, raw: &raw::RawCell, robot: &Robot, chain: usize) -> Checked<(u8, u8)> {
    let Some(chain) = robot.chains.get(chain) else { return Ok((0, 0)) };
    let (joints, rows) = (chain.joints.len(), chain.rows.len());
    let within = |key, got: i64, max: usize, what: &str| {
        let number = u8::try_from(got).ok().filter(|&it| it > 0 && usize::from(it) <= max);
        number.ok_or_else(|| at.with_key(key).fault(got, format_args!("{what} 1 to {max}")))
    };
    let joint = raw.joint.map(|got| within("joint", got, joints, "use a joint from")).transpose()?;
    let row = raw.row.map(|got| within("row", got, rows, "use a row from")).transpose()?;
    match (joint, row) {
        (None, None) => Err(at
            .with_key("joint")
            .fault("", format_args!("must name the joint that moves the cell: 1 to {joints}"))),
        (Some(joint), None) => Ok((joint, chain.row_of(joint).unwrap_or_default())),
        (given, Some(row)) => match chain.joint_of_row(row) {
            0 => Err(at.with_key("row").fault(
                row,
                "no joint moves this row: choose the row of a joint, or a \
                                                    row after it",
            )),
            joint if given.is_none_or(|given| given == joint) => Ok((joint, row)),
            joint => {
                let why = format!(
                    "this row is moved by joint {joint}, not by the joint given: correct the \
                                   key joint, or leave it out"
                );
                Err(at.with_key("row").fault(row, why))
            }
        },
    }
}

/// Returns the index of a cell's bus. The file may omit the name if there is only one bus.
fn bus_index(at: &KeyPath, raw: &raw::RawCell, buses: &[SkinBus]) -> Checked<usize> {
    let names = || buses.iter().map(|bus| format!("{:?}", bus.name)).collect::<Vec<_>>().join(", ");
    let at = at.with_key("bus");
    match &raw.bus {
        Some(name) => buses.iter().position(|bus| bus.name == *name).ok_or_else(|| {
            let why = format!("the skin has no such bus; its buses are {}", names());
            at.fault(format_args!("{name:?}"), why)
        }),
        None if buses.len() == 1 => Ok(0),
        None => Err(at.fault("", format_args!("must name the bus of the cell: one of {}", names()))),
    }
}

/// Returns the outward normal of a cell: the given one, or the z axis of the given orientation.
fn cell_normal(at: &KeyPath, raw: &raw::RawCell) -> Checked<[f64; 3]> {
    match (raw.orientation, raw.normal) {
        (Some(orientation), None) => {
            let [x, y, z, w] = normalized(&at.with_key("orientation"), "quaternion", orientation)?;
            Ok([2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)])
        }
        (None, Some(normal)) => normalized(&at.with_key("normal"), "vector", normal),
        (Some(_), Some(_)) => {
            Err(at.with_key("normal").fault("", "give either normal or orientation, not both"))
        }
        (None, None) => {
            let why = "missing: give the outward normal of the cell as [x, y, z], or its orientation";
            Err(at.with_key("normal").fault("", why))
        }
    }
}
