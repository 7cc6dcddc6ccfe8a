//! The contact state of a cell in test mode, by the protocol's rules: stimuli that wait for their epochs, and latched
//! ones. It is independent of the cells' code, so that each is an oracle of the other.

use protocol::fixed::Q3_12;
use protocol::message::{From, SensorPage, SkinSensors};
use protocol::packet::Epoch;

/// How many stimuli may wait in a cell.
pub const PENDING: usize = 8;

/// The contact state of one cell. With each stimulus the reader keeps a `T`: when it came, or in which frames.
#[derive(Clone, Debug)]
pub struct Contact<T> {
    waiting: Vec<(From, SensorPage, T)>,
    skin: Option<(SkinSensors, T)>,
    acceleration: Option<([Q3_12; 3], T)>,
    obeys: Option<bool>,
}

impl<T> Default for Contact<T> {
    fn default() -> Self {
        Self { waiting: Vec::new(), skin: None, acceleration: None, obeys: None }
    }
}

impl<T> Contact<T> {
    /// Takes a stimulus, unless the cell measures or too many wait; `last` is the epoch of the last joints.
    pub fn push(&mut self, from: From, page: SensorPage, tag: T, last: Option<Epoch>) {
        if self.obeys != Some(false) && self.waiting.len() < PENDING {
            self.waiting.push((if is_late(from, last) { From::Next } else { from }, page, tag));
        }
    }

    /// Latches the stimuli for the joints of this epoch; the newest of each page counts. Each is passed to `latched`.
    pub fn latch(&mut self, epoch: Epoch, mut latched: impl FnMut(&mut T)) {
        let is_due = move |(from, _, _): &mut (From, SensorPage, T)| match from {
            From::Next => true,
            From::Epoch(first) => epoch.since(*first) >= 0,
        };
        for (_, page, mut tag) in self.waiting.extract_if(.., is_due) {
            latched(&mut tag);
            match page {
                SensorPage::Skin(skin) => self.skin = Some((skin, tag)),
                SensorPage::Acceleration(acceleration) => self.acceleration = Some((acceleration, tag)),
                SensorPage::Baseline(_) => {}
            }
        }
    }

    /// Takes the cell's own sensors page. It counts only while nothing else is known, because it may be older than the
    /// joints at which the cell latched the next stimulus.
    pub fn learn(&mut self, page: SensorPage, tag: T) {
        match page {
            SensorPage::Skin(skin) => _ = self.skin.get_or_insert((skin, tag)),
            SensorPage::Acceleration(acceleration) => {
                _ = self.acceleration.get_or_insert((acceleration, tag))
            }
            // What the cell computes with, and no reading.
            SensorPage::Baseline(_) => {}
        }
    }

    /// Its skin sensors, once they are known.
    #[must_use]
    pub const fn skin(&self) -> Option<&(SkinSensors, T)> {
        self.skin.as_ref()
    }

    /// All pages that are latched or known.
    pub fn latched(&self) -> impl Iterator<Item = (SensorPage, &T)> {
        let skin = self.skin.iter().map(|(skin, tag)| (SensorPage::Skin(*skin), tag));
        skin.chain(self.acceleration.iter().map(|(xyz, tag)| (SensorPage::Acceleration(*xyz), tag)))
    }

    /// The waiting stimuli in their order, each with the joints from which on it applies.
    #[must_use]
    pub fn waiting(&self) -> &[(From, SensorPage, T)] {
        &self.waiting
    }

    /// Clears the contact state and what waits: the cell has started, or its mode was written.
    pub fn reset(&mut self) {
        self.waiting.clear();
        (self.skin, self.acceleration) = (None, None);
    }

    /// Whether the cell obeys stimuli; `None` while that is not known, and then it is assumed.
    #[must_use]
    pub const fn obeys(&self) -> Option<bool> {
        self.obeys
    }

    /// The cell obeys stimuli, or measures, from now on.
    pub const fn set_obeys(&mut self, obeys: bool) {
        self.obeys = Some(obeys);
    }
}

/// Whether the joints from which a stimulus should apply have passed: then it applies from the next ones on. `last` is
/// the epoch of the last joints.
#[must_use]
pub fn is_late(from: From, last: Option<Epoch>) -> bool {
    matches!((from, last), (From::Epoch(first), Some(last)) if last.since(first) >= 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q5_10;

    fn press(newtons: f64) -> SensorPage {
        SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() })
    }

    fn latch(contact: &mut Contact<u64>, epoch: u8) -> Option<(f64, u64)> {
        contact.latch(Epoch(epoch), |_| {});
        contact.skin().map(|(skin, tag)| (skin.contact[0].to_f64(), *tag))
    }

    #[test]
    fn stimuli_wait_for_their_epoch_and_late_ones_for_the_next() {
        let mut contact = Contact::default();
        assert_eq!(latch(&mut contact, 253), None, "not known");
        contact.push(From::Epoch(Epoch(1)), press(2.0), 5, Some(Epoch(253)));
        contact.push(From::Epoch(Epoch(253)), press(1.0), 6, Some(Epoch(253)));
        assert_eq!(latch(&mut contact, 254), Some((1.0, 6)), "late, so from the next on");
        assert_eq!(latch(&mut contact, 0), Some((1.0, 6)));
        assert_eq!(latch(&mut contact, 1), Some((2.0, 5)));
        contact.reset();
        assert_eq!(latch(&mut contact, 2), None);
    }

    #[test]
    fn the_ninth_waiting_stimulus_is_refused_whatever_its_page() {
        let mut contact = Contact::default();
        for _ in 0..PENDING {
            contact.push(From::Next, SensorPage::Acceleration([Q3_12::ZERO; 3]), 0, None);
        }
        contact.push(From::Next, press(1.0), 0, None);
        assert_eq!(contact.waiting().len(), PENDING);
        assert_eq!(latch(&mut contact, 0), None);
        assert_eq!(contact.latched().count(), 1);
    }

    #[test]
    fn the_cells_own_page_counts_only_while_nothing_else_is_known() {
        let mut contact = Contact::default();
        contact.learn(press(3.0), 1);
        assert_eq!(latch(&mut contact, 0), Some((3.0, 1)));
        contact.push(From::Next, press(1.0), 2, None);
        assert_eq!(latch(&mut contact, 1), Some((1.0, 2)));
        contact.learn(press(3.0), 3);
        assert_eq!(latch(&mut contact, 2), Some((1.0, 2)), "an old page");
    }

    #[test]
    fn a_cell_that_measures_takes_no_stimuli() {
        let mut contact = Contact::default();
        assert_eq!(contact.obeys(), None);
        contact.set_obeys(false);
        assert_eq!(contact.obeys(), Some(false));
        contact.push(From::Next, press(1.0), 1, None);
        assert_eq!(latch(&mut contact, 0), None);
    }

    #[test]
    fn a_stimulus_is_late_at_its_own_joints_and_after_them() {
        let of = |first, last: Option<u8>| is_late(From::Epoch(Epoch(first)), last.map(Epoch));
        assert_eq!(
            [of(5, Some(4)), of(5, Some(5)), of(255, Some(1)), of(5, None)],
            [false, true, true, false]
        );
        assert!(!is_late(From::Next, Some(Epoch(5))));
    }
}
