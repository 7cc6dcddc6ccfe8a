//! Switches of a cell: the parameters events, sensing and baseline (8, 7 and 11), which a restart resets.
//!
//! The skin gives the target of each switch. If the cell confirms another value, which a command-line tool has written,
//! that value becomes the target. The gateway writes the targets to the cell until it confirms them.

use protocol::message::Answer;
use protocol::packet::WORDS;
use protocol::parameters::{Baseline, Events, Parameter, Sensing};

/// A parameter's number and its target words.
pub type SwitchTarget = (u8, [i16; WORDS]);

/// Number of switches.
pub const SWITCH_COUNT: usize = 3;

/// The switches of one cell, in the order in which they are written: thresholds before the mode that needs them.
#[derive(Clone, Copy, Debug)]
pub(super) struct SwitchStates {
    target: [SwitchTarget; SWITCH_COUNT],
    confirmed: [bool; SWITCH_COUNT],
    /// True if the cell has a baseline, so that it subtracts a zero from its force sensor.
    pub(super) subtracts_baseline: bool,
}

impl SwitchStates {
    /// Creates the switches of a cell that has just started, with the skin's targets.
    pub(super) fn new(events: Events, sensing: Sensing, baseline: Baseline) -> Self {
        let target = [
            (Parameter::Events.number(), events.words()),
            (Parameter::Sensing.number(), sensing.words()),
            (Parameter::Baseline.number(), baseline.words()),
        ];
        let mut switched = Self { target, confirmed: [false; SWITCH_COUNT], subtracts_baseline: false };
        switched.reset_to_start_values();
        switched
    }

    /// Resets the switches to their values after a start of the cell.
    pub(super) fn reset_to_start_values(&mut self) {
        let start = [Events::default().words(), Sensing::default().words(), Baseline::default().words()];
        for ((confirmed, (_, target)), start) in self.confirmed.iter_mut().zip(self.target).zip(start) {
            *confirmed = target == start;
        }
        self.subtracts_baseline = false;
    }

    /// Records the answer to a write. A refused write is not repeated.
    pub(super) fn record_answer(&mut self, answer: &Answer) {
        let (of, words) = match *answer {
            Answer::Value { number, written: true, words } => (number, Some(words)),
            // A cell without the option can only have zeros.
            Answer::Refused {
                number,
                reason: Answer::REFUSED_UNKNOWN_PARAMETER | Answer::REFUSED_INVALID_WORDS,
            } => (number, None),
            Answer::Value { .. } | Answer::Refused { .. } => return,
        };
        if let (Some(words), true) = (words, of == Parameter::Baseline.number()) {
            self.subtracts_baseline = words != Baseline::Off.words();
        }
        for ((number, target), confirmed) in self.target.iter_mut().zip(&mut self.confirmed) {
            if *number == of {
                (*target, *confirmed) = (words.unwrap_or(*target), true);
            }
        }
    }

    /// Returns the switches that must still be written to the cell.
    pub(super) fn unconfirmed(&self) -> [Option<SwitchTarget>; SWITCH_COUNT] {
        let mut lacks = self.target.map(Some);
        for (lacks, confirmed) in lacks.iter_mut().zip(self.confirmed) {
            *lacks = lacks.filter(|_| !confirmed);
        }
        lacks
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q;
    use protocol::parameters::BaselineSettings;

    const MODE: u8 = 7;

    fn lacks(switched: &SwitchStates) -> Vec<u8> {
        switched.unconfirmed().iter().flatten().map(|(number, _)| *number).collect()
    }

    #[test]
    fn a_cell_lacks_what_differs_from_its_start_until_it_confirms() {
        let plain = SwitchStates::new(Events::default(), Sensing::Off, Baseline::Off);
        assert_eq!(lacks(&plain), [0_u8; 0]);
        let finer = Events { contact: protocol::fixed::Q5_10::from_bits(5), ..Events::default() };
        let mut switched = SwitchStates::new(finer, Sensing::Event, Baseline::Off);
        assert_eq!(lacks(&switched), [8, MODE], "thresholds first");
        let (number, words) = switched.unconfirmed()[1].unwrap();
        switched.record_answer(&Answer::Value { number, written: false, words });
        assert_eq!(lacks(&switched), [8, MODE], "it was only read");
        switched.record_answer(&Answer::Value { number, written: true, words });
        assert_eq!(lacks(&switched), [8]);
        switched.record_answer(&Answer::Refused { number: 8, reason: Answer::REFUSED_UNKNOWN_PARAMETER });
        assert_eq!(lacks(&switched), [0_u8; 0], "an unknown parameter");
        switched.reset_to_start_values();
        assert_eq!(lacks(&switched), [8, MODE]);
    }

    #[test]
    fn a_cell_subtracts_a_zero_from_its_answer_on_until_it_restarts() {
        let rule = BaselineSettings {
            threshold: Q::from_bits(103),
            hysteresis: Q::from_bits(0),
            rate_un_per_s: 5,
            limit: Q::from_bits(512),
            n_per_c: Q::from_bits(0),
        };
        let mut switched = SwitchStates::new(Events::default(), Sensing::Off, Baseline::On(rule));
        let (number, words) = switched.unconfirmed()[2].unwrap();
        assert!(!switched.subtracts_baseline);
        switched.record_answer(&Answer::Value { number, written: true, words });
        assert!(switched.subtracts_baseline && lacks(&switched).is_empty());
        switched.reset_to_start_values();
        assert!(!switched.subtracts_baseline && lacks(&switched) == [11]);
    }

    #[test]
    fn another_confirmed_value_becomes_the_target() {
        let mut switched = SwitchStates::new(Events::default(), Sensing::Off, Baseline::Off);
        let words = Sensing::Continuous { period_ms: 16 }.words();
        switched.record_answer(&Answer::Value { number: MODE, written: true, words });
        assert_eq!(lacks(&switched), [0_u8; 0]);
        switched.reset_to_start_values();
        assert_eq!(switched.unconfirmed()[1], Some((MODE, words)));
    }
}
