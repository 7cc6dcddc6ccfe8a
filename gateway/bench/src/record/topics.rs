//! Topics of a recording and their messages.

use std::io;

use protocol::candump::{Direction, Record, Timestamp};
use protocol::skin::MAX_ROBOT_JOINTS;

use super::feed::EpochContacts;
use control::controller::BadCycle;
use control::cycle::Halt;
use control::cycle::turn::TimedRecord;
use model::latched::LatchedFrame;
use model::table::CellStatus;
use trace::capture::CaptureNote;
use trace::recording::NOTES_TOPIC;
use trace::recording::file::Channel;
use trace::recording::layout::{Layout, Patch};
use trace::recording::series::Writer;
use trace::recording::window::ReorderWindow;
use trace::ros2::robot::{StringMessage, Transforms};
use trace::ros2::skin::{ContactState, LoopTiming, PatchState, Torques};
use trace::ros2::standard::{Diagnosis, Diagnostics, JointState, Point, PointCloud};

/// QoS profile that bag tools store for latched topics: readers that join later get the last message.
const LATCHED_QOS: (&str, &str) = (
    "offered_qos_profiles",
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n    \
     nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  \
     liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
     avoid_ros_namespace_conventions: false\n",
);
const TIMING_TOPIC: &str = "/gateway/timing";
const DIAGNOSTICS_TOPIC: &str = "/diagnostics";
const TF_TOPIC: &str = "/tf";
const TF_STATIC_TOPIC: &str = "/tf_static";
const ROBOT_DESCRIPTION_TOPIC: &str = "/robot_description";

/// Number of messages that [`Topics::write_robot`] writes.
pub const ROBOT_MESSAGE_COUNT: u64 = 2;

/// Channels of one file.
#[derive(Debug)]
pub struct Topics {
    can: Vec<Channel>,
    state: Vec<Channel>,
    notes: Channel,
    joint_states: Channel,
    joint_commands: Channel,
    torques: Channel,
    timing: Channel,
    diagnostics: Channel,
    /// Channels of moving links, fixed links and the description.
    robot: Option<[Channel; 3]>,
    /// Channels of each patch: its state and its points.
    patches: Vec<[Channel; 2]>,
}

impl Topics {
    /// Creates all channels, so that a reader knows all topics from the beginning.
    ///
    /// # Errors
    /// Returns [`io::Error`] if the file cannot be written.
    pub fn new(writer: &mut Writer, layout: &Layout) -> io::Result<Self> {
        let digits = [("time_digits", "9")];
        let of_arm = ["joint_states", "joint_commands", "torques"];
        let of_arm = of_arm.map(|topic| format!("/{}/{topic}", layout.arm));
        let fixed = [
            NOTES_TOPIC,
            TIMING_TOPIC,
            DIAGNOSTICS_TOPIC,
            TF_TOPIC,
            TF_STATIC_TOPIC,
            ROBOT_DESCRIPTION_TOPIC,
        ]
        .map(str::to_owned);
        let others = fixed.into_iter().chain(of_arm.iter().cloned());
        let [can, state] = layout.bus_topics(others).map(|topics| -> io::Result<Vec<Channel>> {
            topics.iter().map(|topic| writer.channel::<Record<'_>>(topic, &digits)).collect()
        });
        let (can, state) = (can?, state?);
        let patches = layout.patches.iter().map(|Patch { topic, .. }| {
            let state = writer.channel::<PatchState<'_>>(topic, &[])?;
            Ok([state, writer.channel::<PointCloud<'_>>(&format!("{topic}/points"), &[])?])
        });
        let patches = patches.collect::<io::Result<_>>()?;
        let [states, commands, torques] = &of_arm;
        let robot = layout.robot.is_some().then(|| {
            let moving = writer.channel::<Transforms<'_>>(TF_TOPIC, &[])?;
            let still = writer.channel::<Transforms<'_>>(TF_STATIC_TOPIC, &[LATCHED_QOS])?;
            Ok::<_, io::Error>([
                moving,
                still,
                writer.channel::<StringMessage<'_>>(ROBOT_DESCRIPTION_TOPIC, &[LATCHED_QOS])?,
            ])
        });
        Ok(Self {
            can,
            state,
            notes: writer.channel::<CaptureNote<'_>>(NOTES_TOPIC, &[])?,
            joint_states: writer.channel::<JointState<'_>>(states, &[])?,
            joint_commands: writer.channel::<JointState<'_>>(commands, &[])?,
            torques: writer.channel::<Torques<'_>>(torques, &[])?,
            timing: writer.channel::<LoopTiming>(TIMING_TOPIC, &[])?,
            diagnostics: writer.channel::<Diagnostics<'_>>(DIAGNOSTICS_TOPIC, &[])?,
            robot: robot.transpose()?,
            patches,
        })
    }

    /// Writes the robot's fixed transforms and description, if known.
    pub fn write_robot(&mut self, window: &mut ReorderWindow, layout: &Layout, nanos: u64) {
        let (Some(robot), Some([_, still, description])) = (&layout.robot, &mut self.robot) else { return };
        window.write(still, nanos, &Transforms { nanos, transforms: &robot.fixed_transforms() });
        window.write(description, nanos, &StringMessage(&robot.description));
    }

    /// Writes a frame of a bus.
    pub fn write_frame(&mut self, window: &mut ReorderWindow, bus: usize, name: &str, seen: &LatchedFrame) {
        if let Some(channel) = self.can.get_mut(bus) {
            window.write(channel, seen.at_nanos, &frame_record(name, seen));
        }
    }

    /// Writes a frame that was latched when the file began, under the time `nanos`, at which the file begins. Its own
    /// time may be much earlier, and viewers would start there.
    pub fn write_latched_frame(
        &mut self,
        window: &mut ReorderWindow,
        nanos: u64,
        (bus, name): (usize, &str),
        seen: &LatchedFrame,
    ) {
        if let Some(channel) = self.state.get_mut(bus) {
            window.write_sorted_at(channel, nanos, seen.at_nanos, &frame_record(name, seen));
        }
    }

    /// Writes a note between frames. A note about a bus comes after the frames recorded from that bus.
    pub fn write_note(&mut self, window: &mut ReorderWindow, bus: Option<usize>, note: &CaptureNote<'_>) {
        let channel = bus.and_then(|bus| self.can.get(bus));
        let heard = channel.map(|channel| window.latest_ns(channel)).filter(|heard| *heard > 0);
        window.write_sorted_at(&mut self.notes, heard.unwrap_or(note.nanos), note.nanos, note);
    }

    /// Writes a control tick that was due at `nanos`.
    pub fn write_tick(
        &mut self,
        window: &mut ReorderWindow,
        layout: &Layout,
        nanos: u64,
        timed: &TimedRecord,
    ) {
        let names = &layout.joints;
        fn first_values(joints: usize, values: &[f64; MAX_ROBOT_JOINTS]) -> &[f64] {
            values.get(..joints).unwrap_or_default()
        }
        let record = &timed.record;
        let [position, velocity, effort, command] =
            [&record.q, &record.qdot, &record.torque, &record.command]
                .map(|values| first_values(names.len(), values));
        let state = JointState { nanos, names, position, velocity, effort };
        window.write(&mut self.joint_states, nanos, &state);
        let command = JointState { nanos, names, position, velocity: command, effort };
        window.write(&mut self.joint_commands, nanos, &command);
        let (central, active) = match &timed.central {
            Some((_, reference)) => (first_values(names.len(), &reference.torque), reference.active),
            None => (&[][..], 0),
        };
        window.write(&mut self.torques, nanos, &Torques { nanos, distributed: effort, central, active });
        window.write(&mut self.timing, nanos, &loop_timing(nanos, timed));
        if layout.records_poses_at(record.tick.number)
            && let (Some(robot), Some([moving, ..])) = (&layout.robot, &mut self.robot)
        {
            window.write(
                moving,
                nanos,
                &Transforms { nanos, transforms: &robot.moving_transforms(position) },
            );
        }
    }

    /// Writes the contact states of a patch's cells, and their points if the joint positions are given.
    pub fn write_patch(
        &mut self,
        window: &mut ReorderWindow,
        layout: &Layout,
        place: usize,
        touched: &EpochContacts,
        q: Option<&[f64; MAX_ROBOT_JOINTS]>,
        scratch: &mut (Vec<ContactState>, Vec<Point>),
    ) {
        let (Some(patch), Some([state, points])) = (layout.patches.get(place), self.patches.get_mut(place))
        else {
            return;
        };
        let Some(central) = layout.central.get(patch.bus) else { return };
        let (cells, cloud) = scratch;
        cells.clear();
        cells.extend(patch.cells.iter().map(|&(cell, node)| {
            let (sensors, status) = touched.cells.get(cell).copied().unwrap_or((None, CellStatus::Unknown));
            #[expect(clippy::cast_possible_truncation, reason = "words of 16 bits")]
            let (force, proximity) = sensors.map_or((f32::NAN, f32::NAN), |sensors| {
                (central.cell_force(cell, &sensors) as f32, sensors.proximity.to_f64() as f32)
            });
            ContactState { node, force, proximity, status: status.number() }
        }));
        let nanos = touched.at_nanos;
        let message = PatchState { nanos, frame_id: &patch.link, epoch: touched.epoch, cells };
        window.write(state, nanos, &message);
        let Some(q) = q else { return };
        let frames = central.frames_at_positions(&layout.chain_positions(patch.bus, q));
        cloud.clear();
        cloud.extend(cells.iter().zip(&patch.cells).map(|(state, &(cell, _))| {
            #[expect(clippy::cast_possible_truncation, reason = "metres with 7 digits")]
            let position = central.cell_position(cell, &frames).map(|metres| metres as f32);
            Point { position, force: state.force }
        }));
        window.write(points, nanos, &PointCloud { nanos, frame_id: layout.base_frame_name(), points: cloud });
    }

    /// Writes the diagnostics.
    pub fn write_diagnostics(&mut self, window: &mut ReorderWindow, nanos: u64, parts: &[Diagnosis]) {
        window.write(&mut self.diagnostics, nanos, &Diagnostics { nanos, parts });
    }
}

fn frame_record<'a>(interface: &'a str, seen: &LatchedFrame) -> Record<'a> {
    let time = Timestamp::with_nine_digits(seen.at_nanos);
    let direction = Some(if seen.from_gateway { Direction::Sent } else { Direction::Received });
    Record { time, interface, frame: seen.frame, direction }
}

fn loop_timing(nanos: u64, timed: &TimedRecord) -> LoopTiming {
    let record = &timed.record;
    #[expect(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
    let micros = |nanos: u64| nanos as f64 * 1e-3;
    LoopTiming {
        nanos,
        tick: record.tick.number,
        skipped: record.skipped,
        late_us: micros(timed.late_ns),
        took_us: micros(timed.took_ns),
        central_us: timed.central.map_or(0.0, |(nanos, _)| micros(nanos)),
        contributing: record.contributing,
        age: record.age,
        stale: record.stale,
        dead: record.dead,
        bad: match record.bad {
            None => 0,
            Some(BadCycle::Torque) => 1,
            Some(BadCycle::NoPeer) => 2,
            Some(BadCycle::NoAnswer) => 3,
            Some(BadCycle::Nonsense) => 4,
        },
        halted: match record.halted {
            None => 0,
            Some(Halt::BadCycles(_)) => 1,
            Some(Halt::Frame) => 2,
        },
        at_limit: record.moved.at_limit.to_le_bytes()[0],
        refused: record.moved.refused,
    }
}
