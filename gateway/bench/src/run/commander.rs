//! The other process that commands a run, the answers it got, and the buses that its commands have switched.

use std::collections::BTreeMap;
use std::io;
use std::time::Instant;

use thiserror::Error;

use crate::processes::LaunchError;
use crate::remote::{Answer, Lines, Phase};

/// Answers that are kept.
const ANSWERS: usize = 8;

/// Who commands a run, and what it was answered.
#[derive(Debug)]
pub(super) struct Remote {
    pub(super) lines: Lines,
    pub(super) answers: Vec<Answer>,
    /// How many answers there were.
    count: u64,
    pub(super) due: Instant,
}

/// Buses that commands have taken down. They outlive the remote, since only a bus itself shows that it works again.
#[derive(Debug, Default)]
pub(super) struct SwitchedBuses(BTreeMap<usize, Switched>);

/// A bus that a command has taken down.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Switched {
    /// It stays down.
    Down,
    /// It was taken up, or is left to come back, when it had taken so many of this run's commands.
    Up { commands: u64 },
}

impl SwitchedBuses {
    /// Whether a bus is to stay down.
    pub(super) fn is_down(&self, bus: usize) -> bool {
        self.0.get(&bus) == Some(&Switched::Down)
    }

    /// Whether the loss of a bus is due to a command, and no reason to end: it is down, or has not worked since it was
    /// taken up.
    pub(super) fn is_expected(&self, bus: usize) -> bool {
        self.0.contains_key(&bus)
    }

    /// Checks that a command may take a bus down, or up.
    ///
    /// # Errors
    /// When it is so already, or about to be.
    pub(super) fn check(&self, down: bool, bus: usize) -> Result<(), Refused> {
        match (down, self.0.get(&bus)) {
            (true, Some(Switched::Down)) => Err(Refused::Already("up")),
            (false, Some(Switched::Up { .. })) => Err(Refused::ComesUp),
            (false, None) => Err(Refused::Already("down")),
            (true, Some(Switched::Up { .. }) | None) | (false, Some(Switched::Down)) => Ok(()),
        }
    }

    /// Takes in that a bus was switched, when it had taken so many commands.
    pub(super) fn switched(&mut self, down: bool, bus: usize, commands: u64) {
        self.0.insert(bus, if down { Switched::Down } else { Switched::Up { commands } });
    }

    /// Leaves the buses that are down to come back, since nobody will take them up; `commands` is how many each has taken.
    pub(super) fn release(&mut self, commands: impl Fn(usize) -> u64) {
        for (bus, switched) in self.0.iter_mut().filter(|(_, switched)| **switched == Switched::Down) {
            *switched = Switched::Up { commands: commands(*bus) };
        }
    }

    /// Forgets the buses that have come up: which are there, and have taken a command since. Until its receiver has noticed
    /// that a bus was away, and has opened it again, it takes none.
    pub(super) fn settle(&mut self, taken: impl Fn(usize) -> Option<u64>) {
        self.0.retain(|bus, switched| match switched {
            Switched::Down => true,
            Switched::Up { commands } => taken(*bus).is_none_or(|taken| taken <= *commands),
        });
    }
}

/// Why a command is not carried out.
#[derive(Debug, Error)]
pub(super) enum Refused {
    #[error("the skin has no such bus")]
    NoBus,
    #[error("the skin has no such cell")]
    NoCell,
    #[error("this run has started no process of it")]
    NoProcess,
    #[error("its process is {}", match .0 { Phase::Running => "running", Phase::Stopped => "stopped", Phase::Ended => "ended: restart starts it again" })]
    Phase(Phase),
    #[error("the skin has no wire between them")]
    NoWire,
    #[error("cells of this bus answer with their own torques: no link carries anything")]
    NoLinks,
    #[error("it is not {0} by a command")]
    Already(&'static str),
    #[error("it was taken up, and does not work yet")]
    ComesUp,
    #[error("another program serves it: end that one")]
    NotServed,
    #[error("it is no virtual interface: only vcan, vxcan and embedded buses are taken down here")]
    NotVirtual,
    #[error("there is no such interface")]
    NoInterface,
    #[error(
        "{source}; a run that may not do it needs CAP_NET_ADMIN, or `sudo ip link set {name} {state}` does it"
    )]
    Interface { name: String, state: &'static str, source: io::Error },
    #[error(transparent)]
    Launch(#[from] LaunchError),
}

impl Remote {
    pub(super) fn new(lines: Lines) -> Self {
        Self { lines, answers: Vec::new(), count: 0, due: Instant::now() }
    }

    pub(super) fn answer(&mut self, done: bool, text: String) {
        self.count += 1;
        if self.answers.len() >= ANSWERS {
            self.answers.remove(0);
        }
        self.answers.push(Answer { number: self.count, done, text });
        self.due = Instant::now();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_says_why_in_one_line() {
        let source = io::Error::from_raw_os_error(1);
        let refused = Refused::Interface { name: "vcan0".to_owned(), state: "down", source };
        let why = "Operation not permitted (os error 1); a run that may not do it needs CAP_NET_ADMIN, or `sudo ip \
                   link set vcan0 down` does it";
        assert_eq!(refused.to_string(), why);
    }

    #[test]
    fn a_bus_that_was_taken_up_is_expected_until_it_has_worked() {
        let mut buses = SwitchedBuses::default();
        assert!(matches!(buses.check(false, 0), Err(Refused::Already("down"))));
        buses.check(true, 0).unwrap();
        buses.switched(true, 0, 100);
        assert!(matches!(buses.check(true, 0), Err(Refused::Already("up"))));
        buses.settle(|_| Some(105));
        assert!(buses.is_down(0) && buses.is_expected(0), "what works there is of before");
        // Down and up at once: the receiver has not noticed anything yet.
        buses.check(false, 0).unwrap();
        buses.switched(false, 0, 105);
        buses.settle(|_| Some(105));
        assert!(!buses.is_down(0) && buses.is_expected(0));
        assert!(matches!(buses.check(false, 0), Err(Refused::ComesUp)));
        buses.settle(|_| None);
        assert!(buses.is_expected(0), "the receiver has noticed it");
        // Again, before it has worked.
        buses.check(true, 0).unwrap();
        buses.switched(true, 0, 105);
        buses.switched(false, 0, 105);
        buses.settle(|_| Some(105));
        assert!(buses.is_expected(0) && !buses.is_expected(1));
        buses.settle(|_| Some(106));
        assert!(!buses.is_expected(0), "it works: its next loss is one");
    }

    #[test]
    fn buses_that_a_remote_had_down_come_back_without_it() {
        let mut buses = SwitchedBuses::default();
        buses.switched(true, 0, 7);
        buses.switched(false, 1, 7);
        buses.release(|_| 9);
        assert!(!buses.is_down(0) && buses.is_expected(0) && buses.is_expected(1));
        buses.settle(|_| Some(9));
        assert!(buses.is_expected(0) && !buses.is_expected(1));
        buses.settle(|_| Some(10));
        assert!(!buses.is_expected(0));
    }
}
