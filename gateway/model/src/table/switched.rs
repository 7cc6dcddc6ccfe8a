//! What a cell shall be switched to and forgets when it starts anew: events and sensing, parameters 8 and 7.
//!
//! What it should be is what the skin says, until the cell confirms something else, which somebody at a shell
//! asked for. What it has not confirmed it is told until it does.

use protocol::message::Answer;
use protocol::packet::WORDS;
use protocol::parameters::{Events, Parameter, Sensing};

/// A parameter's number and the words that it shall have.
pub type Switch = (u8, [i16; WORDS]);

/// How many there are.
pub const SWITCHES: usize = 2;

/// The switches of one cell, in the order in which they are written: thresholds before the mode that needs them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Switched {
    target: [Switch; SWITCHES],
    confirmed: [bool; SWITCHES],
}

impl Switched {
    /// A cell that has just started, and shall be as a skin says.
    pub(super) fn new(events: Events, sensing: Sensing) -> Self {
        let target =
            [(Parameter::Events.number(), events.words()), (Parameter::Sensing.number(), sensing.words())];
        let mut switched = Self { target, confirmed: [false; SWITCHES] };
        switched.restart();
        switched
    }

    /// The cell started anew: it is as every cell is at its start.
    pub(super) fn restart(&mut self) {
        let start = [Events::default().words(), Sensing::default().words()];
        for ((confirmed, (_, target)), start) in self.confirmed.iter_mut().zip(self.target).zip(start) {
            *confirmed = target == start;
        }
    }

    /// The cell answered a write. What it refuses it is not told again.
    pub(super) fn answered(&mut self, answer: &Answer) {
        let (of, words) = match *answer {
            Answer::Value { number, written: true, words } => (number, Some(words)),
            Answer::Refused { number, reason: Answer::UNKNOWN } => (number, None),
            Answer::Value { .. } | Answer::Refused { .. } => return,
        };
        for ((number, target), confirmed) in self.target.iter_mut().zip(&mut self.confirmed) {
            if *number == of {
                (*target, *confirmed) = (words.unwrap_or(*target), true);
            }
        }
    }

    /// What it is to be told.
    pub(super) fn lacks(&self) -> [Option<Switch>; SWITCHES] {
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

    const MODE: u8 = 7;

    fn lacks(switched: &Switched) -> Vec<u8> {
        switched.lacks().iter().flatten().map(|(number, _)| *number).collect()
    }

    #[test]
    fn a_cell_is_told_what_differs_from_its_start_until_it_confirms() {
        let plain = Switched::new(Events::default(), Sensing::Off);
        assert_eq!(lacks(&plain), [0_u8; 0]);
        let finer = Events { contact: protocol::fixed::Q5_10::from_bits(5), ..Events::default() };
        let mut switched = Switched::new(finer, Sensing::Event);
        assert_eq!(lacks(&switched), [8, MODE], "thresholds first");
        let (number, words) = switched.lacks()[1].unwrap();
        switched.answered(&Answer::Value { number, written: false, words });
        assert_eq!(lacks(&switched), [8, MODE], "it was only read");
        switched.answered(&Answer::Value { number, written: true, words });
        assert_eq!(lacks(&switched), [8]);
        switched.answered(&Answer::Refused { number: 8, reason: Answer::UNKNOWN });
        assert_eq!(lacks(&switched), [0_u8; 0], "it does not know it");
        switched.restart();
        assert_eq!(lacks(&switched), [8, MODE]);
    }

    #[test]
    fn what_somebody_else_switched_it_to_is_what_it_gets_back() {
        let mut switched = Switched::new(Events::default(), Sensing::Off);
        let words = Sensing::Continuous { period_ms: 16 }.words();
        switched.answered(&Answer::Value { number: MODE, written: true, words });
        assert_eq!(lacks(&switched), [0_u8; 0]);
        switched.restart();
        assert_eq!(switched.lacks()[1], Some((MODE, words)));
    }
}
