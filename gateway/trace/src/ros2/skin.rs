//! Our own types of a run: the loop's timing, torques, and what cells feel.

use super::cdr::{CdrError, Decode, Encode, Reader, Writer};
use super::{Header, Message, definition};

/// What a tick was like, in numbers that any viewer plots.
#[derive(Clone, Copy, Debug, Default)]
pub struct LoopTiming {
    /// When it should have begun, in ns since 1970.
    pub nanos: u64,
    /// Its number; skipped ticks are counted in.
    pub tick: u64,
    /// Ticks skipped just before it.
    pub skipped: u64,
    /// How late it began, in µs.
    pub late_us: f64,
    /// How long it took, in µs.
    pub took_us: f64,
    /// How long the central computation took of that, in µs; 0 in ticks without one.
    pub central_us: f64,
    /// Cells in the torque.
    pub contributing: u32,
    /// Epochs that the oldest of them has missed.
    pub age: u32,
    /// Cells in contact that missed the last epoch.
    pub stale: u32,
    /// Cells that have fallen silent.
    pub dead: u32,
    /// Why the cycle was bad, one of the definition's constants.
    pub bad: u8,
    /// Why the robot is halted, one of the definition's constants.
    pub halted: u8,
    /// Of joints 1 to 8 those that stand at a limit and were told to go on, one bit each, joint 1 lowest.
    pub at_limit: u8,
    /// Whether a velocity was not finite and was taken as zero.
    pub refused: bool,
}

impl Message for LoopTiming {
    const TYPE: &'static str = "skinbus_msgs/msg/LoopTiming";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/LoopTiming", "std_msgs/Header", "builtin_interfaces/Time");
}

/// Writes and reads a header without a name, and then these fields in this order.
macro_rules! fields {
    ($message:ty: $($field:ident),+) => {
        impl Encode for $message {
            fn encode(&self, out: &mut Writer<'_>) {
                out.put(Header { nanos: self.nanos, frame_id: "" });
                $(out.put(self.$field);)+
            }
        }

        impl Decode<'_> for $message {
            fn decode(from: &mut Reader<'_>) -> Result<Self, CdrError> {
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

/// The cells' torque beside the central one.
#[derive(Clone, Copy, Debug)]
pub struct Torques<'a> {
    /// When the tick should have begun, in ns since 1970.
    pub nanos: u64,
    /// The sum of what cells said, in Nm.
    pub distributed: &'a [f64],
    /// What the gateway computed of the same joints and touches, in Nm; empty in ticks without it.
    pub central: &'a [f64],
    /// Cells with a force above zero, by the central computation.
    pub active: u32,
}

impl Message for Torques<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/Torques";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/Torques", "std_msgs/Header", "builtin_interfaces/Time");
}

impl Encode for Torques<'_> {
    fn encode(&self, out: &mut Writer<'_>) {
        out.put(Header { nanos: self.nanos, frame_id: "" });
        out.sequence(self.distributed.iter());
        out.sequence(self.central.iter());
        let both = self.distributed.iter().zip(self.central);
        out.sequence(both.map(|(distributed, central)| distributed - central));
        out.put(self.active);
    }
}

/// What a cell of a patch feels, and how it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactState {
    /// Its number on the bus.
    pub node: u16,
    /// The force in N that Algorithm 1 makes of its sensors; not a number while nobody knows.
    pub force: f32,
    /// Proximity, 0 to 1; not a number while nobody knows.
    pub proximity: f32,
    /// One of the definition's constants.
    pub status: u8,
}

/// The cells of a patch when joints stood on the bus.
#[derive(Clone, Copy, Debug)]
pub struct PatchState<'a> {
    /// When the joints stood on the bus, in ns since 1970.
    pub nanos: u64,
    /// The link that the patch is on.
    pub frame_id: &'a str,
    /// The joints' epoch.
    pub epoch: u8,
    /// Each cell.
    pub cells: &'a [ContactState],
}

impl Message for PatchState<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/PatchState";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/PatchState", "std_msgs/Header", "builtin_interfaces/Time");
}

impl Encode for PatchState<'_> {
    fn encode(&self, out: &mut Writer<'_>) {
        out.put(Header { nanos: self.nanos, frame_id: self.frame_id });
        out.put(self.epoch);
        out.sequence(self.cells.iter().map(|cell| cell.node));
        out.sequence(self.cells.iter().map(|cell| cell.force));
        out.sequence(self.cells.iter().map(|cell| cell.proximity));
        out.sequence(self.cells.iter().map(|cell| cell.status));
    }
}
