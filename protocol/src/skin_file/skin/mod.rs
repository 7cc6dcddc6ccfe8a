//! The description of a skin: the robot, its buses, and the place of every cell.
//!
//! A [`Skin`] is created only after its whole file has been checked. An error is one line with the line number, the
//! key, the value and the allowed values.

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

use crate::wire_time::{BitRates, BitRatesError};
use std::path::Path;

use crate::can::Format;
use crate::document::{self, DocumentError};
use crate::fixed::{Q1_14, TorqueFormat};
use crate::id::CellId;
use crate::packet::Length;
use crate::parameters::{Baseline, Contact, Events, Parameters, Pose, Row, Sensing};
use crate::time::Span;

pub use cell_name::{CellName, split_bus};
pub use reach::{MAX_REACH, max_frame_distance};
pub use robot::{Chain, ChainBase, ChainRow, DenavitHartenberg, Joint, JointKind, MAX_ROBOT_JOINTS, Robot};
pub use wires::BusWires;

/// Keys at the top level that only skin files have. They distinguish a skin from a scenario.
pub const SKIN_KEYS: &[&str] = &["robot", "cell"];
/// Keys at the top level that only scenarios have; see [`SKIN_KEYS`].
const SCENARIO_KEYS: &[&str] = &["duration_s", "motion", "mode", "touch", "fault", "sensors"];

/// A checked skin description.
#[derive(Clone, Debug, PartialEq)]
pub struct Skin {
    /// The skin's name.
    pub name: String,
    /// The robot that wears the skin.
    pub robot: Robot,
    /// The rates of the control loop and the joint broadcast.
    pub timing: SkinTiming,
    /// The thresholds at which cells in event mode send measurements.
    pub events: Events,
    /// The buses, in the order of the file.
    pub buses: Vec<SkinBus>,
    /// The controller that turns torques into motion.
    pub controller: Controller,
    /// Limits for holding the torques of missing cells and for halting the robot.
    pub safety: SafetyLimits,
    /// The cells, in the order of the file.
    pub cells: Vec<Cell>,
}

/// The rates of the control loop and the joint broadcast.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SkinTiming {
    /// Frequency of the control loop in Hz.
    pub control_hz: f64,
    /// Number of control ticks per joint broadcast.
    pub ticks_per_broadcast: u32,
}

impl SkinTiming {
    /// Returns the duration of a tick in ns.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "1 Hz to 10 kHz: checked")]
    pub fn tick_nanos(&self) -> u64 {
        (1e9 / self.control_hz).round() as u64
    }

    /// Returns the frequency of the joint broadcast in Hz.
    #[must_use]
    pub fn broadcast_hz(&self) -> f64 {
        self.control_hz / f64::from(self.ticks_per_broadcast)
    }
}

/// The message with which the cells of a bus reply to joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum SkinReply {
    /// Each cell sends its own torque, in the format [`SkinBus::torque_format`].
    Torque,
    /// Each cell sends the sum of its own torque and those of its children in the tree, in Q7.8.
    Sum {
        /// Width of a slot in µs.
        slot_us: u32,
        /// True if a cell adds the rounding error of a sum to its next sum.
        carry: bool,
    },
}

/// A bus of a skin.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct SkinBus {
    /// The name of the interface.
    pub name: String,
    /// The reply of the bus's cells to joints.
    pub reply: SkinReply,
    /// The frame format: one FD frame per packet, or several classic ones.
    pub format: Format,
    /// The chain that carries the bus's cells: an index into [`Robot::chains`].
    pub chain: usize,
    /// The format of the torques that the cells send on their own, not as sums.
    pub torque_format: TorqueFormat,
    /// Nominal bit rate of the hardware in bit/s, if given.
    pub bitrate: Option<u32>,
    /// Data bit rate of the hardware in bit/s, if given.
    pub data_bitrate: Option<u32>,
    /// The times at which the cells send measurements.
    pub sensing: Sensing,
    /// Time that frames take on an embedded bus.
    pub time: BusTime,
}

/// The time that frames take on an embedded bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum BusTime {
    /// None: frames are delivered at once.
    #[default]
    None,
    /// That of a real bus with the bit rates of the skin, with arbitration.
    Real,
}

impl SkinBus {
    /// Nominal bit rate of a bus for which nobody gives one, in bit/s.
    pub const DEFAULT_NOMINAL_BIT_RATE: u32 = 1_000_000;
    /// Data bit rate of the FD frames of such a bus, in bit/s.
    pub const DEFAULT_DATA_BIT_RATE: u32 = 5_000_000;

    /// Returns the rates that the skin describes, for frames of a format; the data bit rate defaults to the nominal one.
    /// Returns `None` if the skin gives no rate.
    #[must_use]
    pub fn described_rates(&self, format: Format) -> Option<Result<BitRates, BitRatesError>> {
        let nominal = self.bitrate?;
        Some(match format {
            Format::Fd => BitRates::new(nominal, self.data_bitrate.unwrap_or(nominal)),
            Format::Classic => BitRates::classic(nominal),
        })
    }

    /// Returns the described bit rates, or else the default ones.
    #[must_use]
    #[expect(clippy::missing_panics_doc, reason = "the file was checked, and the default rates are allowed")]
    pub fn rates_or_default(&self) -> BitRates {
        let default = || match self.format {
            Format::Fd => BitRates::new(Self::DEFAULT_NOMINAL_BIT_RATE, Self::DEFAULT_DATA_BIT_RATE),
            Format::Classic => BitRates::classic(Self::DEFAULT_NOMINAL_BIT_RATE),
        };
        self.described_rates(self.format).unwrap_or_else(default).expect("the rates are in their ranges")
    }
}

/// The controller that turns torques into motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Controller {
    /// The kind of controller.
    pub kind: ControllerKind,
    /// Maximum speed of each joint in rad/s, or m/s for prismatic joints.
    pub max_speed: Vec<f64>,
}

/// The kind of controller.
#[derive(Clone, Debug, PartialEq)]
pub enum ControllerKind {
    /// Independently for each joint, `M q'' + D q' = tau`, so that pushing the skin moves the arm.
    Kinesthetic {
        /// Inertia M of each joint in kg m2, or mass in kg for prismatic joints.
        inertia: Vec<f64>,
        /// Damping D of each joint in Nm s/rad, or in N s/m for prismatic joints.
        damping: Vec<f64>,
    },
    /// Another program, which exchanges datagrams with the gateway over a Unix socket.
    External {
        /// Path of the socket that the gateway listens on.
        socket: String,
        /// Maximum time until the program sends its first command. The robot stands still until then.
        start: Span,
    },
}

/// Limits for holding the torques of missing cells and for halting the robot.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct SafetyLimits {
    /// Number of epochs for which the last torque of a cell is held if the cell stops sending while in contact.
    pub hold_epochs: u32,
    /// Number of epochs over which the held torque then decays linearly to zero.
    pub decay_epochs: u32,
    /// Number of consecutive bad cycles that halt the robot.
    pub bad_cycles: u32,
    /// The reaction to the loss of one of several buses.
    pub lost_bus: LostBusReaction,
}

/// The reaction to the loss of one of several buses. If all buses are lost, the torque is always invalid.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum LostBusReaction {
    /// The torques of a lost bus decay to zero like those of missing cells. The robot continues with the other buses.
    #[default]
    Continue,
    /// The torque becomes invalid, so the robot halts after [`SafetyLimits::bad_cycles`] cycles.
    Halt,
}

impl LostBusReaction {
    /// Returns the value of the key in a skin file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Continue => "go-on",
            Self::Halt => "halt",
        }
    }
}

/// A cell of a skin.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// The cell's bus: an index into [`Skin::buses`].
    pub bus: usize,
    /// Node id of the cell on its bus.
    pub node: CellId,
    /// Serial number of the cell.
    pub serial: u32,
    /// Number of the joint k that moves the cell's link, from 1 in its chain.
    pub joint: u8,
    /// Number of the row whose frame carries the cell, from 1 in its chain: the row of joint k, or a fixed row after
    /// it.
    pub row: u8,
    /// Position in the frame of that row, in m.
    pub position: [f64; 3],
    /// Outward normal of the cell in the same frame: its z axis.
    pub normal: [f64; 3],
    /// Orientation of the cell in the same frame, a unit quaternion x, y, z, w; `None` if the file gives only the
    /// normal.
    pub orientation: Option<[f64; 4]>,
    /// Node id of the cell wired to each port; `None` for a free port.
    pub neighbors: [Option<CellId>; 4],
    /// True if the cell is wired to the gateway's side.
    pub root: bool,
    /// Gains and thresholds of the cell, as fixed-point words.
    pub contact: Contact,
    /// Baseline settings of the cell's force sensor.
    pub baseline: Baseline,
}

impl Skin {
    /// Returns a copy with these buses and their cells only. The buses are given as indices into [`Skin::buses`];
    /// invalid indices are ignored.
    #[must_use]
    pub fn restricted_to_buses(&self, kept: &[usize]) -> Self {
        let place = |bus: usize| kept.iter().position(|&it| it == bus);
        let cells = self.cells.iter();
        let cells = cells.filter_map(|cell| Some(Cell { bus: place(cell.bus)?, ..cell.clone() }));
        let buses = kept.iter().filter_map(|&bus| self.buses.get(bus)).cloned();
        Self { buses: buses.collect(), ..self.with_cells(cells.collect()) }
    }

    /// Returns a copy of the skin with `cells` in place of its cells, which are not copied.
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
    /// Returns an error if the file cannot be read, or the first error in it.
    pub fn read(path: &Path) -> Result<Self, DocumentError> {
        Self::parse(&path.display().to_string(), &document::read_text(path)?)
    }

    /// Parses and checks a text. `path` names the text in errors.
    ///
    /// # Errors
    /// Returns the first error in the text.
    pub fn parse(path: &str, text: &str) -> Result<Self, DocumentError> {
        let what = "this is a scenario, not a skin: give it as `skinbus run SKIN --scenario SCENARIO`";
        document::parse(path, text, check::check_whole_skin)
            .map_err(|error: DocumentError| error.detect_wrong_kind(text, SCENARIO_KEYS, SKIN_KEYS, what))
    }

    /// Parses and checks the text of a skin in a recording. `path` names the text in errors.
    ///
    /// Unprintable characters in names are escaped like `\u{1b}`, where [`Skin::parse`] returns an error.
    ///
    /// # Errors
    /// Returns the first error in the text.
    pub fn parse_recorded(path: &str, text: &str) -> Result<Self, DocumentError> {
        document::parse(path, text, check::check_recorded_skin)
    }

    /// Returns the parameters that are written into a cell.
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
            period_us: self.broadcast_period_us()?,
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
        Some(parameters.shortest_form())
    }

    /// Returns the chain of a bus, given as an index into [`Skin::buses`].
    #[must_use]
    #[expect(clippy::missing_panics_doc, reason = "each bus of a checked skin has a chain")]
    pub fn chain(&self, bus: usize) -> &Chain {
        let chain = self.buses.get(bus).map_or(0, |bus| bus.chain);
        self.robot.chains.get(chain).expect("a checked skin has the chains of its buses")
    }

    /// Returns the joints of a bus' chain from base to tip, each with its index into [`Robot::joints`].
    pub fn joints_on_bus(&self, bus: usize) -> impl ExactSizeIterator<Item = (usize, &Joint)> {
        self.chain(bus).joints.iter().map(|&joint| (joint, self.joint(joint)))
    }

    #[expect(clippy::expect_used, reason = "each chain of a checked skin has joints of the robot")]
    fn joint(&self, joint: usize) -> &Joint {
        self.robot.joints.get(joint).expect("a checked skin has the joints of its chains")
    }

    /// Returns the packet length of joints, torques and sums on a bus, which depends on the joints of its chain.
    #[must_use]
    pub fn packet_length(&self, bus: usize) -> Length {
        Length::for_joints(self.chain(bus).joints.len())
    }

    /// Returns the period of the joint broadcast in µs; `None` if it exceeds the 16 bits of a word.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "positive; u16 decides what fits"
    )]
    pub fn broadcast_period_us(&self) -> Option<u16> {
        u16::try_from((1e6 / self.timing.broadcast_hz()).round() as u64).ok()
    }

    /// Returns the cells of a bus, in the order of the file.
    pub fn cells_on_bus(&self, bus: usize) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(move |cell| cell.bus == bus)
    }

    /// Returns the cells that a name denotes, each with its index in [`Skin::cells`]: several if the name has no bus, and
    /// several buses have a cell with this node id.
    pub fn cells_named(&self, name: &CellName) -> impl Iterator<Item = (usize, &Cell)> {
        self.cells.iter().enumerate().filter(|(_, cell)| {
            self.buses.get(cell.bus).is_some_and(|bus| name.matches_cell(&bus.name, cell.node))
        })
    }

    /// Returns the name of a cell with its bus.
    #[must_use]
    pub fn full_cell_name(&self, bus: usize, node: CellId) -> CellName {
        CellName { bus: self.buses.get(bus).map(|bus| bus.name.clone()), node }
    }

    /// Returns a copy with the cells of one bus only. All buses remain, so that their indices stay valid.
    #[must_use]
    pub fn with_cells_of_bus(&self, bus: usize) -> Self {
        self.with_cells(self.cells_on_bus(bus).cloned().collect())
    }

    /// Returns the index of the bus with this name in [`Skin::buses`].
    #[must_use]
    pub fn bus_index(&self, name: &str) -> Option<usize> {
        self.buses.iter().position(|bus| bus.name == name)
    }
}

#[cfg(test)]
mod tests;
