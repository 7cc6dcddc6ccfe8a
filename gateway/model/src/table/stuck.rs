//! Detects cells that keep sending the same words while the expected words change.
//!
//! ```text
//!   due torque, and the central one ──────────────┐
//!                                                 ├─> StuckDetector ─> runs of equal words
//!   sensors page, and the page that stimuli set ──┘
//! ```
//!
//! Equal words are correct while nothing changes: a force may be constant, an arm may stand still, and a small torque
//! is rounded to zero. So they count only if the expected words are known, for a cell with a known contact state that
//! neither measures nor subtracts a zero. The expected words must have changed several times, each time by far more
//! than a cell's rounding, so that neither a lost stimulus nor a delay of an epoch explains it. Cells in sums, and
//! measured words, cannot be judged.

use protocol::message::SensorPage;
use protocol::packet::pad_with_defaults;
use protocol::parameters::MAX_JOINTS;

/// Number of equal words in a row from which a cell counts as stuck.
const MIN_STUCK_WORDS: u64 = 32;
/// Minimum number of changes of the expected words during such a run.
const MIN_EXPECTED_CHANGES: u32 = 4;
/// Smallest change of an expected word that counts, in steps of the word.
const MIN_CHANGE_STEPS: u16 = 16;

/// Name of the torques in the longest run of equal words; pages have their own.
const TORQUE_NAME: &str = "torque";

/// The words that a cell sends in torques and sensors pages, compared with the expected ones.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StuckDetector {
    torque: StuckWordRun,
    pages: [StuckWordRun; SensorPage::SIMULATED_PAGE_NAMES.len()],
}

/// The words of one kind that a cell sends, compared with the expected ones.
#[derive(Clone, Copy, Debug, Default)]
struct StuckWordRun {
    sent: Option<[i16; MAX_JOINTS]>,
    /// Number of words in a row that are equal to `sent`.
    run_length: u64,
    /// The expected words after their last counted change.
    expected: [i16; MAX_JOINTS],
    changes: u32,
    /// The longest run of equal words for which the cell counted as stuck.
    longest_run: u64,
}

impl StuckWordRun {
    fn compare(&mut self, sent: [i16; MAX_JOINTS], right: [i16; MAX_JOINTS]) {
        if self.sent.replace(sent) != Some(sent) {
            (self.run_length, self.expected, self.changes) = (1, right, 0);
            return;
        }
        self.run_length += 1;
        let mut both = self.expected.iter().zip(&right);
        if both.any(|(before, now)| before.abs_diff(*now) >= MIN_CHANGE_STEPS) {
            self.expected = right;
            self.changes += 1;
        }
        if self.is_stuck() {
            self.longest_run = self.longest_run.max(self.run_length);
        }
    }

    const fn is_stuck(&self) -> bool {
        self.run_length >= MIN_STUCK_WORDS && self.changes >= MIN_EXPECTED_CHANGES
    }
}

impl StuckDetector {
    /// Compares a torque that was due with the central torque `right`.
    pub(super) fn compare_torque(&mut self, sent: [i16; MAX_JOINTS], right: [i16; MAX_JOINTS]) {
        self.torque.compare(sent, right);
    }

    /// Compares a sensors page of the cell with the page `right` that stimuli set. Pages of different kinds are not
    /// compared.
    pub(super) fn compare_page(&mut self, sent: &SensorPage, right: &SensorPage) {
        let page = sent.simulated_index().filter(|page| right.simulated_index() == Some(*page));
        if let Some(words) = page.and_then(|page| self.pages.get_mut(page)) {
            words.compare(pad_with_defaults(&sent.words()), pad_with_defaults(&right.words()));
        }
    }

    /// Returns true if the cell counts as stuck now.
    pub(super) fn is_stuck(&self) -> bool {
        self.torque.is_stuck() || self.pages.iter().any(StuckWordRun::is_stuck)
    }

    /// Returns the kinds of words that were stuck, each with its longest run in words.
    pub(super) fn longest_stuck_runs(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let pages =
            SensorPage::SIMULATED_PAGE_NAMES.into_iter().zip(self.pages.map(|words| words.longest_run));
        let all = [(TORQUE_NAME, self.torque.longest_run)].into_iter().chain(pages);
        all.filter(|(_, longest)| *longest > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q3_12;
    use protocol::message::SkinSensors;

    const FEW: i16 = 15;
    const MANY: i16 = 16;

    /// Returns the longest run of stuck words, for pairs of sent and expected words.
    fn longest(words: impl Iterator<Item = (i16, i16)>) -> u64 {
        let mut all = StuckWordRun::default();
        words.for_each(|(sent, right)| {
            all.compare(pad_with_defaults(&[0, sent]), pad_with_defaults(&[0, right]))
        });
        all.longest_run
    }

    #[test]
    fn equal_words_are_too_many_when_the_right_ones_changed_four_times() {
        let moving = |count: i16| longest((0..count).map(|n| (200, n * MANY)));
        assert_eq!([5, 31, 32, 40].map(moving), [0, 0, 32, 40]);
        let changes = |count: i16| longest((0..100).map(|n| (0, (n / 8).min(count) * MANY)));
        assert_eq!([0, 1, 3, 4].map(changes), [0, 0, 0, 100]);
        assert_eq!(longest((0..100).map(|n| (7, n % 2 * MANY))), 100, "there and back");
    }

    #[test]
    fn a_right_cell_is_not_stuck() {
        assert_eq!(longest((0..500).map(|n| (n, n))), 0, "it follows a motion");
        assert_eq!(longest((0..500).map(|n| (n / 3, n))), 0, "coarsely");
        assert_eq!(longest((0..500).map(|_| (512, 510))), 0, "constant force, arm at rest");
        assert_eq!(longest((0..500).map(|n| (0, n % 2 * FEW))), 0, "zero, by rounding");
        assert_eq!(longest((0..500).map(|n| (512, if n < 250 { 512 } else { 2_048 }))), 0, "a lost stimulus");
        assert_eq!(longest((0..500).map(|n| (n / 20 * 320, n * MANY))), 0, "late by a third of a second");
    }

    #[test]
    fn words_that_change_again_end_it_and_it_is_remembered() {
        let mut stuck = StuckDetector::default();
        (0..40).for_each(|n| stuck.compare_torque(pad_with_defaults(&[9]), pad_with_defaults(&[n * MANY])));
        assert!(stuck.is_stuck());
        stuck.compare_torque(pad_with_defaults(&[10]), pad_with_defaults(&[10]));
        assert!(!stuck.is_stuck());
        assert_eq!(stuck.longest_stuck_runs().collect::<Vec<_>>(), [("torque", 40)]);
    }

    #[test]
    fn pages_are_compared_with_pages_of_their_kind() {
        let acceleration =
            |bits| SensorPage::Acceleration([Q3_12::ZERO, Q3_12::ZERO, Q3_12::from_bits(bits)]);
        let skin = |bits| {
            let temperature = [protocol::fixed::Q9_6::from_bits(bits); 2];
            SensorPage::Skin(SkinSensors { temperature, ..SkinSensors::default() })
        };
        let mut stuck = StuckDetector::default();
        for n in 0..40 {
            stuck.compare_page(&skin(0), &acceleration(n * MANY));
            stuck.compare_page(&acceleration(n), &acceleration(n));
            stuck.compare_page(&skin(64), &skin(n * MANY));
        }
        assert_eq!(stuck.longest_stuck_runs().collect::<Vec<_>>(), [("skin", 40)]);
    }
}
