//! Sensors frames of a cell: their rate, and the touches and releases in them.
//!
//! Nothing here affects the torques that the table expects: those follow from stimuli.

use protocol::message::SensorPage;
use protocol::parameters::Events;
use protocol::time::Micros;
use protocol::touch::{Touch, contact};

/// The sensors frames of one cell.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Sensed {
    /// How many came.
    pub frames: u64,
    /// Touches: contact rose to its threshold.
    pub touches: u64,
    /// Releases: contact fell below the threshold less hysteresis.
    pub releases: u64,
    contact: Touch,
    /// When the first and the last came.
    span: Option<(Micros, Micros)>,
}

impl Sensed {
    /// A sensors frame came.
    pub(super) fn hear(&mut self, at: Micros, page: &SensorPage, events: &Events) {
        self.frames += 1;
        let (first, _) = *self.span.get_or_insert((at, at));
        self.span = Some((first, at));
        let SensorPage::Skin(skin) = page else { return };
        let before = self.contact;
        self.contact = before.next(contact(skin), events.contact.to_bits(), events.hysteresis);
        self.touches += u64::from(before != Touch::Touched && self.contact == Touch::Touched);
        self.releases += u64::from(before == Touch::Touched && self.contact != Touch::Touched);
    }

    /// The cell restarted: it is not in contact, and no release is counted.
    pub(super) const fn restart(&mut self) {
        self.contact = Touch::Free;
    }

    /// Frames a second, from the first to the last; none of less than two.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
    pub fn rate_hz(&self) -> Option<f64> {
        let (first, last) = self.span?;
        let span = last.since(first).0;
        (span > 0).then(|| (self.frames - 1) as f64 * 1e6 / span as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::{Q3_12, Q5_10};
    use protocol::message::SkinSensors;

    fn after(steps: &[i16]) -> Sensed {
        let mut sensed = Sensed::default();
        for (&bits, ms) in steps.iter().zip(0..) {
            let contact = [Q5_10::from_bits(bits), Q5_10::ZERO, Q5_10::ZERO];
            let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
            sensed.hear(Micros(ms * 1_000), &page, &Events::default());
        }
        sensed
    }

    #[test]
    fn touches_and_releases_are_edges_and_not_frames() {
        let sensed = after(&[0, 101, 102, 300, 60, 51, 50, 30, 0, 200, 0]);
        assert_eq!((sensed.touches, sensed.releases, sensed.frames), (2, 2, 11));
        let mut sensed = after(&[500]);
        sensed.restart();
        assert_eq!((sensed.touches, sensed.releases), (1, 0), "no release was reported");
    }

    #[test]
    fn a_rate_needs_two_frames_and_pages_of_either_kind_count() {
        assert_eq!(after(&[]).rate_hz(), None);
        let mut sensed = after(&[0]);
        assert_eq!(sensed.rate_hz(), None);
        sensed.hear(Micros(4_000), &SensorPage::Acceleration([Q3_12::ZERO; 3]), &Events::default());
        assert!(sensed.rate_hz().is_some_and(|hz| (hz - 250.0).abs() < 1e-9));
    }
}
