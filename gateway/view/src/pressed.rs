//! The cells that pages press, and the stimuli that apply these touches.

use std::collections::BTreeMap;

use model::scenario::contact_words;
use protocol::id::CellId;
use protocol::message::SkinSensors;
use protocol::time::Micros;

/// The maximum force with which one browser page can press a cell, in N.
pub const MAX_FORCE_N: f64 = 90.0;
/// The time after which a stimulus is sent again if the cell has not latched it, in µs.
const RETRY_INTERVAL_US: u64 = 150_000;
/// The maximum number of times that a release is sent, because the cell may no longer exist.
const MAX_RELEASE_ATTEMPTS: u32 = 20;

/// A cell, by the index of its bus and its node id.
pub type CellKey = (usize, CellId);

/// A force that is to be applied to a cell.
#[derive(Clone, Copy, Debug)]
struct TargetForce {
    force_n: f64,
    sent: Option<Micros>,
    /// The number of times that the stimulus was sent. It limits how often a release is sent.
    attempts: u32,
}

/// The cells that pages press, and the force on each.
#[derive(Clone, Debug, Default)]
pub struct TouchRegistry {
    /// For each page, the cell that it presses and the force in N.
    pages: BTreeMap<u64, (CellKey, f64)>,
    targets: BTreeMap<CellKey, TargetForce>,
}

impl TouchRegistry {
    /// Presses a cell for a page. Releases the cell that the page pressed before. Forces are limited to 0 to
    /// [`MAX_FORCE_N`]; NaN and infinity count as 0.
    pub fn press(&mut self, page: u64, cell: CellKey, force_n: f64) {
        let force_n = if force_n.is_finite() { force_n.clamp(0.0, MAX_FORCE_N) } else { 0.0 };
        let before = self.pages.insert(page, (cell, force_n));
        if let Some((before, _)) = before.filter(|(before, _)| *before != cell) {
            self.update_target_force(before);
        }
        self.update_target_force(cell);
    }

    /// Releases the cell that a page presses, or pressed before it disconnected.
    pub fn release(&mut self, page: u64) {
        if let Some((cell, _)) = self.pages.remove(&page) {
            self.update_target_force(cell);
        }
    }

    /// Sets the force on a cell to the sum of the forces by which pages press it.
    fn update_target_force(&mut self, cell: CellKey) {
        let pages = self.pages.values().filter(|(of, _)| *of == cell);
        let force_n = pages.map(|(_, force_n)| force_n).sum::<f64>().min(MAX_FORCE_N);
        self.targets.insert(cell, TargetForce { force_n, sent: None, attempts: 0 });
    }

    /// Returns true if any page presses the cell.
    #[must_use]
    pub fn is_pressed(&self, cell: CellKey) -> bool {
        self.targets.get(&cell).is_some_and(|target| target.force_n > 0.0)
    }

    /// Returns the stimuli to be sent now. `latched` returns the sensor values that a cell has latched, as far as the
    /// bus shows them.
    pub fn due_stimuli(
        &mut self,
        now: Micros,
        latched: impl Fn(CellKey) -> Option<SkinSensors>,
    ) -> Vec<(CellKey, SkinSensors)> {
        let mut due = Vec::new();
        self.targets.retain(|&cell, target| {
            let sensors =
                SkinSensors { contact: contact_words(target.force_n), ..latched(cell).unwrap_or_default() };
            let is_latched = latched(cell).is_some_and(|now| now.contact == sensors.contact);
            let released = target.force_n <= 0.0;
            if is_latched && target.sent.is_some() {
                return !released;
            }
            if target.sent.is_none_or(|sent| now.elapsed_since(sent).0 >= RETRY_INTERVAL_US) {
                target.sent = Some(now);
                target.attempts += 1;
                due.push((cell, sensors));
            }
            !(released && target.attempts >= MAX_RELEASE_ATTEMPTS)
        });
        due
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "words are exact")]
mod tests {
    use super::*;

    fn cell(node: u8) -> CellKey {
        (0, CellId::new(node.into()).unwrap())
    }

    fn force(sensors: &SkinSensors) -> f64 {
        sensors.contact.iter().map(|word| word.to_f64()).sum()
    }

    #[test]
    fn a_touch_is_sent_until_it_is_latched_and_goes_with_its_page() {
        let mut pressed = TouchRegistry::default();
        pressed.press(1, cell(3), 4.5);
        let first = pressed.due_stimuli(Micros(0), |_| None);
        assert_eq!((first.len(), force(&first[0].1), first[0].0), (1, 4.5, cell(3)));
        assert_eq!(pressed.due_stimuli(Micros(1_000), |_| None), [], "it may still come");
        assert_eq!(pressed.due_stimuli(Micros(200_000), |_| None).len(), 1, "it was lost");
        let sensors = first[0].1;
        assert_eq!(pressed.due_stimuli(Micros(900_000), |_| Some(sensors)), []);
        assert!(pressed.is_pressed(cell(3)));
        // The cell restarts, and has no stimulus latched.
        assert_eq!(pressed.due_stimuli(Micros(1_900_000), |_| Some(SkinSensors::default())).len(), 1);
        pressed.release(1);
        let last = pressed.due_stimuli(Micros(2_000_000), |_| Some(sensors));
        assert_eq!((last.len(), force(&last[0].1)), (1, 0.0));
        assert_eq!(pressed.due_stimuli(Micros(2_020_000), |_| Some(SkinSensors::default())), []);
        assert!(pressed.targets.is_empty() && !pressed.is_pressed(cell(3)));
    }

    #[test]
    fn a_page_presses_one_cell_and_forces_of_pages_add_up() {
        let mut pressed = TouchRegistry::default();
        pressed.press(1, cell(3), 1.0);
        pressed.press(2, cell(3), f64::INFINITY);
        pressed.press(2, cell(3), 2.0);
        assert_eq!(force(&pressed.due_stimuli(Micros(0), |_| None)[0].1), 3.0);
        pressed.press(1, cell(4), -7.0);
        let due = pressed.due_stimuli(Micros(1), |_| None);
        assert_eq!(
            due.iter().map(|(cell, it)| (cell.1.get(), force(it))).collect::<Vec<_>>(),
            [(3, 2.0), (4, 0.0)]
        );
        pressed.release(9);
    }

    #[test]
    fn a_release_that_nobody_takes_ends() {
        let mut pressed = TouchRegistry::default();
        pressed.press(1, cell(3), 1.0);
        pressed.release(1);
        let sent = (0..100_u64)
            .map(|at| pressed.due_stimuli(Micros(at * RETRY_INTERVAL_US), |_| None).len())
            .sum::<usize>();
        assert_eq!((sent, pressed.targets.len()), (MAX_RELEASE_ATTEMPTS as usize, 0));
    }
}
