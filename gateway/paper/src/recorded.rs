//! Reads the ticks of a run from its recording.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::packet::pad_with_defaults;
use protocol::skin::MAX_ROBOT_JOINTS;

use trace::capture::{CaptureError, Reader, RecordingItem};
use trace::ros2::Message;
use trace::ros2::cdr::CdrError;
use trace::ros2::read;
use trace::ros2::skin::{LoopTiming, Torques};
use trace::ros2::standard::JointState;

/// The values of one tick in a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TickRow {
    /// The scheduled start of the tick, in s since the first tick.
    pub time_s: f64,
    /// The velocity of each joint in rad/s.
    pub velocity: [f64; MAX_ROBOT_JOINTS],
    /// The sum of the cells' joint torques, in Nm.
    pub distributed: [f64; MAX_ROBOT_JOINTS],
    /// The joint torques by the central computation, in Nm; `None` in ticks without it.
    pub central: Option<[f64; MAX_ROBOT_JOINTS]>,
    /// The number of cells whose torques are in `distributed`.
    pub contributing: u32,
    /// The duration of the tick, in µs.
    pub took_us: f64,
    /// The part of the duration that the central computation took, in µs.
    pub central_us: f64,
}

/// Reads the ticks of a recording, in the order of time.
///
/// # Errors
/// Returns [`CaptureError`] if the recording cannot be read or is damaged.
pub fn read(path: &Path) -> Result<Vec<TickRow>, CaptureError> {
    let mut items = Reader::open_with_all_topics(&[path.to_path_buf()])?;
    let mut rows: BTreeMap<u64, TickRow> = BTreeMap::new();
    while let Some(item) = items.next_item()? {
        if let RecordingItem::Other(other) = item {
            // Messages that cannot be decoded may come from another program, so they are ignored.
            let _ = store_message(&mut rows, other.topic, other.schema, other.nanos, other.message);
        }
    }
    let first = rows.keys().next().copied().unwrap_or(0);
    Ok(rows
        .into_iter()
        .map(|(nanos, row)| TickRow { time_s: nanos_to_seconds(nanos - first), ..row })
        .collect())
}

#[expect(clippy::cast_precision_loss, reason = "a run's length, far below 2^53 ns")]
fn nanos_to_seconds(nanos: u64) -> f64 {
    nanos as f64 * 1e-9
}

/// Stores the values of a message in the row of its tick. Ignores messages that do not belong to a tick.
fn store_message(
    rows: &mut BTreeMap<u64, TickRow>,
    topic: &str,
    schema: &str,
    nanos: u64,
    message: &[u8],
) -> Result<(), CdrError> {
    let is_states = schema == JointState::TYPE && topic.ends_with("/joint_states");
    if is_states {
        let joints = read::decode_joints(message)?;
        rows.entry(nanos).or_default().velocity = padded_to_joints(&joints.velocity);
    } else if schema == Torques::TYPE {
        let torques = read::decode_torques(message)?;
        let row = rows.entry(nanos).or_default();
        row.distributed = padded_to_joints(&torques.distributed);
        row.central = (!torques.central.is_empty()).then(|| padded_to_joints(&torques.central));
    } else if schema == LoopTiming::TYPE {
        let timing = read::decode_loop_timing(message)?;
        let row = rows.entry(nanos).or_default();
        (row.took_us, row.central_us, row.contributing) =
            (timing.took_us, timing.central_us, timing.contributing);
    }
    Ok(())
}

/// Returns an array with the number for each joint, filled with 0.
fn padded_to_joints(numbers: &[f64]) -> [f64; MAX_ROBOT_JOINTS] {
    pad_with_defaults(numbers)
}

#[cfg(test)]
mod tests {
    use super::*;
    use trace::ros2::cdr::{CdrWriter, Encode};

    #[test]
    fn the_messages_of_a_tick_make_one_row() {
        let mut rows = BTreeMap::new();
        let mut say = |topic: &str, schema: &str, nanos, message: &dyn Fn(&mut CdrWriter<'_>)| {
            let mut bytes = Vec::new();
            message(&mut CdrWriter::new(&mut bytes));
            store_message(&mut rows, topic, schema, nanos, &bytes).unwrap();
        };
        let names = ["joint1", "joint2"].map(str::to_owned);
        let states = JointState {
            nanos: 5,
            names: &names,
            position: &[9.0, 9.0],
            velocity: &[0.5, -0.5],
            effort: &[8.0, 8.0],
        };
        let commands = JointState { velocity: &[7.0, 7.0], ..states };
        let torques = Torques { nanos: 5, distributed: &[1.0, 2.0], central: &[1.5, 2.5], active: 3 };
        let timing =
            LoopTiming { nanos: 5, took_us: 6.0, central_us: 4.0, contributing: 3, ..LoopTiming::default() };
        say("/UR5/joint_commands", JointState::TYPE, 5, &|out| commands.encode(out));
        say("/UR5/joint_states", JointState::TYPE, 5, &|out| states.encode(out));
        say("/UR5/torques", Torques::TYPE, 5, &|out| torques.encode(out));
        say("/gateway/timing", LoopTiming::TYPE, 5, &|out| timing.encode(out));
        let without = Torques { nanos: 9, central: &[], active: 0, ..torques };
        say("/UR5/torques", Torques::TYPE, 9, &|out| without.encode(out));
        assert_eq!(rows.len(), 2);
        let row = rows[&5];
        assert_eq!(row.velocity[..3], [0.5, -0.5, 0.0]);
        assert_eq!((row.distributed[1], row.central.map(|central| central[0])), (2.0, Some(1.5)));
        assert_eq!((row.took_us, row.central_us, row.contributing), (6.0, 4.0, 3));
        assert_eq!(rows[&9].central, None);
    }
}
