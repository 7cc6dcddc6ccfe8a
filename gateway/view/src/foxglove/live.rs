//! The topics of live buses, from the frames that this program receives: those of a recording, except the ones that only
//! the control loop can fill (joint commands and timing).

use std::io;

use bench::bus::listen::now;
use bench::record::feed::EpochContacts;
use bench::record::topics::{BusHealth, Topics};
use protocol::can::Frame;
use protocol::candump::{Record, Timestamp};
use protocol::skin::{MAX_ROBOT_JOINTS, Skin};
use trace::capture::{CaptureNote, NoteKind};
use trace::recording::layout::Layout;
use trace::recording::robot::RecordedRobot;
use trace::ros2::skin::{ContactState, Torques};
use trace::ros2::standard::{JointState, Point};

use super::hub::HubSink;
use super::server::FoxgloveServer;
use crate::live::LiveState;

/// The interval between diagnostics messages, in µs.
const DIAGNOSTICS_INTERVAL_US: u64 = 500_000;

/// Figures of one bus.
#[derive(Clone, Copy, Debug, Default)]
struct BusProgress {
    /// The number of the joints for which contacts were published last.
    newest: Option<u64>,
    epochs: u64,
    frames: u64,
    dropped: u64,
}

/// Publishes the topics of live buses.
#[derive(Debug)]
pub(crate) struct LiveTopics {
    sink: HubSink,
    topics: Topics,
    layout: Layout,
    buses: Vec<BusProgress>,
    diagnosed_us: u64,
    scratch: (Vec<ContactState>, Vec<Point>),
}

impl LiveTopics {
    /// Announces the topics of a skin and its robot to the viewers of a server.
    ///
    /// # Errors
    /// Returns an error if there are too many topics.
    pub(crate) fn new(
        server: &FoxgloveServer,
        skin: &Skin,
        robot: Option<RecordedRobot>,
    ) -> io::Result<Self> {
        let layout = Layout::new(skin);
        let layout = match robot {
            Some(robot) => layout.with_robot(robot),
            None => layout,
        };
        let mut sink = HubSink::new(server.hub());
        let mut topics = Topics::for_frames(&mut sink, &layout)?;
        topics.write_robot(&mut sink, &layout, now().0 * 1_000);
        let buses = vec![BusProgress::default(); layout.buses.len()];
        Ok(Self { sink, topics, layout, buses, diagnosed_us: 0, scratch: Default::default() })
    }

    /// Publishes a frame of a bus.
    pub(crate) fn publish_frame(&mut self, bus: usize, at_nanos: u64, frame: &Frame) {
        let (Some(name), Some(seen)) = (self.layout.buses.get(bus), self.buses.get_mut(bus)) else { return };
        seen.frames += 1;
        // A receiver cannot know which node has sent a frame.
        let time = Timestamp::with_nine_digits(at_nanos);
        let record = Record { time, interface: name, frame: *frame, direction: None };
        self.topics.write_record(&mut self.sink, bus, &record);
    }

    /// Publishes what follows from all frames of a bus so far: contacts and joints once per epoch, and dropped frames.
    pub(crate) fn publish_state(&mut self, bus: usize, live: &LiveState, dropped: u64) {
        self.publish_dropped_frames(bus, dropped);
        let Some((number, contacts)) = live.newest_contacts(bus) else { return };
        let Some(seen) = self.buses.get_mut(bus) else { return };
        if seen.newest.replace(number) == Some(number) {
            return;
        }
        let has_cloud = seen.epochs.is_multiple_of(self.layout.epochs_per_cloud);
        seen.epochs += 1;
        let joints = live.joint_positions_and_torques();
        let mut q = [0.0; MAX_ROBOT_JOINTS];
        q.iter_mut().zip(drawn_positions(&joints)).for_each(|(q, position)| *q = position);
        if live.is_clock(bus) {
            self.publish_joints(&contacts, live, &joints);
        }
        let Self { sink, topics, layout, scratch, .. } = self;
        let patches = layout.patches.iter().enumerate().filter(|(_, patch)| patch.bus == bus);
        for (place, _) in patches {
            topics.write_patch(sink, layout, place, &contacts, has_cloud.then_some(&q), scratch);
        }
    }

    /// Publishes the joints of an epoch, with the torques of the last completed one.
    fn publish_joints(&mut self, contacts: &EpochContacts, live: &LiveState, joints: &[[f64; 3]]) {
        let Self { sink, topics, layout, .. } = self;
        let nanos = contacts.at_nanos;
        let column = |place: fn(&[f64; 3]) -> f64| joints.iter().map(place).collect::<Vec<_>>();
        let position = column(|[position, ..]| *position);
        let [mut effort, mut central] = [column(|[_, effort, _]| *effort), column(|[.., central]| *central)];
        // Joints whose buses have not completed an epoch are NaN in both.
        if joints.iter().any(|[_, effort, central]| central.is_nan() && !effort.is_nan()) {
            central.clear();
        }
        if effort.iter().all(|torque| torque.is_nan()) {
            effort.clear();
        }
        let names = &layout.joints;
        let state = JointState { nanos, names, position: &position, velocity: &[], effort: &effort };
        topics.write_joint_states(sink, &state);
        let active = u32::try_from(live.active_cell_count()).unwrap_or(u32::MAX);
        if !effort.is_empty() {
            topics.write_torques(sink, &Torques { nanos, distributed: &effort, central: &central, active });
        }
        topics.write_poses(sink, layout, nanos, &drawn_positions(joints).collect::<Vec<_>>());
    }

    fn publish_dropped_frames(&mut self, bus: usize, dropped: u64) {
        let Self { sink, topics, layout, buses, .. } = self;
        let (Some(name), Some(seen)) = (layout.buses.get(bus), buses.get_mut(bus)) else { return };
        let frames = dropped.saturating_sub(std::mem::replace(&mut seen.dropped, dropped));
        if frames > 0 {
            let text =
                format!("DROPCOUNT: dropped {frames} CAN frames on '{name}' socket (total drops {dropped})");
            let (nanos, kind) = (now().0 * 1_000, NoteKind::Dropped(frames));
            let note = CaptureNote { kind, nanos, interface: name, line: 0, text: text.as_bytes() };
            topics.write_note(sink, Some(bus), &note);
        }
    }

    /// Publishes the diagnostics of all buses, if it is time.
    pub(crate) fn publish_diagnostics(&mut self, live: &LiveState) {
        let at = now();
        if at.0.saturating_sub(self.diagnosed_us) < DIAGNOSTICS_INTERVAL_US {
            return;
        }
        self.diagnosed_us = at.0;
        let buses = self.layout.buses.iter().zip(&self.buses).enumerate();
        let parts: Vec<_> = buses
            .map(|(bus, (name, seen))| {
                let (works, cells, silent) = live.bus_health(bus, at);
                let BusProgress { frames, dropped, .. } = *seen;
                BusHealth { works, cells, silent, frames, dropped }.diagnosis(name)
            })
            .collect();
        self.topics.write_diagnostics(&mut self.sink, at.0 * 1_000, &parts);
    }
}

/// Returns the joint positions for drawing: 0 for one that is unknown.
fn drawn_positions(joints: &[[f64; 3]]) -> impl Iterator<Item = f64> {
    joints.iter().map(|[position, ..]| if position.is_nan() { 0.0 } else { *position })
}

#[cfg(test)]
mod tests {
    use super::drawn_positions;

    #[test]
    fn links_of_joints_with_unknown_positions_are_drawn_as_at_0() {
        let joints = [[0.5, 1.0, 1.0], [f64::NAN; 3], [-0.25, f64::NAN, f64::NAN]];
        assert_eq!(drawn_positions(&joints).collect::<Vec<_>>(), [0.5, 0.0, -0.25]);
    }
}
