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
use trace::recording::message_sink::{ChannelSink, MessageSink};
use trace::ros2::robot::{StringMessage, Transforms};
use trace::ros2::skin::{ContactState, LoopTiming, PatchState, Torques};
use trace::ros2::standard::{Diagnosis, DiagnosisLevel, Diagnostics, JointState, Point, PointCloud};
use trace::ros2::topic::{LATCHED_QOS, QOS_KEY};

/// The metadata of latched topics.
const LATCHED: (&str, &str) = (QOS_KEY, LATCHED_QOS);
const TIMING_TOPIC: &str = "/gateway/timing";
const DIAGNOSTICS_TOPIC: &str = "/diagnostics";
const TF_TOPIC: &str = "/tf";
const TF_STATIC_TOPIC: &str = "/tf_static";
const ROBOT_DESCRIPTION_TOPIC: &str = "/robot_description";

/// Number of messages that [`Topics::write_robot`] writes.
pub const ROBOT_MESSAGE_COUNT: u64 = 2;

/// Channels of one file, or of the viewers that are connected.
#[derive(Debug)]
pub struct Topics {
    can: Vec<Channel>,
    state: Vec<Channel>,
    notes: Channel,
    joint_states: Channel,
    torques: Channel,
    diagnostics: Channel,
    /// Channels of the control loop: joint commands and timing. Frames do not show them.
    control: Option<[Channel; 2]>,
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
    pub fn new(writer: &mut impl ChannelSink, layout: &Layout) -> io::Result<Self> {
        let mut topics = Self::for_frames(writer, layout)?;
        let [_, state] = bus_topics(layout);
        topics.state = add_frame_channels(writer, &state)?;
        let [_, commands, _] = arm_topics(layout);
        topics.control = Some([
            writer.add_channel::<JointState<'_>>(&commands, &[])?,
            writer.add_channel::<LoopTiming>(TIMING_TOPIC, &[])?,
        ]);
        Ok(topics)
    }

    /// Creates the channels that a program can fill which only receives the frames of the buses.
    ///
    /// # Errors
    /// Returns [`io::Error`] if the file cannot be written.
    pub fn for_frames(writer: &mut impl ChannelSink, layout: &Layout) -> io::Result<Self> {
        let [can, _] = bus_topics(layout);
        let can = add_frame_channels(writer, &can)?;
        let patches = layout.patches.iter().map(|Patch { topic, .. }| {
            let state = writer.add_channel::<PatchState<'_>>(topic, &[])?;
            Ok([state, writer.add_channel::<PointCloud<'_>>(&format!("{topic}/points"), &[])?])
        });
        let patches = patches.collect::<io::Result<_>>()?;
        let robot = layout.robot.is_some().then(|| {
            let moving = writer.add_channel::<Transforms<'_>>(TF_TOPIC, &[])?;
            let still = writer.add_channel::<Transforms<'_>>(TF_STATIC_TOPIC, &[LATCHED])?;
            Ok::<_, io::Error>([
                moving,
                still,
                writer.add_channel::<StringMessage<'_>>(ROBOT_DESCRIPTION_TOPIC, &[LATCHED])?,
            ])
        });
        let [states, _, torques] = arm_topics(layout);
        Ok(Self {
            can,
            state: Vec::new(),
            notes: writer.add_channel::<CaptureNote<'_>>(NOTES_TOPIC, &[])?,
            joint_states: writer.add_channel::<JointState<'_>>(&states, &[])?,
            torques: writer.add_channel::<Torques<'_>>(&torques, &[])?,
            diagnostics: writer.add_channel::<Diagnostics<'_>>(DIAGNOSTICS_TOPIC, &[])?,
            control: None,
            robot: robot.transpose()?,
            patches,
        })
    }

    /// Writes the robot's fixed transforms and description, if known.
    pub fn write_robot(&mut self, window: &mut impl MessageSink, layout: &Layout, nanos: u64) {
        let (Some(robot), Some([_, still, description])) = (&layout.robot, &mut self.robot) else { return };
        window.write(still, nanos, &Transforms { nanos, transforms: &robot.fixed_transforms() });
        window.write(description, nanos, &StringMessage(&robot.description));
    }

    /// Writes a frame of a bus.
    pub fn write_frame(
        &mut self,
        window: &mut impl MessageSink,
        bus: usize,
        name: &str,
        seen: &LatchedFrame,
    ) {
        self.write_record(window, bus, &frame_record(name, seen));
    }

    /// Writes a frame of a bus, whose sender may be unknown.
    pub fn write_record(&mut self, window: &mut impl MessageSink, bus: usize, record: &Record<'_>) {
        if let Some(channel) = self.can.get_mut(bus) {
            window.write(channel, record.time.nanos, record);
        }
    }

    /// Writes a frame that was latched when the file began, under the time `nanos`, at which the file begins. Its own
    /// time may be much earlier, and viewers would start there.
    pub fn write_latched_frame(
        &mut self,
        window: &mut impl MessageSink,
        nanos: u64,
        (bus, name): (usize, &str),
        seen: &LatchedFrame,
    ) {
        if let Some(channel) = self.state.get_mut(bus) {
            window.write_sorted_at(channel, nanos, seen.at_nanos, &frame_record(name, seen));
        }
    }

    /// Writes a note between frames. A note about a bus comes after the frames recorded from that bus.
    pub fn write_note(&mut self, window: &mut impl MessageSink, bus: Option<usize>, note: &CaptureNote<'_>) {
        let channel = bus.and_then(|bus| self.can.get(bus));
        let heard = channel.map(|channel| window.latest_ns(channel)).filter(|heard| *heard > 0);
        window.write_sorted_at(&mut self.notes, heard.unwrap_or(note.nanos), note.nanos, note);
    }

    /// Writes a control tick that was due at `nanos`.
    pub fn write_tick(
        &mut self,
        window: &mut impl MessageSink,
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
        self.write_joint_states(window, &state);
        if let Some([commands, _]) = &mut self.control {
            let command = JointState { nanos, names, position, velocity: command, effort };
            window.write(commands, nanos, &command);
        }
        let (central, active) = match &timed.central {
            Some((_, reference)) => (first_values(names.len(), &reference.torque), reference.active),
            None => (&[][..], 0),
        };
        self.write_torques(window, &Torques { nanos, distributed: effort, central, active });
        if let Some([_, timing]) = &mut self.control {
            window.write(timing, nanos, &loop_timing(nanos, timed));
        }
        if layout.records_poses_at(record.tick.number) {
            self.write_poses(window, layout, nanos, position);
        }
    }

    /// Writes the state of the joints.
    pub fn write_joint_states(&mut self, window: &mut impl MessageSink, state: &JointState<'_>) {
        window.write(&mut self.joint_states, state.nanos, state);
    }

    /// Writes the distributed and the central torques.
    pub fn write_torques(&mut self, window: &mut impl MessageSink, torques: &Torques<'_>) {
        window.write(&mut self.torques, torques.nanos, torques);
    }

    /// Writes the poses of the links that joints move, if the robot is known.
    pub fn write_poses(
        &mut self,
        window: &mut impl MessageSink,
        layout: &Layout,
        nanos: u64,
        position: &[f64],
    ) {
        if let (Some(robot), Some([moving, ..])) = (&layout.robot, &mut self.robot) {
            let transforms = &robot.moving_transforms(position);
            window.write(moving, nanos, &Transforms { nanos, transforms });
        }
    }

    /// Writes the contact states of a patch's cells, and their points if the joint positions are given.
    pub fn write_patch(
        &mut self,
        window: &mut impl MessageSink,
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
    pub fn write_diagnostics(&mut self, window: &mut impl MessageSink, nanos: u64, parts: &[Diagnosis]) {
        window.write(&mut self.diagnostics, nanos, &Diagnostics { nanos, parts });
    }
}

/// State of a bus, from which its diagnosis is made.
#[derive(Clone, Copy, Debug)]
pub struct BusHealth {
    /// True if the bus is open and works.
    pub works: bool,
    /// Number of cells on the bus.
    pub cells: usize,
    /// Number of cells that send nothing.
    pub silent: usize,
    /// Number of frames received.
    pub frames: u64,
    /// Number of frames dropped.
    pub dropped: u64,
}

impl BusHealth {
    /// Returns the diagnosis of the bus with this name.
    #[must_use]
    pub fn diagnosis(self, name: &str) -> Diagnosis {
        let Self { works, cells, silent, frames, dropped } = self;
        let (level, message) = match (works, silent, dropped) {
            (false, _, _) => (DiagnosisLevel::Error, "the bus does not work"),
            (true, 0, 0) => (DiagnosisLevel::Ok, "all cells are present"),
            (true, 0, _) => (DiagnosisLevel::Warn, "frames were dropped"),
            (true, _, _) => (DiagnosisLevel::Warn, "cells are silent"),
        };
        Diagnosis {
            level,
            name: format!("gateway: bus {name}"),
            message: message.to_owned(),
            values: vec![
                ("cells", cells.to_string()),
                ("silent", silent.to_string()),
                ("frames", frames.to_string()),
                ("dropped", dropped.to_string()),
            ],
        }
    }
}

/// Returns the topics of the robot's joints: states, commands and torques.
fn arm_topics(layout: &Layout) -> [String; 3] {
    ["joint_states", "joint_commands", "torques"].map(|topic| format!("/{}/{topic}", layout.arm))
}

/// Returns the topics of each bus: of its frames, and of frames that were latched before.
fn bus_topics(layout: &Layout) -> [Vec<String>; 2] {
    let fixed =
        [NOTES_TOPIC, TIMING_TOPIC, DIAGNOSTICS_TOPIC, TF_TOPIC, TF_STATIC_TOPIC, ROBOT_DESCRIPTION_TOPIC];
    layout.bus_topics(fixed.map(str::to_owned).into_iter().chain(arm_topics(layout)))
}

fn add_frame_channels(writer: &mut impl ChannelSink, topics: &[String]) -> io::Result<Vec<Channel>> {
    let digits = [("time_digits", "9")];
    topics.iter().map(|topic| writer.add_channel::<Record<'_>>(topic, &digits)).collect()
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
