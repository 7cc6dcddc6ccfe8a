//! Events of a run, one JSON object a line. `docs/reference/control.md` describes them.

use protocol::quantiles::Quantiles;
use serde::Serialize;
use serde_json::Value;

/// The id of a command, which comes back in all events about it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum RequestId {
    /// A number.
    Number(serde_json::Number),
    /// A text.
    Text(String),
}

/// An event of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "lowercase")]
pub enum ControlEvent {
    /// The control loop runs. Commands are carried out from here on.
    Ready {
        /// The version of the program.
        version: &'static str,
        /// The period of the joint broadcasts in s.
        period_s: f64,
        /// The names of the robot's joints.
        joints: Vec<String>,
        /// The buses of the skin.
        buses: Vec<ReadyBus>,
    },
    /// A command is carried out.
    Accepted {
        /// The id of the command.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<RequestId>,
        /// The name of the command.
        #[serde(rename = "do")]
        command: &'static str,
        /// The stimulus, for a press or a release.
        #[serde(flatten)]
        stimulus: Option<AskedStimulus>,
        /// The action in words, for other commands.
        #[serde(skip_serializing_if = "Option::is_none")]
        text: Option<String>,
    },
    /// A command is refused, or a line is not a command.
    Error {
        /// The id of the command, if it could be read.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<RequestId>,
        /// The reason, in one line.
        text: String,
    },
    /// The first torque shows the force of a press, or the end of a contact after a release.
    Confirmed {
        /// The id of the command.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<RequestId>,
        /// The cell as `BUS:NODE`.
        cell: String,
        /// The force in N.
        force_n: f64,
        /// The epoch that the torque answers.
        epoch: u8,
        /// The time stamp of the torque in ns since 1970.
        at_ns: u64,
        /// The torque in Nm or N, by joint of the bus's chain.
        torque: Vec<f64>,
    },
    /// No torque shows a press or a release.
    Unconfirmed {
        /// The id of the command.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<RequestId>,
        /// The cell as `BUS:NODE`.
        cell: String,
        /// The force in N.
        force_n: f64,
        /// The reason.
        reason: UnconfirmedReason,
        /// The reason in words.
        text: &'static str,
    },
    /// A torque shows that a cell is touched, or is no longer.
    Contact {
        /// The cell as `BUS:NODE`.
        cell: String,
        /// True if the cell is touched.
        touched: bool,
        /// The epoch that the torque answers.
        epoch: u8,
        /// The time stamp of the torque in ns since 1970.
        at_ns: u64,
    },
    /// A cell's state changes.
    Cell {
        /// The cell as `BUS:NODE`.
        cell: String,
        /// The new state.
        state: CellChange,
    },
    /// The robot is halted.
    Halted {
        /// The reason.
        reason: String,
    },
    /// The robot is no longer halted.
    Resumed,
    /// A bus is lost, or works again.
    Bus {
        /// The name of the bus.
        bus: String,
        /// True if it works.
        up: bool,
    },
    /// An epoch is complete.
    Epoch {
        /// The name of the bus.
        bus: String,
        /// The epoch.
        epoch: u8,
        /// The number of the epoch: its byte, continued beyond 255.
        number: u64,
        /// The time stamp of the joints that ended the epoch in ns since 1970.
        at_ns: u64,
        /// Positions and torques, by joint of the bus's chain.
        #[serde(flatten)]
        joints: JointTorques,
    },
    /// The state of the bench, on request.
    Report {
        /// The id of the command.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<RequestId>,
        /// The state of each bus.
        buses: Vec<ReportedBus>,
        /// Positions and torques, by joint of the robot.
        #[serde(flatten)]
        joints: JointTorques,
        /// The cells that have sent a torque or are not quiet.
        cells: Vec<ReportedCell>,
        /// Lateness of all ticks up to the last full second in µs; `None` in the first second.
        lateness_us: Option<Quantiles>,
        /// The number of ticks that were skipped because they were late by a period or more.
        skipped: u64,
    },
    /// The reader was too slow, so that events were dropped.
    Dropped {
        /// The number of dropped events so far.
        count: u64,
    },
    /// The run has ended. This is the last event.
    Ended {
        /// The exit code.
        code: u8,
        /// The reason, if the code is not 0.
        #[serde(skip_serializing_if = "Option::is_none")]
        text: Option<String>,
        /// The summary; `None` if the run could not start.
        #[serde(skip_serializing_if = "Option::is_none")]
        summary: Option<Value>,
    },
}

/// A bus of the skin, in the first event.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReadyBus {
    /// The name of the bus.
    pub bus: String,
    /// The kind of the bus, `socketcan` or `embedded`.
    pub kind: &'static str,
    /// The format of its frames, `fd` or `classic`.
    pub format: &'static str,
    /// The packets with which its cells answer, `torque` or `sum`.
    pub reply: &'static str,
    /// The folder of the socket of an embedded bus.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub directory: Option<String>,
    /// The names of the joints of its chain, base to tip.
    pub joints: Vec<String>,
    /// The node ids of its cells.
    pub cells: Vec<u8>,
}

/// The stimulus that a press or a release sends.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AskedStimulus {
    /// The cell as `BUS:NODE`.
    pub cell: String,
    /// The force in N, rounded to the cell's words.
    pub force_n: f64,
    /// The first epoch that the stimulus holds for.
    pub epoch: u8,
}

/// Positions and torques in one epoch, one value for each joint.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct JointTorques {
    /// Positions in rad or m.
    pub positions: Vec<f64>,
    /// The sums of the torques that the cells sent, in Nm or N; empty before the first complete epoch.
    pub distributed: Vec<f64>,
    /// The torques computed centrally from the cells' stimuli, in Nm or N; empty before the first complete epoch, and
    /// while a touched cell's sensor values are unknown.
    pub central: Vec<f64>,
}

/// The state of a bus in a report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReportedBus {
    /// The name of the bus.
    pub bus: String,
    /// True if the bus works.
    pub up: bool,
    /// True if the last command on the bus halted its cells.
    pub halted: bool,
    /// The present epoch; `None` before the first joints.
    pub epoch: Option<u8>,
    /// The number of the present epoch.
    pub number: u64,
    /// The number of frames that this channel did not receive because it read too slowly.
    pub dropped_frames: u64,
}

/// A cell in a report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReportedCell {
    /// The cell as `BUS:NODE`.
    pub cell: String,
    /// Status of the cell: `never heard`, `active`, `stale`, `dead`, or `quiet` with the torque that it sent last.
    pub status: &'static str,
    /// The epoch of its last torque.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epoch: Option<u8>,
    /// Its last torque in Nm or N, by joint of the bus's chain.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub torque: Option<Vec<f64>>,
}

/// A change of a cell's state.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CellChange {
    /// The cell sends again after it was dead.
    Alive,
    /// The cell sends nothing.
    Dead,
    /// The cell has restarted.
    Restarted,
    /// The cell answers joints.
    Ready,
}

/// The reason why no torque shows a press or a release.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum UnconfirmedReason {
    /// The cell computes a force of 0 from the sensor words.
    BelowThreshold,
    /// The force makes no torque where the cell is.
    NoTorque,
    /// The released cell was not in contact.
    NotTouched,
    /// The cell uses its own sensor, or subtracts a zero.
    Measuring,
    /// The cell is halted.
    Halted,
    /// The cell claims its node id, or has no parameters.
    NotReady,
    /// The cell sends nothing.
    Dead,
    /// The cell has restarted.
    Restarted,
    /// The cells of the bus answer with sums.
    Sums,
    /// A later command changed the force before a torque showed it.
    Superseded,
    /// The cell answered with the torque of another force.
    OtherTorque,
    /// The cell is alive but did not answer.
    NoAnswer,
    /// The run ended before.
    Ended,
}

impl UnconfirmedReason {
    /// Returns the reason in words.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::BelowThreshold => {
                "the cell computes a force of 0 from it: a threshold of the skin is higher"
            }
            Self::NoTorque => "the force makes no torque on any joint where the cell is",
            Self::NotTouched => "the cell was not in contact, so no torque ends the contact",
            Self::Measuring => "the cell uses its own sensor or subtracts a zero: put it into test mode",
            Self::Halted => "the cell is halted: resume it",
            Self::NotReady => "the cell claims its node id or has no parameters, so it answers nothing yet",
            Self::Dead => "the cell sends nothing",
            Self::Restarted => "the cell has restarted and forgotten the force: press it again",
            Self::Sums => {
                "the cells of this bus answer with sums, in which one cell's torque cannot be told apart"
            }
            Self::Superseded => "a later command changed the force before a torque showed it",
            Self::OtherTorque => {
                "the cell answered with the torque of another force: something else touches it"
            }
            Self::NoAnswer => "the cell is alive but did not answer: frames were lost or late",
            Self::Ended => "the run ended before the cell answered",
        }
    }
}
