//! The sensor values of a cell, and stimuli that replace them from a later epoch on.
//!
//! A stimulus is latched with the joints of its epoch instead of on arrival. A torque thus depends on the joints frame
//! that it answers, and not on the order of other frames on the bus.

use heapless::Vec;
use protocol::message::{SensorPage, SensorReadings, StimulusStart};
use protocol::packet::Epoch;

/// Maximum number of stimuli that wait for their epoch.
pub const MAX_PENDING_STIMULI: usize = 8;

/// The result of receiving a stimulus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum StimulusOutcome {
    /// The stimulus waits for the joints of its epoch.
    InTime,
    /// The joints of its epoch have already been accepted. The stimulus waits for the next joints.
    Late,
    /// The queue is full, and the stimulus is dropped.
    Refused,
}

/// The simulated sensors of a cell in test mode.
#[derive(Debug, Default)]
pub(super) struct Stimuli {
    pending: Vec<(StimulusStart, SensorPage), MAX_PENDING_STIMULI>,
    /// The present contact state.
    pub(super) sensed: SensorReadings,
}

impl Stimuli {
    /// Queues a stimulus that applies from the given joints on. `last` is the epoch of the last joints that the cell
    /// accepted.
    pub(super) fn push_stimulus(
        &mut self,
        from: StimulusStart,
        page: SensorPage,
        last: Option<Epoch>,
    ) -> StimulusOutcome {
        let (from, arrival) = match (from, last) {
            (StimulusStart::Epoch(first), Some(last)) if last.epochs_since(first) >= 0 => {
                (StimulusStart::Next, StimulusOutcome::Late)
            }
            (from @ (StimulusStart::Epoch(_) | StimulusStart::Next), _) => (from, StimulusOutcome::InTime),
        };
        if self.pending.push((from, page)).is_ok() { arrival } else { StimulusOutcome::Refused }
    }

    /// Applies all stimuli for `epoch` or earlier epochs, in order of arrival.
    pub(super) fn apply_stimuli_until(&mut self, epoch: Epoch) {
        self.pending.retain(|(from, page)| {
            let waits = matches!(from, StimulusStart::Epoch(first) if epoch.epochs_since(*first) < 0);
            if !waits {
                self.sensed.set_page(page);
            }
            waits
        });
    }

    /// Returns true if stimuli wait for their epoch.
    pub(super) fn has_pending(&self) -> bool {
        !self.pending.is_empty()
    }

    /// Empties the queue and sets all sensor values to those of an untouched cell.
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q5_10;
    use protocol::message::SkinSensors;

    fn press(newtons: f64) -> SensorPage {
        SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() })
    }

    fn sensed(stimuli: &Stimuli) -> f64 {
        stimuli.sensed.skin.contact[0].to_f64()
    }

    // STIM-3
    #[test]
    fn a_stimulus_waits_for_its_epoch_even_around_the_corner() {
        let mut stimuli = Stimuli::default();
        let last = Some(Epoch(253));
        assert_eq!(
            stimuli.push_stimulus(StimulusStart::Epoch(Epoch(1)), press(2.0), last),
            StimulusOutcome::InTime
        );
        assert_eq!(
            stimuli.push_stimulus(StimulusStart::Epoch(Epoch(255)), press(1.0), last),
            StimulusOutcome::InTime
        );
        let course = [254, 255, 0, 1, 2].map(|epoch| {
            stimuli.apply_stimuli_until(Epoch(epoch));
            sensed(&stimuli)
        });
        assert!(course.iter().eq(&[0.0, 1.0, 1.0, 2.0, 2.0]), "{course:?}");
    }

    // STIM-5
    #[test]
    fn a_late_stimulus_holds_from_the_next_joints() {
        let mut stimuli = Stimuli::default();
        stimuli.apply_stimuli_until(Epoch(7));
        assert_eq!(
            stimuli.push_stimulus(StimulusStart::Epoch(Epoch(7)), press(1.0), Some(Epoch(7))),
            StimulusOutcome::Late
        );
        assert!(sensed(&stimuli) < 0.5, "not before the next joints");
        stimuli.apply_stimuli_until(Epoch(40));
        assert!(sensed(&stimuli) > 0.5);
    }

    // STIM-6
    #[test]
    fn the_ninth_waiting_stimulus_is_refused() {
        let mut stimuli = Stimuli::default();
        for _ in 0..MAX_PENDING_STIMULI {
            assert_eq!(stimuli.push_stimulus(StimulusStart::Next, press(1.0), None), StimulusOutcome::InTime);
        }
        assert_eq!(stimuli.push_stimulus(StimulusStart::Next, press(1.0), None), StimulusOutcome::Refused);
    }
}
