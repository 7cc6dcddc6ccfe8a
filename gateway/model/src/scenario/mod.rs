//! The description of a run: the robot's motion, touches, and faults.
//!
//! A [`Scenario`] has been checked completely against its skin. Every error names the line, the key, the value and the
//! allowed values, in one line. Cells are given by their index in [`Skin::cells`], buses by their index in
//! [`Skin::buses`].

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
mod touch_values;
mod touches;

use core::f64::consts::TAU;
use std::path::Path;

use protocol::document::{self, DocumentError};
use protocol::skin::{MAX_ROBOT_JOINTS, SKIN_KEYS, Skin};
use protocol::time::{Micros, Span};
use serde::{Deserialize, Serialize};

use crate::accelerometer::RobotState;

pub use force::{MAX_FORCE_N, contact_words};
pub use sensors::{ForceErrors, REFERENCE_TEMPERATURE_C, SensorErrors};
pub use touch_values::TouchValues;
pub use touches::{Stimulus, Touches};

/// The default duration of a run without events.
pub const DEFAULT_DURATION: Span = Span::from_millis(10_000);

/// A checked description of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// The duration of the run.
    pub duration: Span,
    /// The seed of random faults and sensor errors.
    pub seed: u64,
    /// The motion of the robot.
    pub motion: Motion,
    /// The gateway's modes, in order of time; before the first, the mode is [`TorqueSource::Compare`].
    pub modes: Vec<ModeChange>,
    /// The touches, in the file's order.
    pub touches: Vec<Touch>,
    /// The period after which all touches begin again; each touch ends before that. The motion and the faults do not
    /// repeat.
    pub touches_repeat: Option<Span>,
    /// The faults, in order of time.
    pub faults: Vec<Fault>,
    /// The errors of the sensors.
    pub sensors: SensorErrors,
}

/// The motion of the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// The start position, in rad or m.
    pub start: [f64; MAX_ROBOT_JOINTS],
    /// The kind of motion from the start position.
    pub kind: MotionKind,
}

/// The kind of a robot's motion.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a run has one")]
pub enum MotionKind {
    /// `hold`: the robot stays at its start position.
    Hold,
    /// `sine`: every joint swings around its start.
    Sine {
        /// The amplitude of each joint, in rad or m.
        amplitude: [f64; MAX_ROBOT_JOINTS],
        /// The period, in s.
        period_s: f64,
    },
    /// `kinesthetic`: the skin's controller moves the robot.
    Kinesthetic,
}

impl Motion {
    /// Returns the state of the joints `seconds` after the start of the run; `None` if the motion is not known in
    /// advance.
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
    /// Returns the name of the motion in a scenario's file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Hold => "hold",
            Self::Sine { .. } => "sine",
            Self::Kinesthetic => "kinesthetic",
        }
    }
}

/// A change of the gateway's mode.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ModeChange {
    /// The time of the change.
    pub at: Micros,
    /// The new mode.
    pub mode: TorqueSource,
}

/// The source of the torques that the gateway uses.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum TorqueSource {
    /// `compare`: the gateway uses the cells' torques, and computes all of them centrally as well.
    #[default]
    Compare,
    /// `distributed`: the gateway uses the cells' torques.
    Distributed,
}

impl TorqueSource {
    /// Returns the name of the mode in a scenario's file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Compare => "compare",
            Self::Distributed => "distributed",
        }
    }
}

/// A touch: a force on some cells for some time.
#[derive(Clone, Debug, PartialEq)]
pub struct Touch {
    /// The start time.
    pub at: Micros,
    /// The duration; the maximum value if the touch does not end.
    pub length: Span,
    /// The touched cells, in the skin's order.
    pub cells: Vec<usize>,
    /// The peak force on each of the cells, in N.
    pub force_n: f64,
    /// The course of the force.
    pub profile: ForceProfile,
    /// The values besides the force.
    pub values: TouchValues,
}

/// The course of a touch's force over time.
#[derive(Clone, Debug, PartialEq)]
pub enum ForceProfile {
    /// `half-sine`: the force follows half a period of a sine.
    HalfSine,
    /// `step`: the full force during the whole touch.
    Step,
    /// `ramp`: the force grows linearly to its peak and then drops to zero.
    Ramp,
    /// Points of a curve, linear between them: the time since the start of the touch, beginning with 0, and the force
    /// in N. The touch ends at the last point.
    Points(Vec<(Span, f64)>),
}

impl ForceProfile {
    /// Returns the name of the profile in a scenario's file; `points` for a list of points.
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

/// A fault, or the repair of one.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    /// The time of the fault.
    pub at: Micros,
    /// The kind of fault, with its details.
    pub kind: FaultKind,
}

/// The kind of a fault or repair.
#[derive(Clone, Debug, PartialEq)]
pub enum FaultKind {
    /// An action on the processes of cells, such as killing them.
    Process {
        /// The action.
        action: ProcessAction,
        /// The cells.
        cells: Vec<usize>,
    },
    /// An error of the sensor readings of cells, applied by [`Touches`].
    Sensor {
        /// The kind of error.
        fault: SensorFault,
        /// The duration.
        length: Span,
        /// The cells.
        cells: Vec<usize>,
    },
    /// A wire between two cells goes down or comes up.
    Wire {
        /// True if the wire goes down, false if it comes up.
        link_down: bool,
        /// The cell that sends over the wire.
        from: usize,
        /// The cell that receives over the wire.
        to: usize,
        /// True if the other direction of the wire changes, too.
        both_ways: bool,
    },
    /// A disturbance of the frames of a bus.
    Bus {
        /// The disturbance.
        fault: BusFault,
        /// The duration.
        length: Span,
        /// The bus.
        bus: usize,
        /// Only frames of these cells; empty means all frames.
        cells: Vec<usize>,
    },
}

impl FaultKind {
    /// Returns the name of the fault in a scenario's file.
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

/// An action on the process of a cell.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ProcessAction {
    /// `kill`: ends the process at once.
    Kill,
    /// `stop`: suspends the process, as if its firmware hung.
    Stop,
    /// `continue`: resumes the process after a stop.
    Continue,
    /// `restart`: restarts the process, or starts it if it has ended.
    Restart,
}

impl ProcessAction {
    /// Returns the name of the action in a scenario's file.
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

/// An error of a cell's force sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SensorFault {
    /// `stuck`: the reading keeps its value from the start of the fault.
    Stuck,
    /// `drift`: the contact force drifts away from the true one.
    Drift {
        /// The drift in N/s, of either sign.
        n_per_s: f64,
    },
}

/// A disturbance of the frames of a bus. The probability applies to each frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BusFault {
    /// `drop`: the frame is lost.
    Drop {
        /// Probability for each frame, 0 to 1.
        probability: f64,
    },
    /// `delay`: the frame arrives later.
    Delay {
        /// Probability for each frame, 0 to 1.
        probability: f64,
        /// The delay.
        delay: Span,
    },
    /// `duplicate`: the frame arrives twice.
    Duplicate {
        /// Probability for each frame, 0 to 1.
        probability: f64,
    },
    /// `corrupt`: bits of the frame are flipped.
    Corrupt {
        /// Probability for each frame, 0 to 1.
        probability: f64,
    },
    /// `reorder`: the frame arrives after the next one.
    Reorder {
        /// Probability for each frame, 0 to 1.
        probability: f64,
    },
    /// `babble`: an unknown sender sends frames continuously.
    Babble {
        /// Frames per second.
        frames_per_s: f64,
        /// The identifier of the frames that the unknown sender sends.
        id: u16,
    },
}

impl Scenario {
    /// Reads and checks a scenario's file.
    ///
    /// # Errors
    /// Returns [`DocumentError`] if the file cannot be read, or with its first fault.
    pub fn read(path: &Path, skin: &Skin) -> Result<Self, DocumentError> {
        Self::parse(&path.display().to_string(), &document::read_text(path)?, skin)
    }

    /// Checks the text of a scenario; errors name `path` as its file.
    ///
    /// # Errors
    /// Returns [`DocumentError`] with the first fault in the text.
    pub fn parse(path: &str, text: &str, skin: &Skin) -> Result<Self, DocumentError> {
        let what = "this is a skin, not a scenario: give both, as in `skinbus run SKIN --scenario SCENARIO`";
        document::parse(path, text, |raw| check::scenario(raw, skin))
            .map_err(|error: DocumentError| error.detect_wrong_kind(text, SKIN_KEYS, &[], what))
    }

    /// Returns a scenario without touches and faults, in which the skin's controller moves the robot from zero.
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
            sensors: SensorErrors::PERFECT,
        }
    }

    /// Returns the gateway's mode at a time.
    #[must_use]
    pub fn mode_at(&self, time: Micros) -> TorqueSource {
        self.modes
            .iter()
            .rev()
            .find(|change| change.at <= time)
            .map_or_else(TorqueSource::default, |it| it.mode)
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "words are exact in f64")]
mod tests;
