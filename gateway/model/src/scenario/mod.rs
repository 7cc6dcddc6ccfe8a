//! The description of a run: the robot's motion, touches, and faults.
//!
//! A [`Scenario`] exists only when everything in its file has been checked against the skin. Every
//! error names the line, the key, the value and what is allowed, in one line. Cells are named by their
//! index in [`Skin::cells`], buses by theirs in [`Skin::buses`].

mod check;
mod curve;
mod faults;
mod force;
mod measured;
mod names;
mod pressed;
mod raw;
mod remarks;
mod sensors;
mod times;
mod touches;

use core::f64::consts::TAU;
use std::path::Path;

use protocol::document::{self, DocumentError};
use protocol::fixed::{Q1_14, Q9_6};
use protocol::skin::{KEYS, MAX_ROBOT_JOINTS, Skin};
use protocol::time::{Micros, Span};
use serde::{Deserialize, Serialize};

use crate::accelerometer::RobotState;

pub use force::{MAX_FORCE_N, contact_words};
pub use sensors::{ForceErrors, REFERENCE_C, Sensors};
pub use touches::{Stimulus, Touches};

/// How long a run takes in which nothing happens, unless it is told.
pub const IDLE: Span = Span::from_millis(10_000);

/// A checked description.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// How long it takes.
    pub duration: Span,
    /// What random faults are drawn from.
    pub seed: u64,
    /// The motion of the robot.
    pub motion: Motion,
    /// What the gateway computes, in the order of time; before the first it compares.
    pub modes: Vec<ModeChange>,
    /// The touches, in the file's order.
    pub touches: Vec<Touch>,
    /// The period after which all touches begin again; each of them ends before. The motion and the faults go on.
    pub touches_repeat: Option<Span>,
    /// The faults, in the order of time.
    pub faults: Vec<Fault>,
    /// How the sensors differ from perfect ones.
    pub sensors: Sensors,
}

/// The motion of the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Where it begins, in rad.
    pub start: [f64; MAX_ROBOT_JOINTS],
    /// How it moves from there.
    pub kind: MotionKind,
}

/// How the robot moves.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a run has one")]
pub enum MotionKind {
    /// `hold`: it stays where it is.
    Hold,
    /// `sine`: every joint swings about its start.
    Sine {
        /// How far, in rad.
        amplitude: [f64; MAX_ROBOT_JOINTS],
        /// How slowly, in s.
        period_s: f64,
    },
    /// `kinesthetic`: the skin's controller moves it, whichever that is.
    Kinesthetic,
}

impl Motion {
    /// Where the joints are `seconds` after the run's start, and how they move; `None` of a motion that is not known
    /// beforehand.
    #[must_use]
    pub fn state_at(&self, seconds: f64) -> Option<RobotState> {
        let mut state = RobotState { position: self.start, ..RobotState::default() };
        match self.kind {
            MotionKind::Hold => Some(state),
            MotionKind::Sine { amplitude, period_s } => {
                let rate = TAU / period_s;
                let (sin, cos) = (rate * seconds).sin_cos();
                let joints = state.position.iter_mut().zip(&mut state.speed).zip(&mut state.acceleration);
                for (((position, speed), acceleration), amplitude) in joints.zip(amplitude) {
                    *position += amplitude * sin;
                    *speed = amplitude * rate * cos;
                    *acceleration = -amplitude * rate * rate * sin;
                }
                Some(state)
            }
            MotionKind::Kinesthetic => None,
        }
    }
}

impl MotionKind {
    /// The word in the file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Hold => "hold",
            Self::Sine { .. } => "sine",
            Self::Kinesthetic => "kinesthetic",
        }
    }
}

/// From when on the gateway computes what.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ModeChange {
    /// From when on.
    pub at: Micros,
    /// What.
    pub mode: Mode,
}

/// What the gateway computes.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Mode {
    /// `compare`: it takes the cells' torques, and computes all of them centrally as well.
    #[default]
    Compare,
    /// `distributed`: it takes the cells' torques.
    Distributed,
}

impl Mode {
    /// The word in the file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Compare => "compare",
            Self::Distributed => "distributed",
        }
    }
}

/// Something touches some cells.
#[derive(Clone, Debug, PartialEq)]
pub struct Touch {
    /// When it begins.
    pub at: Micros,
    /// How long it lasts; the longest there is when it does not end.
    pub length: Span,
    /// What it touches, in the skin's order.
    pub cells: Vec<usize>,
    /// The peak force on each of the cells, in N.
    pub force_n: f64,
    /// How the force comes and goes.
    pub profile: Profile,
    /// How near it is, 0 to 1, all the time.
    pub proximity: Q1_14,
    /// How warm it makes the cells, in degrees Celsius.
    pub temperature: Option<[Q9_6; 2]>,
}

/// How a touch's force comes and goes.
#[derive(Clone, Debug, PartialEq)]
pub enum Profile {
    /// `half-sine`: it grows and falls like half a swing.
    HalfSine,
    /// `step`: all of it, all the time.
    Step,
    /// `ramp`: it grows evenly to all of it, and then is gone.
    Ramp,
    /// Points of a curve, linear between them: the time since the begin of the touch, the first 0, and the force in N. The touch
    /// ends at the last point.
    Points(Vec<(Span, f64)>),
}

impl Profile {
    /// The word in the file; `points` for a list of them.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::HalfSine => "half-sine",
            Self::Step => "step",
            Self::Ramp => "ramp",
            Self::Points(_) => "points",
        }
    }
}

/// A fault, or its repair.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    /// When.
    pub at: Micros,
    /// What.
    pub kind: FaultKind,
}

/// What happens.
#[derive(Clone, Debug, PartialEq)]
pub enum FaultKind {
    /// Something is done to the processes of cells.
    Process {
        /// What.
        action: ProcessAction,
        /// To which cells.
        cells: Vec<usize>,
    },
    /// Cells measure wrongly; [`Touches`] does it.
    Sensor {
        /// How.
        fault: SensorFault,
        /// For how long.
        length: Span,
        /// Which.
        cells: Vec<usize>,
    },
    /// Something is done to the wires between two cells.
    Wire {
        /// Whether they stop working; else they work again.
        link_down: bool,
        /// The sender.
        from: usize,
        /// The receiver.
        to: usize,
        /// Whether it applies to the other direction too.
        both_ways: bool,
    },
    /// A bus carries frames wrongly.
    Bus {
        /// How.
        fault: BusFault,
        /// For how long.
        length: Span,
        /// Which bus.
        bus: usize,
        /// Only frames of these cells; empty means all frames.
        cells: Vec<usize>,
    },
}

impl FaultKind {
    /// The word in the file.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Process { action: ProcessAction::Kill, .. } => "kill",
            Self::Process { action: ProcessAction::Stop, .. } => "stop",
            Self::Process { action: ProcessAction::Continue, .. } => "continue",
            Self::Process { action: ProcessAction::Restart, .. } => "restart",
            Self::Wire { link_down: true, .. } => "link_down",
            Self::Wire { link_down: false, .. } => "link_up",
            Self::Sensor { fault: SensorFault::Stuck, .. } => "stuck",
            Self::Sensor { fault: SensorFault::Drift { .. }, .. } => "drift",
            Self::Bus { fault: BusFault::Drop { .. }, .. } => "drop",
            Self::Bus { fault: BusFault::Delay { .. }, .. } => "delay",
            Self::Bus { fault: BusFault::Duplicate { .. }, .. } => "duplicate",
            Self::Bus { fault: BusFault::Corrupt { .. }, .. } => "corrupt",
            Self::Bus { fault: BusFault::Reorder { .. }, .. } => "reorder",
            Self::Bus { fault: BusFault::Babble { .. }, .. } => "babble",
        }
    }
}

/// What is done to a process.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ProcessAction {
    /// `kill`: it ends at once.
    Kill,
    /// `stop`: it hangs, as if its firmware did.
    Stop,
    /// `continue`: it goes on after a stop.
    Continue,
    /// `restart`: it is restarted, or started if it has ended.
    Restart,
}

impl ProcessAction {
    /// Its name in a scenario's file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Kill => "kill",
            Self::Stop => "stop",
            Self::Continue => "continue",
            Self::Restart => "restart",
        }
    }
}

/// How a cell measures wrongly.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SensorFault {
    /// `stuck`: it keeps the value from when the fault began.
    Stuck,
    /// `drift`: its contact force moves away from the true one.
    Drift {
        /// How quickly, in N/s; may be negative.
        n_per_s: f64,
    },
}

/// How a bus carries frames wrongly; a probability is that of a frame to be hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BusFault {
    /// `drop`: the frame is lost.
    Drop {
        /// 0 to 1.
        probability: f64,
    },
    /// `delay`: the frame comes later.
    Delay {
        /// 0 to 1.
        probability: f64,
        /// By how much.
        delay: Span,
    },
    /// `duplicate`: the frame comes twice.
    Duplicate {
        /// 0 to 1.
        probability: f64,
    },
    /// `corrupt`: bits of the frame are turned.
    Corrupt {
        /// 0 to 1.
        probability: f64,
    },
    /// `reorder`: the frame comes after the next one.
    Reorder {
        /// 0 to 1.
        probability: f64,
    },
    /// `babble`: an unknown sender sends frames all the time.
    Babble {
        /// How many.
        frames_per_s: f64,
        /// Under this identifier.
        id: u16,
    },
}

impl Scenario {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// When it cannot be read, or the first thing that is wrong with it.
    pub fn read(path: &Path, skin: &Skin) -> Result<Self, DocumentError> {
        Self::parse(&path.display().to_string(), &document::text(path)?, skin)
    }

    /// Checks a text; `path` is what errors call it.
    ///
    /// # Errors
    /// The first thing that is wrong with it.
    pub fn parse(path: &str, text: &str, skin: &Skin) -> Result<Self, DocumentError> {
        let what = "this is a skin, not a scenario: `skinbus run SKIN --scenario SCENARIO` takes both";
        document::parse(path, text, |raw| check::scenario(raw, skin))
            .map_err(|error: DocumentError| error.or_mistaken(text, KEYS, &[], what))
    }

    /// No touches, no faults, and the skin's controller moves the robot from zero.
    #[must_use]
    pub const fn idle(duration: Span) -> Self {
        let motion = Motion { start: [0.0; MAX_ROBOT_JOINTS], kind: MotionKind::Kinesthetic };
        Self {
            duration,
            seed: 1,
            motion,
            modes: Vec::new(),
            touches: Vec::new(),
            touches_repeat: None,
            faults: Vec::new(),
            sensors: Sensors::PERFECT,
        }
    }

    /// What the gateway computes at a time.
    #[must_use]
    pub fn mode_at(&self, time: Micros) -> Mode {
        self.modes.iter().rev().find(|change| change.at <= time).map_or_else(Mode::default, |it| it.mode)
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "words are exact in f64")]
mod tests;
