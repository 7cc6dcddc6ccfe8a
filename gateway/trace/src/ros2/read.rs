//! Decodes the messages that the control loop has recorded.

use super::Header;
use super::cdr::{CdrError, CdrReader};
use super::skin::LoopTiming;

/// The robot's joints at a tick.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Joints {
    /// Positions in rad.
    pub position: Vec<f64>,
    /// Velocities in rad/s.
    pub velocity: Vec<f64>,
}

/// The joint torques at a tick, by the cells and by the central computation.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Torques {
    /// The sum of the cells' torques for each joint, in Nm.
    pub distributed: Vec<f64>,
    /// The torques of the central computation for each joint, in Nm; empty in ticks without one.
    pub central: Vec<f64>,
    /// The number of cells with a force above zero, by the central computation.
    pub active: u32,
}

/// Decodes `sensor_msgs/JointState`.
///
/// # Errors
/// Returns [`CdrError`] if the bytes are not a message of this type.
pub fn decode_joints(message: &[u8]) -> Result<Joints, CdrError> {
    let mut from = CdrReader::new(message)?;
    from.get::<Header<'_>>()?;
    from.get::<Vec<&str>>()?;
    Ok(Joints { position: from.get()?, velocity: from.get()? })
}

/// Decodes `skinbus_msgs/Torques`.
///
/// # Errors
/// Returns [`CdrError`] if the bytes are not a message of this type.
pub fn decode_torques(message: &[u8]) -> Result<Torques, CdrError> {
    let mut from = CdrReader::new(message)?;
    from.get::<Header<'_>>()?;
    let [distributed, central, _difference] = [from.get()?, from.get()?, from.get()?];
    Ok(Torques { distributed, central, active: from.get()? })
}

/// Decodes `skinbus_msgs/LoopTiming`.
///
/// # Errors
/// Returns [`CdrError`] if the bytes are not a message of this type.
pub fn decode_loop_timing(message: &[u8]) -> Result<LoopTiming, CdrError> {
    CdrReader::new(message)?.get()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::Message;
    use crate::ros2::{skin, standard};

    #[test]
    fn what_the_recorder_writes_is_read() {
        let mut bytes = Vec::new();
        let names = ["joint1".to_owned(), "joint2".to_owned()];
        let (position, velocity) = ([0.5, -1.25], [2.0, 3.0]);
        standard::JointState {
            nanos: 5,
            names: &names,
            position: &position,
            velocity: &velocity,
            effort: &[],
        }
        .encode_into(&mut bytes);
        assert_eq!(
            decode_joints(&bytes).unwrap(),
            Joints { position: position.into(), velocity: velocity.into() }
        );

        let (distributed, central) = ([1.0, 2.0], [1.5, 2.5]);
        skin::Torques { nanos: 5, distributed: &distributed, central: &central, active: 7 }
            .encode_into(&mut bytes);
        let expected = Torques { distributed: distributed.into(), central: central.into(), active: 7 };
        assert_eq!(decode_torques(&bytes).unwrap(), expected);

        let written = LoopTiming {
            nanos: 5,
            tick: 1,
            skipped: 2,
            late_us: 3.0,
            took_us: 4.0,
            central_us: 5.0,
            contributing: 6,
            age: 7,
            stale: 8,
            dead: 9,
            bad: 4,
            halted: 2,
            at_limit: 33,
            refused: true,
        };
        written.encode_into(&mut bytes);
        assert_eq!(format!("{:?}", decode_loop_timing(&bytes).unwrap()), format!("{written:?}"));
        assert!(decode_loop_timing(bytes.get(..60).unwrap()).is_err());
        assert!(decode_torques(&bytes).is_err(), "another type");
    }
}
