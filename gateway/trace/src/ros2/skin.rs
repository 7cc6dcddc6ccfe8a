//! Message types of skinbus that record a run: the timing of the loop, torques, and the state of cells.

use super::cdr::{CdrError, CdrReader, CdrWriter, Decode, Encode};
use super::{Header, Message, definition};

/// The timing and the state of a tick, as numbers that any viewer can plot.
#[derive(Clone, Copy, Debug, Default)]
pub struct LoopTiming {
    /// The scheduled start of the tick, in ns since 1970.
    pub nanos: u64,
    /// The number of the tick; skipped ticks are counted too.
    pub tick: u64,
    /// The number of ticks that were skipped directly before this one.
    pub skipped: u64,
    /// The delay of the tick's actual start after the scheduled one, in µs.
    pub late_us: f64,
    /// The duration of the tick, in µs.
    pub took_us: f64,
    /// The part of the duration used by the central computation, in µs; 0 in ticks without one.
    pub central_us: f64,
    /// The number of cells whose torques are in the sum.
    pub contributing: u32,
    /// The age in epochs of the oldest torque in the sum.
    pub age: u32,
    /// The number of cells in contact whose torque for the last epoch is missing.
    pub stale: u32,
    /// The number of cells from which nothing was received for longer than the timeout.
    pub dead: u32,
    /// The reason why the cycle was bad, as a constant of the message definition.
    pub bad: u8,
    /// The reason why the robot is halted, as a constant of the message definition.
    pub halted: u8,
    /// Bit n is set if joint n + 1 is at a limit and was commanded beyond it, for the first 8 joints.
    pub at_limit: u8,
    /// True if a commanded velocity was not finite and was replaced by zero.
    pub refused: bool,
}

impl Message for LoopTiming {
    const TYPE: &'static str = "skinbus_msgs/msg/LoopTiming";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/LoopTiming", "std_msgs/Header", "builtin_interfaces/Time");
}

/// Encodes and decodes a message that consists of a header without a frame id and these fields in this order.
macro_rules! fields {
    ($message:ty: $($field:ident),+) => {
        impl Encode for $message {
            fn encode(&self, out: &mut CdrWriter<'_>) {
                out.put(Header { nanos: self.nanos, frame_id: "" });
                $(out.put(self.$field);)+
            }
        }

        impl Decode<'_> for $message {
            fn decode(from: &mut CdrReader<'_>) -> Result<Self, CdrError> {
                let Header { nanos, .. } = from.get()?;
                Ok(Self { nanos, $($field: from.get()?),+ })
            }
        }
    };
}
fields!(
    LoopTiming: tick, skipped, late_us, took_us, central_us, contributing, age, stale, dead, bad, halted, at_limit,
    refused
);

/// The torques of the cells and of the central computation.
#[derive(Clone, Copy, Debug)]
pub struct Torques<'a> {
    /// The scheduled start of the tick, in ns since 1970.
    pub nanos: u64,
    /// The sum of the cells' joint torques, in Nm.
    pub distributed: &'a [f64],
    /// The joint torques that the gateway computed for the same joints and touches, in Nm; empty in ticks without this
    /// computation.
    pub central: &'a [f64],
    /// The number of cells with a force above zero, by the central computation.
    pub active: u32,
}

impl Message for Torques<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/Torques";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/Torques", "std_msgs/Header", "builtin_interfaces/Time");
}

impl Encode for Torques<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(Header { nanos: self.nanos, frame_id: "" });
        out.put_sequence(self.distributed.iter());
        out.put_sequence(self.central.iter());
        let both = self.distributed.iter().zip(self.central);
        out.put_sequence(both.map(|(distributed, central)| distributed - central));
        out.put(self.active);
    }
}

/// The state of a cell and the values of its sensors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactState {
    /// The node id of the cell.
    pub node: u16,
    /// The force in N by Algorithm 1; NaN while it is unknown.
    pub force: f32,
    /// The proximity, 0 to 1; NaN while it is unknown.
    pub proximity: f32,
    /// The status of the cell, as a constant of the message definition.
    pub status: u8,
}

/// The state of all cells of a patch when the joints of an epoch were on the bus.
#[derive(Clone, Copy, Debug)]
pub struct PatchState<'a> {
    /// The time of the joints on the bus, in ns since 1970.
    pub nanos: u64,
    /// The link that the patch is on; its name is a frame of the robot.
    pub frame_id: &'a str,
    /// The epoch of these joints.
    pub epoch: u8,
    /// The cells.
    pub cells: &'a [ContactState],
}

impl Message for PatchState<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/PatchState";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/PatchState", "std_msgs/Header", "builtin_interfaces/Time");
}

impl Encode for PatchState<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        out.put(Header { nanos: self.nanos, frame_id: self.frame_id });
        out.put(self.epoch);
        out.put_sequence(self.cells.iter().map(|cell| cell.node));
        out.put_sequence(self.cells.iter().map(|cell| cell.force));
        out.put_sequence(self.cells.iter().map(|cell| cell.proximity));
        out.put_sequence(self.cells.iter().map(|cell| cell.status));
    }
}
