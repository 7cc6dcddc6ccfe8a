//! A simulated skin of accelerometers in virtual time, for tests and for comparing motions.

use model::accelerometer::Accelerometers;
use nalgebra::Vector3;
use protocol::fixed::{Q, Q1_14};
use protocol::message::{Joints, Message, SensorPage};
use protocol::packet::Epoch;
use protocol::parameters::{MAX_JOINTS, RowKind};
use protocol::skin::Skin;
use protocol::time::Micros;

use crate::motion::MotionPlan;
use crate::observe::Observations;

/// The deviation of a cell from the skin's description.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum CellDefect {
    /// The cell works as the skin describes it.
    #[default]
    None,
    /// The cell sends nothing.
    Dead,
    /// The cell always sends the same value.
    Stuck,
    /// The cell sends only this fraction of its readings.
    Silent(f64),
    /// The cell tilts to and fro by this angle in rad, as the robot moves.
    Loose(f64),
}

/// Moves a simulated skin through a motion, and returns the observations of its bus; values are rounded to words as in
/// frames.
#[must_use]
pub fn simulate_observations(
    skin: &Skin,
    motion: &MotionPlan,
    sensors: &Accelerometers,
    defects: &[CellDefect],
) -> Observations {
    let mut seen = Observations::new(skin);
    let period = 1.0 / skin.timing.broadcast_hz();
    let epochs = (motion.length_s() / period).floor();
    let mut index = 0.0;
    let mut epoch = Epoch::default();
    while index < epochs {
        let now = index * period;
        let at = micros(now);
        let state = motion.state_at(now);
        for bus in 0..skin.buses.len() {
            let chain = skin.chain(bus);
            let joints = state.chain_state(&chain.joints);
            let mut positions = [Q1_14::ZERO; MAX_JOINTS];
            let kinds = chain.rows.iter().map(|row| row.kind).filter(|kind| *kind != RowKind::Fixed);
            for ((word, position), kind) in positions.iter_mut().zip(joints.position).zip(kinds) {
                *word = match kind {
                    RowKind::Prismatic => Q1_14::nearest(position),
                    RowKind::Revolute | RowKind::Fixed => Q1_14::from_radians(position).unwrap_or_default(),
                };
            }
            let in_use = u8::try_from(chain.joints.len()).unwrap_or_default();
            seen.record(bus, at, &Message::Joints { epoch, joints: Joints { positions, in_use } });
        }
        let tilt = |cell: usize, force: &Vector3<f64>| match defects.get(cell) {
            // The cell rests on one side or the other, as gravity pulls it.
            Some(CellDefect::Loose(angle)) => {
                let turn = Vector3::new(angle * force.x.signum(), angle * force.y.signum(), 0.0);
                nalgebra::Rotation3::new(turn) * force
            }
            _ => *force,
        };
        let shown: Vec<_> = sensors.readings(skin, |time| motion.state_at(time), now, tilt).collect();
        for ((number, cell), shown) in skin.cells.iter().enumerate().zip(shown) {
            let shown = match defects.get(number) {
                Some(CellDefect::Dead) => continue,
                Some(CellDefect::Silent(part)) if (index * 0.618_034).fract() >= *part => continue,
                Some(CellDefect::Stuck) => Vector3::new(0.0, 0.0, 1.0),
                _ => shown,
            };
            let words: [f64; 3] = shown.into();
            let page = SensorPage::Acceleration(words.map(Q::nearest));
            seen.record(cell.bus, at, &Message::Sensors { from: cell.node, epoch, page });
        }
        epoch = epoch.next();
        index += 1.0;
    }
    seen
}

/// Converts a time in s to a frame's time stamp.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "not negative, and below 2^53 us"
)]
fn micros(seconds: f64) -> Micros {
    Micros((seconds * 1e6).round() as u64)
}
