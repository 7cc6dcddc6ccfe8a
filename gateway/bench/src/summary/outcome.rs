//! How a run ended, and when and why the robot was halted.

use serde::Serialize;

/// How a run ended.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// It ran for its whole duration.
    #[default]
    Done,
    /// A signal ended it early.
    Interrupted,
    /// The robot was halted when it ended, also if a signal ended it.
    Halted,
    /// It did not come to its end, a bus was lost at its end, or its recording is incomplete.
    Failed,
}

impl core::fmt::Display for Outcome {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Done => "done",
            Self::Interrupted => "interrupted",
            Self::Halted => "halted",
            Self::Failed => "failed",
        })
    }
}

/// One time that the robot was halted.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Halted {
    /// When, in s since the loop began.
    pub at_s: f64,
    /// The tick.
    pub tick: u64,
    /// The epoch of the last joints before it.
    pub epoch: u8,
    /// Why.
    pub reason: String,
    /// When it went on; none: it did not.
    pub until_s: Option<f64>,
}

/// The record of a tick before a halt.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TickBefore {
    /// Its number.
    pub tick: u64,
    /// When it was due, in s since the loop began.
    pub time_s: f64,
    /// How late it began.
    pub late_us: f64,
    /// How long it took.
    pub took_us: f64,
    /// Ticks skipped just before it.
    pub skipped: u64,
    /// The epoch of the last joints.
    pub epoch: u8,
    /// Joint positions.
    pub q_rad: Vec<f64>,
    /// Joint velocities.
    pub qdot_rad_s: Vec<f64>,
    /// The cells' torque.
    pub torque_nm: Vec<f64>,
    /// Whether the torque could be used.
    pub valid: bool,
    /// Cells in it.
    pub contributing: u32,
    /// Epochs that the oldest of them has missed.
    pub age: u32,
    /// Cells in contact that missed the last epoch.
    pub stale: u32,
    /// Cells that have fallen silent.
    pub dead: u32,
    /// Buses that were lost.
    pub lost_buses: Vec<String>,
    /// Why the cycle was bad; none: the controller had an answer.
    pub bad_cycle: Option<String>,
    /// The commanded joint velocities.
    pub command_rad_s: Vec<f64>,
    /// Whether the robot was halted.
    pub halted: bool,
}
