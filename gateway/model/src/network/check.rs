//! Compares the wiring and the identities that cells report with the skin's description.
//!
//! Every difference is reported once, by its cause: the wires of a missing cell are not listed.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use protocol::id::CellId;
use protocol::message::{Heartbeat, PortsPage, State, TreePage, VERSION};
use protocol::port::PORTS;
use protocol::skin::BusWires;
use thiserror::Error;

use super::tree::{ReportedTree, tree_from_reports};

/// The reports of one cell, and the description of the cell.
#[derive(Clone, Copy, Debug)]
pub struct ObservedCell {
    /// Node id of the cell.
    pub node: CellId,
    /// Serial number described for this node id; `None` if the node id is not described.
    pub serial: Option<u32>,
    /// Expected hash of the cell's configuration.
    pub configuration: u16,
    /// Last heartbeat of the cell.
    pub heartbeat: Option<Heartbeat>,
    /// True if the cell sends now.
    pub alive: bool,
    /// Reported place of the cell in the tree.
    pub tree: Option<TreePage>,
    /// Reported neighbours at the ports of the cell.
    pub ports: Option<PortsPage>,
}

/// One end of a wire: a port of a cell.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct WireEnd {
    /// The cell.
    pub cell: CellId,
    /// The port of the cell, from 0.
    pub port: usize,
}

impl fmt::Display for WireEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "port {} of cell {}", self.port, self.cell)
    }
}

/// The directions in which a damaged wire still works.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub enum WorkingDirection {
    /// Neither direction works, or the directions are unknown.
    Nothing,
    /// Messages arrive from the first end at the second only.
    There,
    /// Messages arrive from the second end at the first only.
    Back,
}

impl WorkingDirection {
    /// Describes a damaged wire between two cells for users.
    fn describe(self, first: CellId, second: CellId) -> String {
        match self {
            Self::Nothing => "does not work".to_owned(),
            Self::There => format!("works only from cell {first} to cell {second}"),
            Self::Back => format!("works only from cell {second} to cell {first}"),
        }
    }
}

/// One difference between a network and its description.
#[derive(Clone, Debug, Eq, Error, Ord, PartialEq, PartialOrd)]
pub enum Difference {
    /// A described cell does not send.
    #[error("cell {0} is missing: start it, or remove it from the skin")]
    MissingCell(CellId),
    /// A cell that is not described sends on the bus.
    #[error(
        "cell {cell} with serial number {serial} is not in the skin: add it to the skin, or remove it from the bus"
    )]
    ExtraCell {
        /// Node id of the cell.
        cell: CellId,
        /// Serial number of the cell.
        serial: u32,
    },
    /// The cell that holds a node id has another serial number than described.
    #[error("{}", other_cell_message(*cell, *serial, *described, *belongs))]
    OtherCell {
        /// The node id.
        cell: CellId,
        /// Serial number of the cell that holds the node id.
        serial: u32,
        /// Described serial number.
        described: u32,
        /// Node id with which the description has that cell, if any.
        belongs: Option<CellId>,
    },
    /// Two cells have the same node id.
    #[error("two cells have node id {0}: stop one of the two")]
    Duplicate(CellId),
    /// A cell has another version of the protocol.
    #[error("cell {cell} uses {}", other_version_message(*version))]
    Version {
        /// The cell.
        cell: CellId,
        /// Reported version; `None` if only neighbours report the difference.
        version: Option<u16>,
    },
    /// A cell computes with parameters that differ from the skin's.
    #[error("cell {0} is configured for another skin: configure it with `skinbus commission`")]
    OtherSkin(CellId),
    /// A described wire does not work.
    #[error("the wire from {first} to {second} {}: check its connectors", carries.describe(first.cell, second.cell))]
    MissingWire {
        /// The end with the smaller node id.
        first: WireEnd,
        /// The other end.
        second: WireEnd,
        /// The directions that still work.
        carries: WorkingDirection,
    },
    /// A wire exists that is not described.
    #[error("the wire from {0} to {1} is not in the skin: add it to the skin, or unplug it")]
    ExtraWire(WireEnd, WireEnd),
    /// A port is connected to another end than described.
    #[error("{end} is wired to {leads} instead of {described}: correct the wiring or the skin")]
    SwappedWire {
        /// The port.
        end: WireEnd,
        /// The end to which the port leads.
        leads: WireEnd,
        /// The end to which the port should lead.
        described: WireEnd,
    },
    /// A cell without a node id is connected to this port.
    #[error(
        "a cell without a node id is wired to {0}: it takes part once the network has assigned it a free node id"
    )]
    Unnumbered(WireEnd),
    /// Cells whose parents form a circle, in order.
    #[error("the parents of {} form a loop, so sums would count cells twice: restart these cells", cell_list(.0))]
    Circle(Vec<CellId>),
    /// Cells without a route to a root.
    #[error(
        "{} {}; check the wires",
        cell_list(.0),
        if .0.len() == 1 {
            "has no route to the gateway, so no sum contains its torques"
        } else {
            "have no route to the gateway, so no sum contains their torques"
        }
    )]
    Unreachable(Vec<CellId>),
}

fn other_cell_message(cell: CellId, serial: u32, described: u32, belongs: Option<CellId>) -> String {
    match belongs {
        Some(belongs) => format!(
            "the cell with serial number {serial} uses node id {cell}, but in the skin it is cell {belongs}: swap the \
             cells, or their serial numbers in the skin"
        ),
        None => format!(
            "cell {cell} has serial number {serial}, but {described} in the skin: write {serial} into the skin, or \
             put the other cell back"
        ),
    }
}

fn other_version_message(version: Option<u16>) -> String {
    match version {
        Some(version) => format!(
            "version {version} of the protocol, but this gateway uses version {VERSION}: install matching versions"
        ),
        None => {
            "a protocol version that differs from its neighbours': install the same firmware on all of them"
                .to_owned()
        }
    }
}

/// Lists cells for users: at most six of them, and the number of the others.
#[must_use]
pub fn cell_list(cells: &[CellId]) -> String {
    let first: Vec<_> = cells.iter().take(6).map(ToString::to_string).collect();
    let (word, first) = (if cells.len() == 1 { "cell" } else { "cells" }, first.join(", "));
    match cells.len().saturating_sub(6) {
        0 => format!("{word} {first}"),
        more => format!("{word} {first} (and {more} more)"),
    }
}

impl Difference {
    /// Returns true if the difference makes the torque of some cell missing from all sums.
    #[must_use]
    pub const fn breaks_the_tree(&self) -> bool {
        match self {
            Self::MissingCell(_) | Self::Circle(_) | Self::Unreachable(_) | Self::Version { .. } => true,
            Self::ExtraCell { .. }
            | Self::OtherCell { .. }
            | Self::Duplicate(_)
            | Self::OtherSkin(_)
            | Self::MissingWire { .. }
            | Self::ExtraWire(..)
            | Self::SwappedWire { .. }
            | Self::Unnumbered(_) => false,
        }
    }
}

/// Returns all differences between the wires and cells of a network and the description, each once.
#[must_use]
pub fn differences(wires: &BusWires, cells: &[ObservedCell]) -> Vec<Difference> {
    let mut found: Vec<_> = cells.iter().flat_map(|cell| cell_differences(cell, cells)).collect();
    let versions = differing_versions(wires, cells);
    found.extend(versions.iter().map(|(&cell, &version)| Difference::Version { cell, version }));
    let network = PortMap::new(wires, cells, &versions);
    network.wire_differences(&mut found);
    let ReportedTree { cycles: circles, unreachable, .. } =
        tree_from_reports(cells.iter().map(|cell| (cell.node, cell.alive, cell.tree)));
    let circling: BTreeSet<_> = circles.iter().flatten().copied().collect();
    found.extend(circles.into_iter().map(Difference::Circle));
    let described = |node: &CellId| cells.iter().any(|cell| cell.node == *node && cell.serial.is_some());
    let named = |cell: &CellId| circling.contains(cell) || versions.contains_key(cell);
    let without: Vec<_> = unreachable.into_iter().filter(|cell| !named(cell) && described(cell)).collect();
    if !without.is_empty() {
        found.push(Difference::Unreachable(without));
    }
    found
}

/// Returns the differences that concern a cell alone, without its wires.
fn cell_differences(cell: &ObservedCell, all: &[ObservedCell]) -> Vec<Difference> {
    let node = cell.node;
    let heartbeat = cell.heartbeat.filter(|_| cell.alive);
    let Some(described) = cell.serial else {
        let extra = heartbeat.map(|heartbeat| Difference::ExtraCell { cell: node, serial: heartbeat.serial });
        return extra.into_iter().collect();
    };
    let Some(heartbeat) = heartbeat else { return vec![Difference::MissingCell(node)] };
    let mut found = Vec::new();
    if heartbeat.serial != described {
        let belongs = all.iter().find(|cell| cell.serial == Some(heartbeat.serial)).map(|cell| cell.node);
        found.push(Difference::OtherCell { cell: node, serial: heartbeat.serial, described, belongs });
    }
    if heartbeat.state.has(State::DUPLICATE) {
        found.push(Difference::Duplicate(node));
    }
    if heartbeat.state.has(State::CONFIGURED) && heartbeat.configuration != cell.configuration {
        found.push(Difference::OtherSkin(node));
    }
    found
}

/// Returns the cells with another version of the protocol, by their own reports or by those of their neighbours.
fn differing_versions(wires: &BusWires, cells: &[ObservedCell]) -> BTreeMap<CellId, Option<u16>> {
    let alive = || cells.iter().filter(|cell| cell.alive && cell.serial.is_some());
    let mut versions = BTreeMap::new();
    for cell in alive() {
        let version = cell.heartbeat.map(|heartbeat| heartbeat.state.version());
        if let Some(version) = version.filter(|&version| version != u16::from(VERSION)) {
            versions.insert(cell.node, Some(version));
        }
    }
    let mut reported = BTreeSet::new();
    for cell in alive().filter(|cell| !versions.contains_key(&cell.node)) {
        let ports = cell.ports.iter().flat_map(|ports| ports.ports.iter().enumerate());
        for (port, state) in ports.filter(|(_, state)| state.other_version) {
            let number = CellId::new(state.number.into()).ok();
            reported.extend(number.or_else(|| Some(wires.other_end(cell.node, port)?.0)));
        }
    }
    for cell in reported {
        versions.entry(cell).or_insert(None);
    }
    versions
}

/// The reported neighbours at all ports of a bus, beside the described ones.
struct PortMap<'a> {
    wires: &'a BusWires,
    /// The cells whose ports can be compared: present, with a unique node id, and of this program's version.
    comparable: BTreeMap<CellId, &'a PortsPage>,
}

impl<'a> PortMap<'a> {
    fn new(wires: &'a BusWires, cells: &'a [ObservedCell], versions: &BTreeMap<CellId, Option<u16>>) -> Self {
        let sound = |cell: &&ObservedCell| {
            let single = cell.heartbeat.is_some_and(|heartbeat| !heartbeat.state.has(State::DUPLICATE));
            cell.alive && single && !versions.contains_key(&cell.node)
        };
        let sound = cells.iter().filter(sound).filter_map(|cell| Some((cell.node, cell.ports.as_ref()?)));
        Self { wires, comparable: sound.collect() }
    }

    /// Returns the described end to which a port should lead.
    fn described_end(&self, end: WireEnd) -> Option<WireEnd> {
        self.wires.other_end(end.cell, end.port).map(|(cell, port)| WireEnd { cell, port })
    }

    fn port_state(&self, end: WireEnd) -> Option<protocol::message::PortState> {
        self.comparable.get(&end.cell)?.ports.get(end.port).copied()
    }

    /// Returns the end to which a port leads; `None` if the cell receives nothing there.
    fn actual_end(&self, end: WireEnd) -> Option<WireEnd> {
        let state = self.port_state(end).filter(|state| state.receives)?;
        let cell = CellId::new(state.number.into()).ok()?;
        Some(WireEnd { cell, port: state.port.into() })
    }

    fn wire_ends(&self) -> impl Iterator<Item = WireEnd> {
        self.comparable.keys().flat_map(|&cell| (0..PORTS).map(move |port| WireEnd { cell, port }))
    }

    fn wire_differences(&self, found: &mut Vec<Difference>) {
        let mut named = BTreeSet::new();
        let mut elsewhere = BTreeSet::new();
        for end in self.wire_ends() {
            let described = self.described_end(end);
            let state = self.port_state(end).filter(|state| state.receives);
            if state.is_some_and(|state| state.number == 0 && !state.other_version) {
                found.push(Difference::Unnumbered(end));
                elsewhere.insert(end);
                continue;
            }
            // Skip the far ends of cells that cannot be compared, too.
            let Some(leads) = self.actual_end(end).filter(|leads| self.comparable.contains_key(&leads.cell))
            else {
                continue;
            };
            if described == Some(leads) {
                continue;
            }
            elsewhere.extend([end, leads]);
            if !named.insert((end.min(leads), end.max(leads))) {
                continue;
            }
            found.push(match (described, self.described_end(leads)) {
                (Some(described), _) => Difference::SwappedWire { end, leads, described },
                (None, Some(described)) => Difference::SwappedWire { end: leads, leads: end, described },
                (None, None) => Difference::ExtraWire(end.min(leads), end.max(leads)),
            });
        }
        for first in self.wire_ends() {
            let Some(second) = self.described_end(first).filter(|&second| first < second) else { continue };
            let (Some(here), Some(there)) = (self.port_state(first), self.port_state(second)) else {
                continue;
            };
            if elsewhere.contains(&first) || elsewhere.contains(&second) || (here.works && there.works) {
                continue;
            }
            let carries = match (here.receives, there.receives) {
                (true, false) => WorkingDirection::Back,
                (false, true) => WorkingDirection::There,
                (false, false) | (true, true) => WorkingDirection::Nothing,
            };
            found.push(Difference::MissingWire { first, second, carries });
        }
    }
}

#[cfg(test)]
mod tests;
