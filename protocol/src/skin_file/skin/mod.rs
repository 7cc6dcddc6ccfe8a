//! The description of a skin: the robot, its buses, and where every cell sits.
//!
//! A [`Skin`] exists only when everything in its file has been checked. Every error names the line, the key, the value and what is
//! allowed, in one line.

mod baseline;
mod buses;
mod cell_name;
mod cells;
mod chains;
mod check;
pub mod file;
mod names;
mod part;
mod raw;
mod reach;
mod robot;
pub mod sensing;
mod wires;

use std::path::Path;

use crate::can::Format;
use crate::document::{self, DocumentError};
use crate::fixed::{Q1_14, TorqueFormat};
use crate::id::CellId;
use crate::packet::Length;
use crate::parameters::{Baseline, Contact, Events, Parameters, Pose, Row, Sensing};
use crate::time::Span;

pub use cell_name::{CellName, split_bus};
pub use reach::{REACH, reach};
pub use robot::{Base, Chain, ChainRow, DenavitHartenberg, Joint, JointKind, MAX_ROBOT_JOINTS, Robot};
pub use wires::Wires;

/// The keys by which a skin is known from a scenario, and the other way round.
pub const KEYS: &[&str] = &["robot", "cell"];
/// See [`KEYS`].
const SCENARIO_KEYS: &[&str] = &["duration_s", "motion", "mode", "touch", "fault", "sensors"];

/// A checked description.
#[derive(Clone, Debug, PartialEq)]
pub struct Skin {
    /// The skin's name.
    pub name: String,
    /// The robot that wears it.
    pub robot: Robot,
    /// How often things happen.
    pub timing: Timing,
    /// Which changes of what cells measure are events.
    pub events: Events,
    /// The buses, in the file's order.
    pub buses: Vec<Bus>,
    /// What turns torques into motion.
    pub controller: Controller,
    /// When torques are held, and when the robot is halted.
    pub safety: Safety,
    /// The cells, in the file's order.
    pub cells: Vec<Cell>,
}

/// How often things happen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timing {
    /// Ticks of the control loop in a second.
    pub control_hz: f64,
    /// Ticks from one joint broadcast to the next.
    pub ticks_per_broadcast: u32,
}

impl Timing {
    /// Length of a tick in nanoseconds.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "1 Hz to 10 kHz: checked")]
    pub fn tick_nanos(&self) -> u64 {
        (1e9 / self.control_hz).round() as u64
    }

    /// Joint broadcasts in a second.
    #[must_use]
    pub fn broadcast_hz(&self) -> f64 {
        self.control_hz / f64::from(self.ticks_per_broadcast)
    }
}

/// What a bus' cells answer with.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Reply {
    /// Each cell its own torque, in the bus' [`Bus::torque_format`].
    Torque,
    /// Sums along the tree, Q7.8.
    Sum {
        /// Width of a slot in µs.
        slot_us: u32,
        /// True if what rounding takes away is carried into a cell's next value.
        carry: bool,
    },
}

/// One bus.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Bus {
    /// The interface's name.
    pub name: String,
    /// What its cells answer with.
    pub reply: Reply,
    /// One FD frame a packet, or several classic ones.
    pub format: Format,
    /// The chain whose skin it carries: an index into [`Robot::chains`].
    pub chain: usize,
    /// In which format its cells send their own torques.
    pub torque_format: TorqueFormat,
    /// Bits in a second, of hardware; of an FD frame's head and tail.
    pub bitrate: Option<u32>,
    /// Bits in a second of an FD frame's data, of hardware.
    pub data_bitrate: Option<u32>,
    /// When its cells send what they measure.
    pub sensing: Sensing,
}

/// What turns torques into motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Controller {
    /// Which one.
    pub kind: ControllerKind,
    /// The maximum speed of each joint in rad/s, of prismatic ones in m/s.
    pub max_speed: Vec<f64>,
}

/// Which controller.
#[derive(Clone, Debug, PartialEq)]
pub enum ControllerKind {
    /// `M q'' + D q' = tau`, joint by joint: who pushes the skin moves the arm.
    Kinesthetic {
        /// M in kg m2, of prismatic joints in kg.
        inertia: Vec<f64>,
        /// D in Nm s/rad, of prismatic joints in N s/m.
        damping: Vec<f64>,
    },
    /// Somebody else's program behind a Unix datagram socket.
    External {
        /// Path of the socket that the gateway listens on.
        socket: String,
        /// How long it may take to begin: until then it may be missing, and the robot stands.
        start: Span,
    },
}

/// When torques are held, and when the robot is halted.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Safety {
    /// Epochs for which the last torque of a cell that fell silent in contact is held.
    pub hold_epochs: u32,
    /// Epochs over which it then falls to zero, linearly.
    pub decay_epochs: u32,
    /// Bad cycles in a row that halt the robot.
    pub bad_cycles: u32,
    /// What is done while some of several buses are lost.
    pub lost_bus: LostBus,
}

/// What is done while some buses are lost and others are not. When all are lost the torque may not be used,
/// whatever this is.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum LostBus {
    /// The torques of a lost bus decay to zero like those of silent cells, and the robot goes on with the others.
    #[default]
    GoOn,
    /// The torque may not be used: bad cycles, which halt the robot.
    Halt,
}

impl LostBus {
    /// The word in the file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::GoOn => "go-on",
            Self::Halt => "halt",
        }
    }
}

/// One cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Which bus it is on: an index into [`Skin::buses`].
    pub bus: usize,
    /// Its number there.
    pub node: CellId,
    /// Its serial number.
    pub serial: u32,
    /// The joint k of its chain that moves the link it sits on, from 1.
    pub joint: u8,
    /// The row of its chain in whose frame it sits, from 1: that of joint k, or a fixed one after it.
    pub row: u8,
    /// Position in the frame of that row, in m.
    pub position: [f64; 3],
    /// Outward normal in the same frame: the cell's z axis.
    pub normal: [f64; 3],
    /// Its orientation in the same frame, a quaternion x, y, z, w, if the file has more than its normal.
    pub orientation: Option<[f64; 4]>,
    /// What is wired to its ports.
    pub neighbors: [Option<CellId>; 4],
    /// True if it is wired to the gateway's side.
    pub root: bool,
    /// Its gains and thresholds as words.
    pub contact: Contact,
    /// What it takes for the zero of its force sensor.
    pub baseline: Baseline,
}

impl Skin {
    /// The part of it on some of its buses, given as indices into [`Skin::buses`]; indices that are none are left out.
    #[must_use]
    pub fn on_buses(&self, kept: &[usize]) -> Self {
        let place = |bus: usize| kept.iter().position(|&it| it == bus);
        let cells = self.cells.iter();
        let cells = cells.filter_map(|cell| Some(Cell { bus: place(cell.bus)?, ..cell.clone() }));
        let buses = kept.iter().filter_map(|&bus| self.buses.get(bus)).cloned();
        Self { buses: buses.collect(), ..self.with_cells(cells.collect()) }
    }

    /// The same with other cells; its own are not copied.
    #[must_use]
    pub fn with_cells(&self, cells: Vec<Cell>) -> Self {
        let Self { name, robot, timing, events, buses, controller, safety, cells: _ } = self;
        Self {
            name: name.clone(),
            robot: robot.clone(),
            timing: *timing,
            events: *events,
            buses: buses.clone(),
            controller: controller.clone(),
            safety: *safety,
            cells,
        }
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// Returns an error if it cannot be read, or the first thing that is wrong with it.
    pub fn read(path: &Path) -> Result<Self, DocumentError> {
        Self::parse(&path.display().to_string(), &document::text(path)?)
    }

    /// Checks a text; `path` is what errors call it.
    ///
    /// # Errors
    /// The first thing that is wrong with it.
    pub fn parse(path: &str, text: &str) -> Result<Self, DocumentError> {
        let what = "this is a scenario, not a skin: `skinbus run SKIN --scenario SCENARIO` takes both";
        document::parse(path, text, check::skin)
            .map_err(|error: DocumentError| error.or_mistaken(text, SCENARIO_KEYS, KEYS, what))
    }

    /// Checks the text of a skin in a recording; `path` is what errors call it.
    ///
    /// Unprintable characters of its names are written like `\u{1b}`; [`Skin::parse`] refuses them.
    ///
    /// # Errors
    /// The first thing that is wrong with it.
    pub fn parse_recorded(path: &str, text: &str) -> Result<Self, DocumentError> {
        document::parse(path, text, check::recorded_skin)
    }

    /// The words that a cell computes with.
    #[must_use]
    #[expect(clippy::missing_panics_doc, reason = "only a checked skin exists, and checking made sure of it")]
    pub fn parameters(&self, cell: &Cell) -> Parameters {
        self.try_parameters(cell).expect("a checked skin fits its words")
    }

    fn try_parameters(&self, cell: &Cell) -> Option<Parameters> {
        let chain = self.chain(cell.bus);
        let mut parameters = Parameters {
            joint: cell.joint,
            joints: u8::try_from(chain.joints.len()).ok()?,
            row: cell.row,
            table_rows: u8::try_from(chain.rows.len()).ok()?,
            torque_format: self.buses.get(cell.bus)?.torque_format,
            pose: Pose {
                position: cell.position.map(Q1_14::nearest),
                normal: cell.normal.map(Q1_14::nearest),
            },
            contact: cell.contact,
            period_us: self.period_us()?,
            ..Parameters::default()
        };
        for (word, &ChainRow { kind, table, .. }) in parameters.rows.iter_mut().zip(&chain.rows) {
            *word = Row {
                kind,
                a: Q1_14::nearest(table.a),
                d: Q1_14::nearest(table.d),
                alpha: Q1_14::from_radians(table.alpha)?,
                theta_offset: Q1_14::from_radians(table.theta_offset)?,
            };
        }
        Some(parameters.shortest())
    }

    /// The chain of a bus, given as an index into [`Skin::buses`].
    #[must_use]
    #[expect(clippy::missing_panics_doc, reason = "each bus of a checked skin has a chain")]
    pub fn chain(&self, bus: usize) -> &Chain {
        let chain = self.buses.get(bus).map_or(0, |bus| bus.chain);
        self.robot.chains.get(chain).expect("a checked skin has the chains of its buses")
    }

    /// The joints of a bus' chain, base to tip, each with its index into [`Robot::joints`].
    pub fn joints_of(&self, bus: usize) -> impl ExactSizeIterator<Item = (usize, &Joint)> {
        self.chain(bus).joints.iter().map(|&joint| (joint, self.joint(joint)))
    }

    #[expect(clippy::expect_used, reason = "each chain of a checked skin has joints of the robot")]
    fn joint(&self, joint: usize) -> &Joint {
        self.robot.joints.get(joint).expect("a checked skin has the joints of its chains")
    }

    /// How long joints, torques and sums on a bus are.
    #[must_use]
    pub fn length_of(&self, bus: usize) -> Length {
        Length::for_joints(self.chain(bus).joints.len())
    }

    /// From one broadcast of joints to the next, in µs; `None` for more than a word holds.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "positive; u16 decides what fits"
    )]
    pub fn period_us(&self) -> Option<u16> {
        u16::try_from((1e6 / self.timing.broadcast_hz()).round() as u64).ok()
    }

    /// The cells of one bus, in the file's order.
    pub fn cells_of(&self, bus: usize) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(move |cell| cell.bus == bus)
    }

    /// The same skin with the cells of one bus only.
    #[must_use]
    pub fn part_on(&self, bus: usize) -> Self {
        self.with_cells(self.cells_of(bus).cloned().collect())
    }

    /// The bus of this name, as an index into [`Skin::buses`].
    #[must_use]
    pub fn bus_named(&self, name: &str) -> Option<usize> {
        self.buses.iter().position(|bus| bus.name == name)
    }
}

#[cfg(test)]
mod tests;
