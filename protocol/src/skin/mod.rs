//! The description of a skin: the robot, its buses, and where every cell sits.
//!
//! A [`Skin`] exists only when everything in its file has been checked. Every error names the line, the key, the value and what is
//! allowed, in one line.

mod buses;
mod cells;
mod check;
mod raw;
pub mod sensing;
mod wires;

use std::path::Path;

use serde::Deserialize;

use crate::can::Format;
use crate::document::{self, DocumentError};
use crate::fixed::Q1_14;
use crate::id::CellId;
use crate::parameters::{Contact, Events, Parameters, Pose, Row, Sensing};

pub use wires::Wires;

/// The keys by which a skin is known from a scenario, and the other way round.
pub const KEYS: &[&str] = &["robot", "cell"];
/// See [`KEYS`].
const SCENARIO_KEYS: &[&str] = &["duration_s", "motion", "mode", "touch", "fault"];

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

/// A chain of revolute joints.
#[derive(Clone, Debug, PartialEq)]
pub struct Robot {
    /// Its name.
    pub name: String,
    /// Standard Denavit-Hartenberg rows, base to tip; 1 to 6 of them.
    pub joints: Vec<DenavitHartenberg>,
    /// Minimum and maximum position of each joint in rad.
    pub limits_rad: Vec<[f64; 2]>,
}

/// One row of the robot's table, `Rz(theta + theta_offset) Tz(d) Tx(a) Rx(alpha)`; what is not said is 0.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq)]
#[serde(deny_unknown_fields, default)]
pub struct DenavitHartenberg {
    /// Length of the link in m.
    pub a: f64,
    /// Twist in rad.
    pub alpha: f64,
    /// Offset along the joint's axis in m.
    pub d: f64,
    /// What is added to the joint's position, in rad.
    pub theta_offset: f64,
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
    /// Each cell its own torque, Q3.12.
    Torque,
    /// Sums along the tree, Q7.8.
    Sum {
        /// Width of a slot in µs.
        slot_us: u32,
        /// Whether what rounding takes away is carried into a cell's next value.
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
    /// One FD frame a packet, or two classic ones.
    pub format: Format,
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
    /// The maximum speed of each joint in rad/s.
    pub max_speed_rad_s: Vec<f64>,
}

/// Which controller.
#[derive(Clone, Debug, PartialEq)]
pub enum ControllerKind {
    /// `M q'' + D q' = tau`, joint by joint: who pushes the skin moves the arm.
    Kinesthetic {
        /// M in kg m2.
        inertia: Vec<f64>,
        /// D in Nm s/rad.
        damping: Vec<f64>,
    },
    /// Somebody else's program behind a Unix datagram socket.
    External {
        /// Path of the socket that the gateway listens on.
        socket: String,
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
    /// The joint k that moves the link it sits on, from 1.
    pub joint: u8,
    /// Position in the frame of joint k, in m.
    pub position: [f64; 3],
    /// Outward normal in the frame of joint k: the cell's z axis.
    pub normal: [f64; 3],
    /// What is wired to its ports.
    pub neighbors: [Option<CellId>; 4],
    /// Whether it is wired to the gateway's side.
    pub root: bool,
    /// Its gains and thresholds as words.
    pub contact: Contact,
}

impl Skin {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// When it cannot be read, or the first thing that is wrong with it.
    pub fn read(path: &Path) -> Result<Self, DocumentError> {
        Self::parse(&path.display().to_string(), &document::text(path)?)
    }

    /// Checks a text; `path` is what errors call it.
    ///
    /// # Errors
    /// The first thing that is wrong with it.
    pub fn parse(path: &str, text: &str) -> Result<Self, DocumentError> {
        let what = "this is a scenario, not a skin: `gateway run SKIN --scenario SCENARIO` takes both";
        document::parse(path, text, check::skin)
            .map_err(|error: DocumentError| error.or_mistaken(text, SCENARIO_KEYS, KEYS, what))
    }

    /// The words that a cell computes with.
    #[must_use]
    #[expect(clippy::missing_panics_doc, reason = "only a checked skin exists, and checking made sure of it")]
    pub fn parameters(&self, cell: &Cell) -> Parameters {
        self.try_parameters(cell).expect("a checked skin fits its words")
    }

    fn try_parameters(&self, cell: &Cell) -> Option<Parameters> {
        let mut parameters = Parameters {
            joint: cell.joint,
            joints: u8::try_from(self.robot.joints.len()).ok()?,
            pose: Pose {
                position: cell.position.map(Q1_14::nearest),
                normal: cell.normal.map(Q1_14::nearest),
            },
            contact: cell.contact,
            period_us: self.period_us()?,
            ..Parameters::default()
        };
        for (row, joint) in parameters.rows.iter_mut().zip(&self.robot.joints) {
            *row = Row {
                a: Q1_14::nearest(joint.a),
                d: Q1_14::nearest(joint.d),
                alpha: Q1_14::from_radians(joint.alpha)?,
                theta_offset: Q1_14::from_radians(joint.theta_offset)?,
            };
        }
        Some(parameters)
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
        Self { cells: self.cells_of(bus).cloned().collect(), ..self.clone() }
    }

    /// The bus of this name, as an index into [`Skin::buses`].
    #[must_use]
    pub fn bus_named(&self, name: &str) -> Option<usize> {
        self.buses.iter().position(|bus| bus.name == name)
    }
}

#[cfg(test)]
mod tests;
