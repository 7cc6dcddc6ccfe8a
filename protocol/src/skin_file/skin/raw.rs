//! The structure of a skin file before it is checked, as `serde` deserialises it.

use serde::Deserialize;

use super::{DenavitHartenberg, JointKind, LostBusReaction};
use crate::can::Format;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawSkin {
    #[serde(default = "version")]
    pub(super) version: i64,
    #[serde(default = "name")]
    pub(super) name: String,
    pub(super) robot: RawRobot,
    #[serde(default)]
    pub(super) timing: RawTiming,
    #[serde(default)]
    pub(super) contact: RawContact,
    #[serde(default)]
    pub(super) events: RawEvents,
    pub(super) baseline: Option<RawBaseline>,
    #[serde(default = "one_bus")]
    pub(super) bus: Vec<RawBus>,
    #[serde(default)]
    pub(super) controller: RawController,
    #[serde(default)]
    pub(super) safety: RawSafety,
    pub(super) cell: Vec<RawCell>,
}

const fn version() -> i64 {
    1
}

fn name() -> String {
    "skin".to_owned()
}

fn one_bus() -> Vec<RawBus> {
    vec![RawBus::default()]
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawRobot {
    #[serde(default = "robot")]
    pub(super) name: String,
    pub(super) urdf: Option<String>,
    pub(super) joints: Option<Vec<DenavitHartenberg>>,
    pub(super) limits_rad: Option<Vec<[f64; 2]>>,
    #[serde(default)]
    pub(super) joint: Vec<RawJoint>,
    #[serde(default)]
    pub(super) chain: Vec<RawChain>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawJoint {
    pub(super) name: String,
    #[serde(default = "revolute")]
    pub(super) kind: String,
    pub(super) limits: Option<[f64; 2]>,
}

fn revolute() -> String {
    JointKind::Revolute.name().to_owned()
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawChain {
    pub(super) name: String,
    pub(super) base: Option<RawBase>,
    pub(super) rows: Vec<RawRow>,
}

/// The pose of a chain's base relative to the robot's base.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawBase {
    #[serde(default)]
    pub(super) position: [f64; 3],
    pub(super) orientation: Option<[f64; 4]>,
}

/// A row of a chain's table; a fixed row if it names no joint.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawRow {
    pub(super) joint: Option<String>,
    pub(super) a: f64,
    pub(super) alpha: f64,
    pub(super) d: f64,
    pub(super) theta_offset: f64,
}

fn robot() -> String {
    "robot".to_owned()
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawTiming {
    pub(super) control_hz: f64,
    pub(super) joint_broadcast_hz: f64,
}

impl Default for RawTiming {
    /// Returns the rates that the paper uses.
    fn default() -> Self {
        Self { control_hz: 500.0, joint_broadcast_hz: 62.5 }
    }
}

/// Gains and thresholds. In the table of a cell they override those of the skin.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawContact {
    pub(super) alpha_c: Option<f64>,
    pub(super) alpha_p: Option<f64>,
    pub(super) contact_threshold_n: Option<f64>,
    pub(super) proximity_threshold: Option<f64>,
    pub(super) force_threshold_n: Option<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawBus {
    pub(super) name: String,
    pub(super) reply: String,
    pub(super) format: String,
    pub(super) chain: Option<String>,
    pub(super) torque_format: Option<String>,
    pub(super) slot_us: Option<i64>,
    pub(super) carry: Option<bool>,
    pub(super) bitrate: Option<i64>,
    pub(super) data_bitrate: Option<i64>,
    pub(super) time: Option<String>,
    pub(super) sensing: Option<String>,
    pub(super) sensing_hz: Option<f64>,
}

impl Default for RawBus {
    fn default() -> Self {
        Self {
            name: "vcan0".to_owned(),
            reply: "torque".to_owned(),
            format: Format::Fd.name().to_owned(),
            chain: None,
            torque_format: None,
            slot_us: None,
            carry: None,
            bitrate: None,
            data_bitrate: None,
            time: None,
            sensing: None,
            sensing_hz: None,
        }
    }
}

/// The thresholds at which cells in event mode send measurements.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawEvents {
    pub(super) contact_n: Option<f64>,
    pub(super) proximity: Option<f64>,
    pub(super) temperature_c: Option<f64>,
    pub(super) acceleration_g: Option<f64>,
    pub(super) hysteresis: Option<f64>,
}

/// The baseline settings of the force sensors.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawBaseline {
    pub(super) mode: Option<String>,
    pub(super) threshold_n: Option<f64>,
    pub(super) hysteresis: Option<f64>,
    pub(super) rate_n_per_s: Option<f64>,
    pub(super) limit_n: Option<f64>,
    pub(super) n_per_c: Option<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawController {
    pub(super) kind: String,
    pub(super) inertia: Option<Vec<f64>>,
    pub(super) damping: Option<Vec<f64>>,
    pub(super) max_speed: Option<Vec<f64>>,
    pub(super) max_speed_rad_s: Option<Vec<f64>>,
    pub(super) socket: Option<String>,
    pub(super) start_s: Option<f64>,
}

impl Default for RawController {
    fn default() -> Self {
        let kind = "kinesthetic".to_owned();
        Self {
            kind,
            inertia: None,
            damping: None,
            max_speed: None,
            max_speed_rad_s: None,
            socket: None,
            start_s: None,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawSafety {
    pub(super) hold_epochs: i64,
    pub(super) decay_epochs: i64,
    pub(super) bad_cycles: i64,
    pub(super) lost_bus: String,
}

impl Default for RawSafety {
    /// Returns limits with which the torque is held for two missing replies and decays over four more, and 25 bad
    /// cycles (1/20 s) halt the robot.
    fn default() -> Self {
        Self {
            hold_epochs: 2,
            decay_epochs: 4,
            bad_cycles: 25,
            lost_bus: LostBusReaction::Continue.name().to_owned(),
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawCell {
    pub(super) bus: Option<String>,
    pub(super) node: i64,
    pub(super) serial: Option<i64>,
    pub(super) joint: Option<i64>,
    pub(super) row: Option<i64>,
    pub(super) position: [f64; 3],
    pub(super) orientation: Option<[f64; 4]>,
    pub(super) normal: Option<[f64; 3]>,
    #[serde(default)]
    pub(super) neighbors: [i64; 4],
    #[serde(default)]
    pub(super) root: bool,
    pub(super) alpha_c: Option<f64>,
    pub(super) alpha_p: Option<f64>,
    pub(super) contact_threshold_n: Option<f64>,
    pub(super) proximity_threshold: Option<f64>,
    pub(super) force_threshold_n: Option<f64>,
    pub(super) baseline_limit_n: Option<f64>,
    pub(super) baseline_n_per_c: Option<f64>,
}

impl RawCell {
    /// Returns the gains and thresholds that the cell overrides.
    pub(super) const fn contact(&self) -> RawContact {
        RawContact {
            alpha_c: self.alpha_c,
            alpha_p: self.alpha_p,
            contact_threshold_n: self.contact_threshold_n,
            proximity_threshold: self.proximity_threshold,
            force_threshold_n: self.force_threshold_n,
        }
    }
}
