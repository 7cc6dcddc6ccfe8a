//! Simulated accelerometers of the cells of a moving robot.
//!
//! | module | content |
//! |---|---|
//! | [`kinematics`] | the specific force at a point of the robot |
//! | [`sensor`] | an accelerometer with the errors of its data sheet |

pub mod kinematics;
pub mod sensor;

use nalgebra::Vector3;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{MAX_ROBOT_JOINTS, Skin};

use kinematics::{ArmKinematics, JointState};
use sensor::{Accelerometer, DataSheet, cell_rotation};

/// Positions, speeds and accelerations of all joints of a robot.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RobotState {
    /// The positions, in rad or m.
    pub position: [f64; MAX_ROBOT_JOINTS],
    /// The speeds, in rad/s or m/s.
    pub speed: [f64; MAX_ROBOT_JOINTS],
    /// The accelerations, in rad/s2 or m/s2.
    pub acceleration: [f64; MAX_ROBOT_JOINTS],
}

impl RobotState {
    /// Returns the state of the joints of one chain; `joints` are the indices of these joints in the robot.
    #[must_use]
    pub fn chain_state(&self, joints: &[usize]) -> JointState {
        let pick = |from: &[f64; MAX_ROBOT_JOINTS]| {
            let mut to = [0.0; MAX_JOINTS];
            for (to, &joint) in to.iter_mut().zip(joints) {
                *to = from.get(joint).copied().unwrap_or_default();
            }
            to
        };
        JointState {
            position: pick(&self.position),
            speed: pick(&self.speed),
            acceleration: pick(&self.acceleration),
        }
    }
}

/// The simulated accelerometers of all cells of a skin.
#[derive(Clone, Debug)]
pub struct Accelerometers {
    arms: Vec<Option<ArmKinematics>>,
    /// Sensors by cell index.
    sensors: Vec<Accelerometer>,
}

impl Accelerometers {
    /// Creates one sensor per cell from a data sheet and a seed; `gravity` is in the robot's base frame, in m/s2.
    #[must_use]
    pub fn new(skin: &Skin, sheet: &DataSheet, seed: u64, gravity: [f64; 3]) -> Self {
        let arm = |bus: usize| skin.cells_on_bus(bus).next().map(|_| ArmKinematics::new(skin, bus, gravity));
        let sensors = skin.cells.iter().map(|cell| {
            let stream = u64::from(cell.serial).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            Accelerometer::new(sheet, seed ^ stream)
        });
        Self { arms: (0..skin.buses.len()).map(arm).collect(), sensors: sensors.collect() }
    }

    /// Returns the sensor of a cell.
    #[must_use]
    pub fn sensor(&self, cell: usize) -> Option<&Accelerometer> {
        self.sensors.get(cell)
    }

    /// Returns the reading of each cell of the skin at the time `now` in s, in g. `state` returns the robot's state at
    /// a time in s; `tilt` rotates the specific force at a cell, by the cell's index.
    pub fn readings<'a>(
        &'a self,
        skin: &'a Skin,
        state: impl Fn(f64) -> RobotState + 'a,
        now: f64,
        tilt: impl Fn(usize, &Vector3<f64>) -> Vector3<f64> + 'a,
    ) -> impl Iterator<Item = Vector3<f64>> + 'a {
        skin.cells.iter().zip(&self.sensors).enumerate().map(move |(index, (cell, sensor))| {
            let moment = state(sensor.shown_motion_time_s(now));
            let state = moment.chain_state(&skin.chain(cell.bus).joints);
            let rows = self.arms.get(cell.bus).and_then(Option::as_ref).map(|arm| arm.row_motions(&state));
            let row = rows.and_then(|rows| rows.get(usize::from(cell.row)).copied()).unwrap_or_default();
            let force = row.specific_force_at(&cell.position.into());
            let local = cell_rotation(cell.orientation, cell.normal).inverse() * force;
            sensor.reading(now, &tilt(index, &local))
        })
    }
}
