//! Writes the text of a `skin.toml` for some chains of a robot and the cells on their links.
//!
//! ```text
//!   Chain, .. ──┐
//!               ├─> Import ──> toml ──> text that Skin::parse accepts
//!   CellOnLink ─┘
//! ```

use nalgebra::{Point3, Vector3};
use protocol::bus::is_plain_name;
use protocol::can::Format;
use protocol::document::DocumentError;
use protocol::parameters::RowKind;
use protocol::skin::file::{CellFacing, DraftBus, DraftCell, SkinDraft, Value};
use protocol::skin::{JointKind, MAX_REACH, MAX_ROBOT_JOINTS, Skin, max_frame_distance};
use thiserror::Error;

use crate::chain::{ChainJoint, UrdfChain};
use crate::error::RobotError;

/// Default number of cells per bus. With node ids 1 to 250, a few remain for cells that are added later.
pub const DEFAULT_CELLS_PER_BUS: usize = 250;

/// Maximum speed of a joint for which the URDF gives none, in rad/s or m/s.
const DEFAULT_MAX_SPEED: f64 = 2.0;

/// A cell that is placed on a link of the robot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CellOnLink {
    /// Name of the link in the URDF.
    pub link: String,
    /// The position in the link's frame, in m.
    pub position: [f64; 3],
    /// The outward normal in the link's frame, of any length above zero.
    pub normal: [f64; 3],
    /// Name of the cell's bus, if given.
    pub bus: Option<String>,
    /// Node id of the cell, if given.
    pub node: Option<u8>,
    /// Node ids of the cells on the same bus that are wired to the ports of this cell.
    pub neighbors: [Option<u8>; 4],
    /// True if the cell is wired to the gateway's side.
    pub root: bool,
    /// Line that defines the cell in the file of cells, for errors.
    pub line: usize,
}

/// The robot and the cells from which a skin file is written.
#[derive(Debug)]
pub struct SkinImport<'a> {
    /// The name of the robot.
    pub name: &'a str,
    /// The command with which the user made the skin, for a comment in the first line.
    pub command: &'a str,
    /// The path of the URDF relative to the skin file, if it is known.
    pub urdf: Option<&'a str>,
    /// The chains of the skin. Each has its own tip, and may share joints with earlier chains.
    pub chains: &'a [UrdfChain],
    /// The cells, in the order of their file. If there are none, the tip of each chain gets one.
    pub cells: &'a [CellOnLink],
}

/// The error for a robot and cells from which no skin can be made.
#[derive(Debug, Error)]
pub enum ImportError {
    /// The chains together have too many joints.
    #[error(
        "{count} joints move between the root and the tips; a robot must have 1 to {MAX_ROBOT_JOINTS}: use fewer --tip \
         options"
    )]
    Joints {
        /// Number of joints of all chains together.
        count: usize,
    },
    /// The link of a cell cannot carry cells.
    #[error("{}{error}", line_prefix(*line))]
    Link {
        /// The line of the file of cells.
        line: usize,
        /// The reason why the link cannot carry cells.
        error: RobotError,
    },
    /// The normal of a cell has no direction, because its length is zero or not finite.
    #[error("{}the normal nx,ny,nz = {x},{y},{z} has no direction: its length must be above 0", line_prefix(*line))]
    Normal {
        /// The line of the file of cells.
        line: usize,
        /// The x component.
        x: f64,
        /// The y component.
        y: f64,
        /// The z component.
        z: f64,
    },
    /// Cells on two different chains are assigned to the same bus.
    #[error(
        "{}bus {bus:?} already carries chain {first:?}, but this cell is on chain {second:?}: choose another bus",
        line_prefix(*line)
    )]
    Bus {
        /// The line of the file of cells.
        line: usize,
        /// Name of the bus.
        bus: String,
        /// The chain of the first cell on the bus.
        first: String,
        /// The chain of the cell in this line.
        second: String,
    },
    /// A bus has no node id left for a cell.
    #[error("{}bus {bus:?} has no free node id: all 254 are used; choose another bus", line_prefix(*line))]
    Full {
        /// The line of the file of cells.
        line: usize,
        /// Name of the bus.
        bus: String,
    },
    /// Two cells on one bus have the same node id.
    #[error("{}node {node} of bus {bus:?} is already used in line {first}: give this cell another node id, or leave it empty", line_prefix(*line))]
    Taken {
        /// The line of the file of cells.
        line: usize,
        /// Name of the bus.
        bus: String,
        /// The node id.
        node: u8,
        /// The line of the other cell with this node id.
        first: usize,
    },
    /// The name of a bus is not valid for a network interface.
    #[error("{}bus {bus:?}: its name must have 1 to 15 letters, digits, `-`, `_` or `.`, and must not begin with `.`", line_prefix(*line))]
    BusName {
        /// The line of the file of cells.
        line: usize,
        /// The rejected name.
        bus: String,
    },
    /// A cell is too far from the joints that move it.
    #[error(
        "{}position px,py,pz = {x},{y},{z} of link {link:?} is too far from an earlier link of its chain: the distance \
         can reach {reach:.3} m, but must be below {MAX_REACH} m: correct the position, or choose a root nearer to the \
         link",
        line_prefix(*line)
    )]
    Reach {
        /// The line of the file of cells.
        line: usize,
        /// Name of the link.
        link: String,
        /// The x coordinate in the link's frame, in m.
        x: f64,
        /// The y coordinate in the link's frame, in m.
        y: f64,
        /// The z coordinate in the link's frame, in m.
        z: f64,
        /// The reach of the cell in m: its maximum distance from the joints that move it.
        reach: f64,
    },
    /// The check of the written skin found an error in a cell or a bus.
    #[error("{}{what}", line_prefix(*line))]
    Cells {
        /// The line of the file of cells; 0 for the whole file.
        line: usize,
        /// The message of the check.
        what: String,
    },
    /// The check of the written skin found an error in the robot.
    #[error("{what}")]
    Robot {
        /// The message of the check.
        what: String,
    },
}

impl ImportError {
    /// Returns true if the error is in the cells, false if it is in the robot.
    #[must_use]
    pub const fn is_error_in_cells(&self) -> bool {
        !matches!(self, Self::Joints { .. } | Self::Robot { .. })
    }

    /// Converts an error of the check of the written skin. The result refers to the lines of the file of cells, because
    /// the user does not see the text of the skin.
    fn from_check(error: DocumentError, cells: &[CellOnLink], buses: &[BusAssignment]) -> Self {
        let DocumentError::InvalidValue { what, .. } = error else {
            return Self::Robot { what: error.to_string() };
        };
        let lines_of_buses = || buses.iter().map(|bus| bus.line);
        let found = split_table_index(&what, "cell")
            .map(|(index, rest)| (cells.get(index).map(|cell| cell.line), rest));
        let found = found.or_else(|| {
            split_table_index(&what, "bus").map(|(index, rest)| (lines_of_buses().nth(index), rest))
        });
        match found {
            Some((line, rest)) => Self::Cells { line: line.unwrap_or_default(), what: rest.to_owned() },
            None if what.starts_with("bus = ") => Self::Cells { line: 0, what },
            None => Self::Robot { what },
        }
    }
}

/// Splits an error text such as `cell[3].node = 7: ...`, for the given table, into the number and the rest.
fn split_table_index<'a>(what: &'a str, table: &str) -> Option<(usize, &'a str)> {
    let (number, rest) = what.strip_prefix(table)?.strip_prefix('[')?.split_once(']')?;
    Some((number.parse().ok()?, rest.trim_start_matches('.')))
}

/// Returns the prefix of an error with the line of a cell; empty for cells that are not from a file.
fn line_prefix(line: usize) -> String {
    if line == 0 { String::new() } else { format!("line {line}: ") }
}

/// A cell with its chain, bus and place on the chain.
struct PlacedCell<'a> {
    cell: &'a CellOnLink,
    bus: usize,
    node: u8,
    chain: usize,
    joint: usize,
    row: usize,
    position: [f64; 3],
    normal: [f64; 3],
}

/// A bus to which cells are being assigned.
struct BusAssignment {
    name: String,
    chain: usize,
    /// Line of the first cell on the bus.
    line: usize,
    /// The node ids in use on the bus, each with the line of its cell.
    taken: Vec<(u8, usize)>,
    /// True if a cell names the bus, false if it was added because of the number of cells.
    named: bool,
}

impl SkinImport<'_> {
    /// Returns the text of the skin. The same input always gives the same text.
    ///
    /// # Errors
    /// Returns [`ImportError`] if a cell is on a link that no chain moves, its normal has no direction, its bus has no
    /// free node id, or the written skin is not valid.
    pub fn toml(&self) -> Result<String, ImportError> {
        let count = self.joints().len();
        if count > MAX_ROBOT_JOINTS {
            return Err(ImportError::Joints { count });
        }
        let on_tips: Vec<_> = self.chains.iter().map(cell_on_tip).collect();
        let cells = if self.cells.is_empty() { &on_tips } else { self.cells };
        let mut buses: Vec<BusAssignment> = Vec::new();
        let placed =
            cells.iter().map(|cell| self.place_cell(cell, &mut buses)).collect::<Result<Vec<_>, _>>()?;
        let text = self.skin_text(&buses, &placed);
        match Skin::parse("imported skin", &text) {
            Ok(_) => Ok(text),
            Err(error) => Err(ImportError::from_check(error, cells, &buses)),
        }
    }

    /// Assigns a cell to the first chain that moves its link, and to a bus with a node id.
    fn place_cell<'a>(
        &self,
        cell: &'a CellOnLink,
        buses: &mut Vec<BusAssignment>,
    ) -> Result<PlacedCell<'a>, ImportError> {
        let line = cell.line;
        let mut found = None;
        let mut refused = None;
        for (index, chain) in self.chains.iter().enumerate() {
            match chain.link(&cell.link) {
                Ok(frame) => {
                    found = Some((index, frame));
                    break;
                }
                Err(error) => refused = refused.or(Some(error)),
            }
        }
        let (owner, frame) = match (found, refused) {
            (Some(found), _) => found,
            (None, Some(error)) => return Err(ImportError::Link { line, error }),
            (None, None) => unreachable!("an import has a chain"),
        };
        let [x, y, z] = cell.normal;
        let normal = frame.frame * Vector3::new(x, y, z);
        let Some(normal) = normal.try_normalize(1e-9).filter(|it| it.iter().all(|part| part.is_finite()))
        else {
            return Err(ImportError::Normal { line, x, y, z });
        };
        let position = frame.frame * Point3::from(cell.position);
        let rows = self.chains.get(owner).map(UrdfChain::chain_rows).unwrap_or_default();
        let reach = max_frame_distance(rows.get(..frame.row).unwrap_or_default(), position.into());
        if reach.is_nan() || reach >= MAX_REACH {
            let ([x, y, z], link) = (cell.position, cell.link.clone());
            return Err(ImportError::Reach { line, link, x, y, z, reach });
        }
        let bus = self.assign_bus(cell, owner, buses)?;
        let Some(there) = buses.get_mut(bus) else { unreachable!("just found") };
        let holder = |node: u8| there.taken.iter().find(|(taken, _)| *taken == node).map(|(_, line)| *line);
        let node = match cell.node.map(|node| (node, holder(node))) {
            Some((node, None)) => node,
            Some((node, Some(first))) => {
                return Err(ImportError::Taken { line, bus: there.name.clone(), node, first });
            }
            None => match (1..=254).find(|node| holder(*node).is_none()) {
                Some(node) => node,
                None => return Err(ImportError::Full { line, bus: there.name.clone() }),
            },
        };
        there.taken.push((node, line));
        let (chain, joint, row) = (owner, frame.joint, frame.row);
        Ok(PlacedCell {
            cell,
            bus,
            node,
            chain,
            joint,
            row,
            position: position.into(),
            normal: normal.into(),
        })
    }

    /// Returns the index of a cell's bus: the bus that the cell names, or the last bus of its chain with a free node
    /// id. Adds a bus if necessary.
    fn assign_bus(
        &self,
        cell: &CellOnLink,
        chain: usize,
        buses: &mut Vec<BusAssignment>,
    ) -> Result<usize, ImportError> {
        let name = |chain: usize| self.chains.get(chain).map_or_else(String::new, |chain| chain.tip.clone());
        if let Some(named) = &cell.bus {
            if let Some(index) = buses.iter().position(|bus| bus.name == *named) {
                return match buses.get(index) {
                    Some(bus) if bus.chain != chain => Err(ImportError::Bus {
                        line: cell.line,
                        bus: named.clone(),
                        first: name(bus.chain),
                        second: name(chain),
                    }),
                    _ => Ok(index),
                };
            }
            if !is_plain_name(named) || named.starts_with('.') {
                return Err(ImportError::BusName { line: cell.line, bus: named.clone() });
            }
            buses.push(BusAssignment {
                name: named.clone(),
                chain,
                line: cell.line,
                taken: Vec::new(),
                named: true,
            });
            return Ok(buses.len() - 1);
        }
        let has_room =
            |bus: &BusAssignment| bus.chain == chain && !bus.named && bus.taken.len() < DEFAULT_CELLS_PER_BUS;
        if let Some(index) = buses.iter().rposition(has_room) {
            return Ok(index);
        }
        let free = (0..)
            .map(|number| format!("vcan{number}"))
            .find(|name| buses.iter().all(|bus| bus.name != *name));
        let name = free.unwrap_or_default();
        buses.push(BusAssignment { name, chain, line: cell.line, taken: Vec::new(), named: false });
        Ok(buses.len() - 1)
    }

    /// Returns the joints of all chains. A joint that several chains share occurs once.
    fn joints(&self) -> Vec<&ChainJoint> {
        let mut joints: Vec<&ChainJoint> = Vec::new();
        for joint in self.chains.iter().flat_map(|chain| &chain.joints) {
            if joints.iter().all(|known| known.name != joint.name) {
                joints.push(joint);
            }
        }
        joints
    }

    fn skin_text(&self, buses: &[BusAssignment], cells: &[PlacedCell<'_>]) -> String {
        let joints = self.joints();
        let each =
            |value: &dyn Fn(&ChainJoint) -> f64| joints.iter().map(|joint| value(joint)).collect::<Vec<_>>();
        let by_kind = |turns: f64, slides: f64| {
            move |joint: &ChainJoint| if joint.kind == JointKind::Prismatic { slides } else { turns }
        };
        let mut draft = SkinDraft::default();
        draft.add_comment(self.command);
        for chain in self.chains {
            let (root, tip, count, rows) = (&chain.root, &chain.tip, chain.joints.len(), chain.rows.len());
            let far = chain.residual;
            draft.add_comment(&format!(
                "{root} to {tip}: {count} joints in {rows} rows, which differ from the URDF by {far:.1e} m or rad at most."
            ));
        }
        draft.set("version", Value::Integer(1));
        draft.set("name", Value::Text(self.name));
        draft.add_table_header("[robot]", None);
        draft.set("name", Value::Text(self.name));
        if let Some(urdf) = self.urdf {
            draft.set("urdf", Value::Text(urdf));
        }
        for ChainJoint { name, kind, limits, .. } in &joints {
            draft.add_table_header("[[robot.joint]]", None);
            draft.set("name", Value::Text(name));
            draft.set("kind", Value::Text(kind.name()));
            draft.set_with_comment("limits", Value::Numbers(limits), 3, kind.unit());
        }
        self.chains.iter().for_each(|chain| add_chain(&mut draft, chain));
        draft.add_paper_settings(62.5);
        for bus in buses {
            let chain = self.chains.get(bus.chain).map_or("", |chain| &chain.tip);
            draft.add_bus(&DraftBus {
                name: &bus.name,
                chain: Some(chain),
                slot_us: None,
                format: Format::Fd,
            });
        }
        draft.add_table_header("[controller]", Some("M q'' + D q' = tau, joint by joint"));
        draft.set("kind", Value::Text("kinesthetic"));
        draft.set_with_comment("inertia", Value::Numbers(&each(&by_kind(1.0, 10.0))), 5, "kg m2, or kg");
        draft.set_with_comment(
            "damping",
            Value::Numbers(&each(&by_kind(4.0, 80.0))),
            5,
            "Nm s/rad, or N s/m",
        );
        let speed = each(&|joint| joint.max_speed.unwrap_or(DEFAULT_MAX_SPEED));
        draft.set_with_comment("max_speed", Value::Numbers(&speed), 3, "rad/s, or m/s");
        for cell in cells {
            let bus = buses.get(cell.bus).map_or("", |bus| &bus.name);
            let own = self.chains.get(cell.chain).and_then(|chain| row_of_joint(chain, cell.joint));
            let CellOnLink { link, neighbors, root, .. } = cell.cell;
            draft.add_cell(&DraftCell {
                remark: Some(&format!("on {link}")),
                bus,
                node: cell.node.into(),
                serial: None,
                joint: cell.joint,
                row: Some(cell.row).filter(|row| own != Some(*row)),
                position: cell.position.map(without_rounding_residue),
                facing: CellFacing::Normal(cell.normal.map(without_rounding_residue)),
                neighbors: neighbors
                    .iter()
                    .any(Option::is_some)
                    .then(|| neighbors.map(Option::unwrap_or_default)),
                root: *root,
            });
        }
        draft.into_text()
    }
}

/// Writes a chain of the robot: its base and its rows.
fn add_chain(draft: &mut SkinDraft, chain: &UrdfChain) {
    draft.add_table_header("[[robot.chain]]", Some("standard Denavit-Hartenberg, base to tip; m, rad"));
    draft.set("name", Value::Text(&chain.tip));
    let base = chain.below * chain.base;
    let [position, turn] = [base.translation.vector.as_slice(), base.rotation.coords.as_slice()]
        .map(|all| all.iter().copied().map(without_rounding_residue).collect::<Vec<_>>());
    let base = [("position", Value::Numbers(&position)), ("orientation", Value::Numbers(&turn))];
    draft.set_table("base", &base);
    let mut names = chain.joints.iter();
    let rows = chain.rows.iter().map(|row| {
        let joint = if row.kind == RowKind::Fixed { None } else { names.next() };
        let joint = joint.map(|joint| ("joint", Value::Text(&joint.name)));
        let table = [("a", row.a), ("alpha", row.alpha), ("d", row.d), ("theta_offset", row.theta_offset)];
        joint.into_iter().chain(table.map(|(key, value)| (key, Value::Number(value)))).collect()
    });
    draft.set_table_rows("rows", None, rows);
}

/// Returns the number of the row that a joint moves. Rows and joints are counted from 1.
fn row_of_joint(chain: &UrdfChain, joint: usize) -> Option<usize> {
    let moving = chain.rows.iter().enumerate().filter(|(_, row)| row.kind != RowKind::Fixed);
    moving.map(|(index, _)| index + 1).nth(joint.checked_sub(1)?)
}

/// Returns a cell at the origin of a chain's tip link, with its normal along the z axis of that link.
fn cell_on_tip(chain: &UrdfChain) -> CellOnLink {
    CellOnLink { link: chain.tip.clone(), normal: [0.0, 0.0, 1.0], ..CellOnLink::default() }
}

/// Returns a value for output, without rounding residues and negative zeros.
fn without_rounding_residue(value: f64) -> f64 {
    if value.abs() < 1e-12 { 0.0 } else { value }
}
