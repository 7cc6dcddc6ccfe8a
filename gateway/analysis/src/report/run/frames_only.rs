//! Reports on captures with frames only, such as a candump log. The series come from the joints and torques on the
//! buses, because the topics of the control loop are missing.

use std::path::{Path, PathBuf};

use protocol::skin::Skin;

use super::bus_figures::{BusFigures, FrameEffect};
use super::motion::{HALTED, RESUMED, TickSeries};

/// A capture with frames only, as far as it has been read.
#[derive(Debug)]
pub(super) struct FramesOnlyCapture {
    /// Kind of the capture for use in a sentence, without article: `candump log`.
    pub(super) format: &'static str,
    /// The file of the skin.
    pub(super) skin_file: PathBuf,
    /// The bus whose joints determine the times of the series, as an index into the skin's buses.
    clock: Option<usize>,
    is_halted: bool,
    /// Time of the last frame, in s after the first.
    end: f64,
    /// Time of the first frame in ns since 1970.
    pub(super) began: Option<u64>,
}

impl FramesOnlyCapture {
    pub(super) fn new(is_log: bool, skin_file: &Path) -> Self {
        let format = if is_log { "candump log" } else { "MCAP file of another program" };
        let skin_file = skin_file.to_owned();
        Self { format, skin_file, clock: None, is_halted: false, end: 0.0, began: None }
    }

    /// Handles a frame on one of the skin's buses; `effect` is its effect on the series.
    pub(super) fn receive_frame(
        &mut self,
        (at, bus, effect): (f64, usize, Option<FrameEffect>),
        (skin, bus_figures): (&Skin, &[BusFigures]),
        motion: &mut TickSeries,
    ) {
        self.end = self.end.max(at);
        match effect {
            Some(FrameEffect::Joints(positions)) => {
                motion.first.get_or_insert(at);
                if *self.clock.get_or_insert(bus) == bus {
                    add_bus_sums(at, skin, bus_figures, motion);
                }
                for ((joint, _), position) in skin.joints_on_bus(bus).zip(positions) {
                    // The buses of all its chains broadcast a joint of several chains.
                    let owner = (0..bus_figures.len()).find(|bus| {
                        let has_joints = bus_figures.get(*bus).is_some_and(|it| it.joints.is_some());
                        has_joints && skin.joints_on_bus(*bus).any(|(it, _)| it == joint)
                    });
                    if let Some(line) = motion.position.get_mut(joint).filter(|_| owner == Some(bus)) {
                        line.push(at, position);
                    }
                }
            }
            Some(FrameEffect::Halted(is_halted))
                if std::mem::replace(&mut self.is_halted, is_halted) != is_halted =>
            {
                motion.record_change(at, if is_halted { HALTED } else { RESUMED });
            }
            Some(FrameEffect::Halted(_)) | None => {}
        }
    }

    /// Ends the capture: sets the time that the series cover, from the first joints to the last frame.
    pub(super) fn finish(&self, motion: &mut TickSeries) {
        motion.first.get_or_insert(0.0);
        motion.last = self.end;
    }

    /// Returns the parts of the report that this capture cannot have, as list items.
    pub(super) fn missing_parts(&self, bus_figures: &[BusFigures], motion: &TickSeries) -> Vec<&'static str> {
        let has_joints = bus_figures.iter().any(|it| it.joints.is_some());
        let compared = bus_figures.iter().any(|it| {
            let accuracy = it.table.accuracy();
            accuracy.single.count() + accuracy.sums.count() > 0
        });
        let has_torque = motion.distributed.iter().any(|line| line.points().iter().any(|(_, y)| *y != 0.0));
        let all = [
            (!has_joints, "joints messages, and therefore no torques or replies"),
            (has_torque && !compared, "stimuli or sensors, and therefore no central torques"),
            (true, "joint velocities"),
            (true, "ticks and cycle times"),
            (true, "the scenario"),
            (true, "the command, program and machine of the run"),
        ];
        all.into_iter().filter(|(is_missing, _)| *is_missing).map(|(_, what)| what).collect()
    }
}

/// Adds to the series the sums of all buses from before the joints at `at`.
fn add_bus_sums(at: f64, skin: &Skin, bus_figures: &[BusFigures], motion: &mut TickSeries) {
    let mut torque = vec![0.0; motion.distributed.len()];
    let (mut contributing, mut active) = (0, Some(0));
    for (bus, figures) in bus_figures.iter().enumerate() {
        for ((joint, _), of_bus) in skin.joints_on_bus(bus).zip(figures.received.before.torque) {
            if let Some(torque) = torque.get_mut(joint) {
                *torque += of_bus;
            }
        }
        contributing += figures.received.before.contributing;
        active = active.zip(figures.received.in_contact).map(|(sum, of_bus)| sum + of_bus);
    }
    motion.distributed.iter_mut().zip(torque).for_each(|(line, torque)| line.push(at, torque));
    motion.contributing.push(at, contributing.into());
    motion.active.push(at, active.map_or(f64::NAN, f64::from));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halts_are_turns_and_a_repeated_one_is_none() {
        let skin = model::testing::one_cell_skin();
        let mut motion = TickSeries::new(6);
        let mut frames_only = FramesOnlyCapture::new(true, Path::new("skin.toml"));
        for (at, is_halted) in [(1.0, true), (1.1, true), (2.0, false), (3.0, false)] {
            frames_only.receive_frame(
                (at, 0, Some(FrameEffect::Halted(is_halted))),
                (&skin, &[]),
                &mut motion,
            );
        }
        frames_only.finish(&mut motion);
        assert_eq!(motion.changes, [(1.0, "halted"), (2.0, "resumed")]);
        assert_eq!(motion.halts, (1, Some(1.0)));
        assert!((motion.duration_s() - 3.0).abs() < 1e-9);
        let missing = frames_only.missing_parts(&[], &motion);
        assert_eq!(missing.first(), Some(&"joints messages, and therefore no torques or replies"));
    }
}
