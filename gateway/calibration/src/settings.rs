//! The settings of a calibration.

use protocol::skin::Skin;

use crate::neighbors::Spacing;
use crate::plan::PlanBounds;
use model::accelerometer::kinematics::STANDARD_GRAVITY;
use model::accelerometer::sensor::DataSheet;

/// The prior knowledge and the options of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// The data sheet of the accelerometers.
    pub sheet: DataSheet,
    /// Gravity in the frame of the robot's base, in m/s².
    pub gravity: [f64; 3],
    /// The distance of cells that are wired to each other, if it is known.
    pub spacing: Option<Spacing>,
    /// True to estimate zero offsets of the robot's joints too.
    pub zero_offsets: bool,
    /// The number of threads that estimate cells.
    pub threads: usize,
    /// The limits of the robot's motion, which are used only for advice on further motions.
    pub bounds: PlanBounds,
}

impl Settings {
    /// Returns settings for sensors with the default data sheet, on a robot that stands upright.
    #[must_use]
    pub fn from_skin(skin: &Skin) -> Self {
        Self {
            sheet: DataSheet::default(),
            gravity: [0.0, 0.0, -STANDARD_GRAVITY],
            spacing: None,
            zero_offsets: false,
            threads: 1,
            bounds: PlanBounds::from_skin(skin),
        }
    }
}
