//! The settings of a calibration.

use protocol::skin::Skin;

use crate::neighbors::Spacing;
use crate::plan::Bounds;
use model::accelerometer::kinematics::G;
use model::accelerometer::sensor::DataSheet;

/// The prior knowledge and the options of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// The data sheet of the accelerometers.
    pub sheet: DataSheet,
    /// Gravity in the frame of the robot's base, in m/s².
    pub gravity: [f64; 3],
    /// The distance of wired cells, if known.
    pub spacing: Option<Spacing>,
    /// True to estimate zero offsets of the robot's joints too.
    pub zero_offsets: bool,
    /// The number of threads.
    pub threads: usize,
    /// The limits for the robot's motion, for advice only.
    pub bounds: Bounds,
}

impl Settings {
    /// Returns settings for sensors by the default data sheet, on a robot that stands upright.
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
