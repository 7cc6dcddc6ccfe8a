//! What is known before a calibration.

use protocol::skin::Skin;

use crate::neighbors::Spacing;
use crate::plan::Bounds;
use model::accelerometer::kinematics::G;
use model::accelerometer::sensor::DataSheet;

/// What is known before a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Of the accelerometers.
    pub sheet: DataSheet,
    /// Gravity as seen from the robot's base, in m/s2.
    pub gravity: [f64; 3],
    /// How far wired cells are apart, if that is known.
    pub spacing: Option<Spacing>,
    /// Whether zero offsets of the robot's joints are estimated too.
    pub zero_offsets: bool,
    /// How many threads compute.
    pub threads: usize,
    /// How the robot may move: for advice only.
    pub bounds: Bounds,
}

impl Settings {
    /// Sensors as the default data sheet says, on a robot that stands upright.
    #[must_use]
    pub fn of(skin: &Skin) -> Self {
        Self {
            sheet: DataSheet::default(),
            gravity: [0.0, 0.0, -G],
            spacing: None,
            zero_offsets: false,
            threads: 1,
            bounds: Bounds::of(skin),
        }
    }
}
