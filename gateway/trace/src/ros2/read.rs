//! Messages of the control loop, read back from a recording.

use super::cdr::{CdrError, Reader};
use super::skin::LoopTiming;

/// Sequences longer than this are none of ours.
const MOST: usize = 64;

/// The robot's joints at a tick.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Joints {
    /// In rad.
    pub position: Vec<f64>,
    /// In rad/s.
    pub velocity: Vec<f64>,
}

/// The cells' torque and the central one at a tick.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Torques {
    /// The cells', in Nm.
    pub distributed: Vec<f64>,
    /// In Nm; empty without a central computation.
    pub central: Vec<f64>,
    /// Cells in contact.
    pub active: u32,
}

fn header(from: &mut Reader<'_>) -> Result<(), CdrError> {
    from.i32()?;
    from.u32()?;
    from.str()?;
    Ok(())
}

fn count(from: &mut Reader<'_>) -> Result<usize, CdrError> {
    match from.count()? {
        count if count <= MOST => Ok(count),
        count => Err(CdrError::Value { what: "a count of joints", got: count as u64, allowed: "0 to 64" }),
    }
}

fn numbers(from: &mut Reader<'_>) -> Result<Vec<f64>, CdrError> {
    (0..count(from)?).map(|_| from.f64()).collect()
}

/// `sensor_msgs/JointState`.
///
/// # Errors
/// When the bytes are no such message.
pub fn joints(message: &[u8]) -> Result<Joints, CdrError> {
    let mut from = Reader::new(message)?;
    header(&mut from)?;
    for _ in 0..count(&mut from)? {
        from.str()?;
    }
    Ok(Joints { position: numbers(&mut from)?, velocity: numbers(&mut from)? })
}

/// `skinbus_msgs/Torques`.
///
/// # Errors
/// When the bytes are no such message.
pub fn torques(message: &[u8]) -> Result<Torques, CdrError> {
    let mut from = Reader::new(message)?;
    header(&mut from)?;
    let (distributed, central) = (numbers(&mut from)?, numbers(&mut from)?);
    numbers(&mut from)?;
    Ok(Torques { distributed, central, active: from.u32()? })
}

/// `skinbus_msgs/LoopTiming`; its time is the recording's.
///
/// # Errors
/// When the bytes are no such message.
pub fn timing(message: &[u8], nanos: u64) -> Result<LoopTiming, CdrError> {
    let mut from = Reader::new(message)?;
    header(&mut from)?;
    Ok(LoopTiming {
        nanos,
        tick: from.u64()?,
        skipped: from.u64()?,
        late_us: from.f64()?,
        took_us: from.f64()?,
        central_us: from.f64()?,
        contributing: from.u32()?,
        age: from.u32()?,
        stale: from.u32()?,
        dead: from.u32()?,
        bad: from.u8()?,
        halted: from.u8()?,
        at_limit: from.u8()?,
        refused: from.bool()?,
    })
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
        assert_eq!(joints(&bytes).unwrap(), Joints { position: position.into(), velocity: velocity.into() });

        let (distributed, central) = ([1.0, 2.0], [1.5, 2.5]);
        skin::Torques { nanos: 5, distributed: &distributed, central: &central, active: 7 }
            .encode_into(&mut bytes);
        let expected = Torques { distributed: distributed.into(), central: central.into(), active: 7 };
        assert_eq!(torques(&bytes).unwrap(), expected);

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
        assert_eq!(format!("{:?}", timing(&bytes, 5).unwrap()), format!("{written:?}"));
        assert!(timing(bytes.get(..60).unwrap(), 5).is_err());
        assert!(torques(&bytes).is_err(), "another type");
    }
}
