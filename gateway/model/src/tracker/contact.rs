//! The contact state of a cell in test mode, by the protocol's rules: pending and latched stimuli. It is independent of
//! the cells' code, so that each can serve as the oracle of the other.
//!
//! A stimulus from before the start of the reader may still be pending in the cell, and no page of the cell reports it.
//! So the contact state is *known* only if every stimulus that can matter was received here:
//!
//! ```text
//!   a start; a confirmed write of the mode ───────────> the cell is free, with nothing pending
//!   as many stimuli counted by the cell as came here ─> those received here are all
//!   129 joints; then a stimulus, or the cell's page ──> earlier stimuli are latched and replaced
//! ```

use protocol::message::{SensorPage, SkinSensors, StimulusStart};
use protocol::packet::Epoch;

/// Maximum number of pending stimuli in a cell.
pub const MAX_PENDING_STIMULI: usize = 8;

/// The contact state of one cell, from its stimuli and its own pages. The caller attaches a `T` to each stimulus, such
/// as its time or its frames.
#[derive(Clone, Debug)]
pub struct ContactState<T> {
    pending: Vec<(StimulusStart, SensorPage, T)>,
    skin: Option<(SkinSensors, T)>,
    /// The other pages, by [`SensorPage::simulated_index`].
    others: [Option<(SensorPage, T)>; SensorPage::SIMULATED_PAGE_NAMES.len()],
    obeys: Option<bool>,
    /// True if `skin` reflects all stimuli that the cell has received.
    is_known: bool,
    unseen: UnseenStimuli,
    /// Number of stimuli that arrived here; `None` once their effect on the cell is uncertain.
    received_stimuli: Option<u16>,
    /// True if the cell has counted more stimuli than arrived here.
    has_missed_stimuli: bool,
    /// True if the mode was written and the cell has not confirmed the write.
    mode_pending: bool,
}

/// Stimuli from before the reader started that may be pending in the cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum UnseenStimuli {
    /// Stimuli for any epoch may be pending; no joints have arrived yet.
    Any,
    /// Stimuli for one of the `ahead` epochs after the epoch `last` may be pending.
    Ahead { last: Epoch, ahead: u8 },
    /// No such stimulus can be pending.
    None,
}

/// Half of the 256 epochs: a stimulus is pending for at most this many.
const HALF_OF_EPOCHS: u8 = 1 << 7;

impl UnseenStimuli {
    /// Removes the stimuli that the joints of an epoch latch: for this epoch, and for the half of all epochs before it.
    fn remove_latched_stimuli(&mut self, epoch: Epoch) {
        *self = match *self {
            Self::None => Self::None,
            Self::Any => Self::Ahead { last: epoch, ahead: HALF_OF_EPOCHS },
            Self::Ahead { last, ahead } => {
                match u8::try_from(i32::from(ahead) - i32::from(epoch.epochs_since(last))).unwrap_or(0) {
                    0 => Self::None,
                    ahead => Self::Ahead { last: epoch, ahead: ahead.min(HALF_OF_EPOCHS) },
                }
            }
        };
    }
}

impl<T> Default for ContactState<T> {
    fn default() -> Self {
        Self {
            pending: Vec::new(),
            skin: None,
            others: [const { None }; SensorPage::SIMULATED_PAGE_NAMES.len()],
            obeys: None,
            is_known: false,
            unseen: UnseenStimuli::Any,
            received_stimuli: Some(0),
            has_missed_stimuli: false,
            mode_pending: false,
        }
    }
}

impl<T> ContactState<T> {
    /// Adds a stimulus to the pending ones, unless the cell measures or has too many pending; `last` is the epoch of
    /// the last joints.
    pub fn add_stimulus(&mut self, from: StimulusStart, page: SensorPage, tag: T, last: Option<Epoch>) {
        self.received_stimuli = self.received_stimuli.map(|came| came.wrapping_add(1));
        if self.obeys != Some(false) && self.pending.len() < MAX_PENDING_STIMULI {
            self.pending.push((
                if is_stimulus_late(from, last) { StimulusStart::Next } else { from },
                page,
                tag,
            ));
        }
    }

    /// Latches the stimuli whose time has come at the joints of this epoch, calling `latched` for each. If several set
    /// the same page, the newest counts.
    pub fn latch_due_stimuli(&mut self, epoch: Epoch, mut latched: impl FnMut(&mut T)) {
        self.unseen.remove_latched_stimuli(epoch);
        self.has_missed_stimuli &= self.unseen != UnseenStimuli::None;
        let is_due = move |(from, _, _): &mut (StimulusStart, SensorPage, T)| match from {
            StimulusStart::Next => true,
            StimulusStart::Epoch(first) => epoch.epochs_since(*first) >= 0,
        };
        for (_, page, mut tag) in self.pending.extract_if(.., is_due) {
            latched(&mut tag);
            if let SensorPage::Skin(skin) = page {
                self.skin = Some((skin, tag));
                self.is_known |= self.unseen == UnseenStimuli::None;
            } else if let Some(other) = other_page_slot(&mut self.others, &page) {
                *other = Some((page, tag));
            }
        }
    }

    /// Applies the cell's own sensors page. It counts only if the state is not known otherwise, because it may be older
    /// than the joints at which the cell latched the next stimulus. It does not count while a stimulus that was not
    /// received here may be pending.
    pub fn apply_reported_page(&mut self, page: SensorPage, tag: T) {
        if let SensorPage::Skin(skin) = page {
            if !self.is_known && self.unseen == UnseenStimuli::None {
                (self.skin, self.is_known) = (Some((skin, tag)), true);
            } else if !self.has_missed_stimuli {
                self.skin.get_or_insert((skin, tag));
            }
        } else if let Some(other) = other_page_slot(&mut self.others, &page) {
            other.get_or_insert((page, tag));
        }
    }

    /// Compares the number of stimuli that the cell has counted since its start with those received here. If they are
    /// equal, there are no others.
    pub fn compare_stimulus_count(&mut self, stimuli: u16, tag: T) {
        if self.received_stimuli == Some(stimuli) {
            self.mark_state_known(tag);
        } else if self.received_stimuli.is_some() {
            self.has_missed_stimuli = self.unseen != UnseenStimuli::None;
        }
    }

    /// Records a start of the cell: it is not in contact, and has no pending stimulus.
    pub fn record_start(&mut self, tag: T) {
        self.reset();
        self.mark_state_known(tag);
    }

    /// Records a write of the mode. Once the cell has received it, the cell has no contact state and no pending
    /// stimuli.
    pub fn record_mode_write(&mut self) {
        self.reset();
        self.mode_pending = true;
    }

    /// Records that the cell confirmed the write of its mode: all stimuli since then were received here.
    pub fn confirm_mode(&mut self, tag: T) {
        if self.mode_pending {
            self.mark_state_known(tag);
        }
    }

    /// Marks the state as known: all stimuli that matter were received here.
    fn mark_state_known(&mut self, tag: T) {
        self.skin.get_or_insert_with(|| (SkinSensors::default(), tag));
        (self.is_known, self.unseen, self.has_missed_stimuli, self.mode_pending) =
            (true, UnseenStimuli::None, false, false);
    }

    /// Returns the skin sensors of the cell if they are certain.
    #[must_use]
    pub fn certain_skin(&self) -> Option<&(SkinSensors, T)> {
        self.skin.as_ref().filter(|_| self.is_known)
    }

    /// Returns the skin sensors of the cell by the stimuli and pages received here; older stimuli may have changed
    /// them.
    #[must_use]
    pub const fn presumed_skin(&self) -> Option<&(SkinSensors, T)> {
        self.skin.as_ref()
    }

    /// Returns all sensors pages of the cell, latched from stimuli or reported by the cell.
    pub fn latched_pages(&self) -> impl Iterator<Item = (SensorPage, &T)> {
        let skin = self.skin.iter().map(|(skin, tag)| (SensorPage::Skin(*skin), tag));
        skin.chain(self.others.iter().flatten().map(|(page, tag)| (*page, tag)))
    }

    /// Returns the pending stimuli in order, each with the joints at which the cell latches it.
    #[must_use]
    pub fn pending_stimuli(&self) -> &[(StimulusStart, SensorPage, T)] {
        &self.pending
    }

    /// Forgets the contact state and the pending stimuli: stimuli may have been lost, or sent by others.
    pub fn reset(&mut self) {
        self.pending.clear();
        (self.skin, self.others) = (None, [const { None }; SensorPage::SIMULATED_PAGE_NAMES.len()]);
        (self.is_known, self.unseen, self.received_stimuli) = (false, UnseenStimuli::Any, None);
        (self.has_missed_stimuli, self.mode_pending) = (false, false);
    }

    /// Marks the contact state as unknown until the next stimulus; stimuli stay pending in the cell.
    pub fn mark_state_unknown(&mut self) {
        (self.skin, self.others) = (None, [const { None }; SensorPage::SIMULATED_PAGE_NAMES.len()]);
        (self.is_known, self.received_stimuli) = (false, None);
    }

    /// Returns true if the cell is in test mode and obeys stimuli; `None` if unknown, in which case callers assume that
    /// it does.
    #[must_use]
    pub const fn obeys_stimuli(&self) -> Option<bool> {
        self.obeys
    }

    /// Sets whether the cell obeys stimuli or measures from now on.
    pub const fn set_obeys_stimuli(&mut self, obeys: bool) {
        self.obeys = Some(obeys);
    }
}

/// Returns the place of a page; `None` for a baseline, which belongs to the computation and is not a reading.
fn other_page_slot<'a, T>(
    others: &'a mut [Option<(SensorPage, T)>],
    page: &SensorPage,
) -> Option<&'a mut Option<(SensorPage, T)>> {
    others.get_mut(page.simulated_index()?)
}

/// Returns true if the joints from which a stimulus should apply have passed, so that it applies from the next ones.
/// `last` is the epoch of the last joints.
#[must_use]
pub fn is_stimulus_late(from: StimulusStart, last: Option<Epoch>) -> bool {
    matches!((from, last), (StimulusStart::Epoch(first), Some(last)) if last.epochs_since(first) >= 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::{Q3_12, Q5_10};

    fn press(newtons: f64) -> SensorPage {
        SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() })
    }

    fn latch(contact: &mut ContactState<u64>, epoch: u8) -> Option<(f64, u64)> {
        contact.latch_due_stimuli(Epoch(epoch), |_| {});
        contact.presumed_skin().map(|(skin, tag)| (skin.contact[0].to_f64(), *tag))
    }

    #[test]
    fn stimuli_wait_for_their_epoch_and_late_ones_for_the_next() {
        let mut contact = ContactState::default();
        assert_eq!(latch(&mut contact, 253), None, "not known");
        contact.add_stimulus(StimulusStart::Epoch(Epoch(1)), press(2.0), 5, Some(Epoch(253)));
        contact.add_stimulus(StimulusStart::Epoch(Epoch(253)), press(1.0), 6, Some(Epoch(253)));
        assert_eq!(latch(&mut contact, 254), Some((1.0, 6)), "late, so from the next on");
        assert_eq!(latch(&mut contact, 0), Some((1.0, 6)));
        assert_eq!(latch(&mut contact, 1), Some((2.0, 5)));
        contact.reset();
        assert_eq!(latch(&mut contact, 2), None);
    }

    #[test]
    fn the_ninth_waiting_stimulus_is_refused_whatever_its_page() {
        let mut contact = ContactState::default();
        for _ in 0..MAX_PENDING_STIMULI {
            contact.add_stimulus(StimulusStart::Next, SensorPage::Acceleration([Q3_12::ZERO; 3]), 0, None);
        }
        contact.add_stimulus(StimulusStart::Next, press(1.0), 0, None);
        assert_eq!(contact.pending_stimuli().len(), MAX_PENDING_STIMULI);
        assert_eq!(latch(&mut contact, 0), None);
        assert_eq!(contact.latched_pages().count(), 1);
    }

    #[test]
    fn the_cells_own_page_counts_only_while_nothing_else_is_known() {
        let mut contact = ContactState::default();
        contact.apply_reported_page(press(3.0), 1);
        assert_eq!(latch(&mut contact, 0), Some((3.0, 1)));
        contact.add_stimulus(StimulusStart::Next, press(1.0), 2, None);
        assert_eq!(latch(&mut contact, 1), Some((1.0, 2)));
        contact.apply_reported_page(press(3.0), 3);
        assert_eq!(latch(&mut contact, 2), Some((1.0, 2)), "an old page");
    }

    fn known(contact: &ContactState<u64>) -> Option<f64> {
        contact.certain_skin().map(|(skin, _)| skin.contact[0].to_f64())
    }

    #[test]
    fn a_contact_is_known_from_a_start_a_confirmed_mode_or_equal_counts_on() {
        let mut contact = ContactState::default();
        contact.apply_reported_page(press(3.0), 1);
        contact.add_stimulus(StimulusStart::Next, press(1.0), 1, None);
        assert_eq!((latch(&mut contact, 1), known(&contact)), (Some((1.0, 1)), None), "others may wait");
        contact.compare_stimulus_count(2, 1);
        assert_eq!(known(&contact), None, "it has taken one that did not come here");
        contact.compare_stimulus_count(1, 1);
        assert_eq!(known(&contact), Some(1.0));
        contact.reset();
        contact.compare_stimulus_count(1, 1);
        assert_eq!(known(&contact), None, "the count is of stimuli that are forgotten");
        contact.record_start(1);
        assert_eq!(known(&contact), Some(0.0));
        contact.record_mode_write();
        contact.add_stimulus(StimulusStart::Next, press(2.0), 1, None);
        assert_eq!((latch(&mut contact, 2), known(&contact)), (Some((2.0, 1)), None), "not confirmed");
        contact.confirm_mode(1);
        assert_eq!(known(&contact), Some(2.0), "the stimulus came after the write");
        contact.mark_state_unknown();
        contact.confirm_mode(1);
        assert_eq!(known(&contact), None, "nothing was written");
        contact.add_stimulus(StimulusStart::Next, press(1.0), 1, None);
        assert_eq!((latch(&mut contact, 3), known(&contact)), (Some((1.0, 1)), Some(1.0)));
        contact.reset();
        contact.confirm_mode(1);
        assert_eq!(known(&contact), None);
    }

    /// A cell may have received one stimulus, for any epoch, before the reader started. When the reader begins to trust
    /// the cell's page, that stimulus is no longer pending.
    #[test]
    fn no_stimulus_from_before_waits_when_a_page_is_believed_whatever_epochs_come() {
        for steps in [&[1_u8][..], &[127], &[3, 1, 255, 1], &[200, 100], &[1, 1, 100], &[254, 7]] {
            let mut contact = ContactState::<u64>::default();
            let mut waiting: Vec<u8> = (0..=255).collect();
            let (mut epoch, mut joints) = (77_u8, 0);
            while contact.unseen != UnseenStimuli::None {
                contact.latch_due_stimuli(Epoch(epoch), |_| {});
                waiting.retain(|&first| Epoch(epoch).epochs_since(Epoch(first)) < 0);
                let ahead = match contact.unseen {
                    UnseenStimuli::Any => 256,
                    UnseenStimuli::Ahead { ahead, .. } => usize::from(ahead),
                    UnseenStimuli::None => 0,
                };
                assert!(waiting.len() <= ahead, "{waiting:?} after epoch {epoch}, {:?}", contact.unseen);
                epoch = epoch.wrapping_add(steps[joints % steps.len()]);
                joints += 1;
                assert!(joints < 1_000, "{steps:?}");
            }
            assert!(waiting.is_empty());
            assert!(joints == 129 || steps != [1]);
            contact.apply_reported_page(press(3.0), 1);
            assert_eq!(known(&contact), Some(3.0));
        }
    }

    #[test]
    fn a_page_of_a_cell_that_counted_other_stimuli_tells_nothing() {
        let mut contact = ContactState::default();
        contact.compare_stimulus_count(1, 1);
        contact.apply_reported_page(press(0.0), 1);
        assert_eq!(latch(&mut contact, 1), None, "the other one may wait");
        contact.add_stimulus(StimulusStart::Next, press(1.0), 2, None);
        assert_eq!(latch(&mut contact, 2), Some((1.0, 2)));
    }

    #[test]
    fn a_cell_that_measures_takes_no_stimuli() {
        let mut contact = ContactState::default();
        assert_eq!(contact.obeys_stimuli(), None);
        contact.set_obeys_stimuli(false);
        assert_eq!(contact.obeys_stimuli(), Some(false));
        contact.add_stimulus(StimulusStart::Next, press(1.0), 1, None);
        assert_eq!(latch(&mut contact, 0), None);
    }

    #[test]
    fn a_stimulus_is_late_at_its_own_joints_and_after_them() {
        let of =
            |first, last: Option<u8>| is_stimulus_late(StimulusStart::Epoch(Epoch(first)), last.map(Epoch));
        assert_eq!(
            [of(5, Some(4)), of(5, Some(5)), of(255, Some(1)), of(5, None)],
            [false, true, true, false]
        );
        assert!(!is_stimulus_late(StimulusStart::Next, Some(Epoch(5))));
    }
}
