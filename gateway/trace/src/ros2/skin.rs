//! Our own types of a run: the loop's timing, torques, and what cells feel.

use super::Message;
use super::cdr::Writer;
use super::messages::{header, write_header};

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
    /// Joints that stand at a limit and were told to go on, one bit each, joint 1 lowest.
    pub at_limit: u8,
    /// Whether a velocity was not finite and was taken as zero.
    pub refused: bool,
}

impl Message for LoopTiming {
    const TYPE: &'static str = "skinbus_msgs/msg/LoopTiming";
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header      # when the tick should have begun
uint64 tick                 # skipped ticks are counted in
uint64 skipped              # ticks skipped just before this one
float64 late_us             # how late it began
float64 took_us             # how long it took
float64 central_us          # the central computation's part of that, 0 without one
uint32 contributing         # cells in the torque
uint32 age                  # epochs that the oldest of them has missed
uint32 stale                # cells in contact that missed the last epoch
uint32 dead                 # cells that have fallen silent
uint8 GOOD=0
uint8 TORQUE=1              # the torque is not valid
uint8 NO_PEER=2             # no external controller is connected
uint8 NO_ANSWER=3           # the external controller's answer is missing
uint8 NONSENSE=4            # the external controller sent nonsense
uint8 OTHER=255
uint8 bad                   # why the cycle was bad
uint8 NOT_HALTED=0
uint8 BAD_CYCLES=1          # too many bad cycles in a row
uint8 HALT_FRAME=2          # somebody sent a halt frame
uint8 halted                # why the robot is halted
uint8 at_limit              # joints that stand at a limit, bit 0 is the first
bool refused                # a velocity was not finite and was taken as zero

",
        header!()
    );

    fn write(&self, out: &mut Writer<'_>) {
        write_header(out, self.nanos, "");
        out.u64(self.tick);
        out.u64(self.skipped);
        out.f64(self.late_us);
        out.f64(self.took_us);
        out.f64(self.central_us);
        out.u32(self.contributing);
        out.u32(self.age);
        out.u32(self.stale);
        out.u32(self.dead);
        out.u8(self.bad);
        out.u8(self.halted);
        out.u8(self.at_limit);
        out.bool(self.refused);
    }
}

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
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header      # when the tick should have begun
float64[] distributed       # the sum of what cells said, Nm by joint
float64[] central           # computed by the gateway of the same joints and touches, Nm; empty without
float64[] difference        # distributed - central, Nm
uint32 active               # cells with a force above zero, by the central computation

",
        header!()
    );

    fn write(&self, out: &mut Writer<'_>) {
        write_header(out, self.nanos, "");
        for values in [self.distributed, self.central] {
            out.sequence(values.iter(), |out, &value| out.f64(value));
        }
        let difference = self.distributed.iter().zip(self.central);
        out.sequence(difference, |out, (distributed, central)| out.f64(distributed - central));
        out.u32(self.active);
    }
}

/// What a cell of a patch feels, and how it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Felt {
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
    pub cells: &'a [Felt],
}

impl Message for PatchState<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/PatchState";
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header      # when the epoch's joints stood on the bus; frame_id is the link
uint8 epoch                 # of those joints
uint16[] node               # the cells' numbers on their bus; the arrays below are in the same order
float32[] force             # N, by Algorithm 1; not a number while nobody knows
float32[] proximity         # 0 (nothing near) to 1; not a number while nobody knows
uint8 UNKNOWN=0             # never heard
uint8 QUIET=1               # alive and not in contact
uint8 ACTIVE=2              # in contact, and answered the last epoch that had time for it
uint8 STALE=3               # in contact, and missed an epoch
uint8 DEAD=4                # silent for too long
uint8[] status

",
        header!()
    );

    fn write(&self, out: &mut Writer<'_>) {
        write_header(out, self.nanos, self.frame_id);
        out.u8(self.epoch);
        out.sequence(self.cells.iter(), |out, cell| out.u16(cell.node));
        out.sequence(self.cells.iter(), |out, cell| out.f32(cell.force));
        out.sequence(self.cells.iter(), |out, cell| out.f32(cell.proximity));
        out.sequence(self.cells.iter(), |out, cell| out.u8(cell.status));
    }
}
