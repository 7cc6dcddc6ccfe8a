//! Counts the sensors frames of a cell, and the touches and releases in them.
//!
//! Sensors frames do not change the torques that the table expects; these follow from stimuli.

use protocol::message::SensorPage;
use protocol::parameters::Events;
use protocol::time::{Micros, Span};
use protocol::touch::{TouchState, contact_force};

/// Counts of the sensors frames of one cell.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SensorFrames {
    /// Number of frames.
    pub frames: u64,
    /// Number of touches: the contact rose to the threshold.
    pub touches: u64,
    /// Number of releases: the contact fell below the threshold minus the hysteresis.
    pub releases: u64,
    contact: TouchState,
    /// Number of frames that the cell sent without a report command.
    unrequested: u64,
    /// Arrival times of the first and the last frame that was sent without a report command.
    span: Option<(Micros, Micros)>,
    /// The pages that are still expected in answer to a report command: bit n for page n.
    requested: u8,
}

const MIN_RATE_FRAMES: u64 = 3;
/// Minimum time for a rate.
const MIN_RATE_SPAN: Span = Span::from_millis(1_000);

impl SensorFrames {
    /// Records a report command: the cell answers with one page of each kind at once.
    pub(super) const fn begin_report(&mut self) {
        self.requested = u8::MAX;
    }

    /// Ends the answer to a report command, because it is complete or its remaining pages were lost.
    pub(super) const fn end_report(&mut self) {
        self.requested = 0;
    }

    /// Records a sensors frame.
    pub(super) fn record_frame(&mut self, at: Micros, page: &SensorPage, events: &Events) {
        self.frames += 1;
        let bit = 1 << page.number();
        let is_requested = self.requested & bit != 0;
        self.requested &= !bit;
        if !is_requested {
            self.unrequested += 1;
            let (first, _) = *self.span.get_or_insert((at, at));
            self.span = Some((first, at));
        }
        let SensorPage::Skin(skin) = page else { return };
        let before = self.contact;
        self.contact = before.next(contact_force(skin), events.contact.to_bits(), events.hysteresis);
        self.touches += u64::from(before != TouchState::Touched && self.contact == TouchState::Touched);
        self.releases += u64::from(before == TouchState::Touched && self.contact != TouchState::Touched);
    }

    /// Records a restart: the cell is not in contact, and this does not count as a release.
    pub(super) const fn record_restart(&mut self) {
        self.contact = TouchState::Free;
    }

    /// Returns the rate in Hz of the frames sent without a report command, from the first to the last; `None` for fewer
    /// than three such frames or for less than a second.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
    pub fn rate_hz(&self) -> Option<f64> {
        let (first, last) = self.span?;
        let span = last.elapsed_since(first);
        let is_enough = self.unrequested >= MIN_RATE_FRAMES && span >= MIN_RATE_SPAN;
        is_enough.then(|| (self.unrequested - 1) as f64 / span.seconds())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::{Q3_12, Q5_10};
    use protocol::message::SkinSensors;

    fn after(steps: &[i16]) -> SensorFrames {
        let mut sensed = SensorFrames::default();
        for (&bits, ms) in steps.iter().zip(0..) {
            let contact = [Q5_10::from_bits(bits), Q5_10::ZERO, Q5_10::ZERO];
            let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
            sensed.record_frame(Micros(ms * 1_000), &page, &Events::default());
        }
        sensed
    }

    #[test]
    fn touches_and_releases_are_edges_and_not_frames() {
        let sensed = after(&[0, 101, 102, 300, 60, 51, 50, 30, 0, 200, 0]);
        assert_eq!((sensed.touches, sensed.releases, sensed.frames), (2, 2, 11));
        let mut sensed = after(&[500]);
        sensed.record_restart();
        assert_eq!((sensed.touches, sensed.releases), (1, 0), "no release was reported");
    }

    #[test]
    fn a_rate_needs_three_frames_and_a_second_and_pages_of_either_kind_count() {
        let rate = |times_us: &[u64]| {
            let mut sensed = SensorFrames::default();
            for (&at, page) in times_us.iter().zip([skin(), ACCELERATION].iter().cycle()) {
                sensed.record_frame(Micros(at), page, &Events::default());
            }
            sensed.rate_hz()
        };
        let none = [&[][..], &[0], &[0, 1], &[0, 2_000_000], &[0, 1, 2], &[0, 1, 999_999]];
        assert_eq!(none.map(rate), [None; 6]);
        assert!(rate(&[0, 1, 1_000_000]).is_some_and(|hz| (hz - 2.0).abs() < 1e-9));
        assert!(rate(&[7, 500_007, 900_007, 2_000_007]).is_some_and(|hz| (hz - 1.5).abs() < 1e-9));
    }

    #[test]
    fn answers_to_reports_make_no_rate_and_are_frames() {
        let mut sensed = SensorFrames::default();
        for second in 0..10 {
            let at = Micros(second * 1_000_000);
            sensed.begin_report();
            sensed.record_frame(at, &skin(), &Events::default());
            sensed.record_frame(Micros(at.0 + 1), &ACCELERATION, &Events::default());
        }
        assert_eq!((sensed.rate_hz(), sensed.frames), (None, 20));
        // The acceleration of the answer was lost, and the next one does not belong to it.
        sensed.begin_report();
        sensed.record_frame(Micros(0), &skin(), &Events::default());
        sensed.end_report();
        for at in [0, 1_000_000, 2_000_000] {
            sensed.record_frame(Micros(at), &ACCELERATION, &Events::default());
        }
        assert!(sensed.rate_hz().is_some_and(|hz| (hz - 1.0).abs() < 1e-9));
    }

    const ACCELERATION: SensorPage = SensorPage::Acceleration([Q3_12::ZERO; 3]);

    fn skin() -> SensorPage {
        SensorPage::Skin(SkinSensors::default())
    }
}
