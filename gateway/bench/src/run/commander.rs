//! Remote control of a run by another process: its replies, and the buses that its commands have switched.

use std::collections::BTreeMap;
use std::io;
use std::time::Instant;

use thiserror::Error;

use crate::processes::LaunchError;
use crate::remote::{CommandReply, Phase, Remote};

/// Maximum number of kept replies.
const MAX_REPLIES: usize = 8;

/// The remote control of a run, with its latest replies to commands.
#[derive(Debug)]
pub(super) struct RemoteControl {
    pub(super) remote: Remote,
    pub(super) answers: Vec<CommandReply>,
    /// Total number of replies so far.
    count: u64,
    pub(super) due: Instant,
}

/// Buses that commands have taken down. They outlive the remote control, because only a bus itself shows that it works
/// again.
#[derive(Debug, Default)]
pub(super) struct SwitchedBuses(BTreeMap<usize, BusSwitchState>);

/// State of a bus that a command has taken down.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum BusSwitchState {
    /// The bus was taken down and must stay down.
    Down,
    /// The bus was brought up, or released, after it had accepted `commands` commands of this run.
    Up { commands: u64 },
}

impl SwitchedBuses {
    /// Returns true if a bus is to stay down.
    pub(super) fn is_down(&self, bus: usize) -> bool {
        self.0.get(&bus) == Some(&BusSwitchState::Down)
    }

    /// Returns true if a command caused the loss of a bus: the bus is down, or has not worked since it was brought up.
    /// Such a loss does not end the run.
    pub(super) fn is_loss_expected(&self, bus: usize) -> bool {
        self.0.contains_key(&bus)
    }

    /// Checks that a command may take a bus down, or bring it up.
    ///
    /// # Errors
    /// Returns an error if the bus is in the requested state already, or will be as soon as its receiver has noticed
    /// the last change.
    pub(super) fn check_switch(&self, down: bool, bus: usize) -> Result<(), CommandError> {
        match (down, self.0.get(&bus)) {
            (true, Some(BusSwitchState::Down)) => Err(CommandError::AlreadyDown),
            (false, Some(BusSwitchState::Up { .. })) => Err(CommandError::ComesUp),
            (false, None) => Err(CommandError::NotTakenDown),
            (true, Some(BusSwitchState::Up { .. }) | None) | (false, Some(BusSwitchState::Down)) => Ok(()),
        }
    }

    /// Notes that a bus was taken down or brought up after it had accepted this number of commands.
    pub(super) fn note_bus_switched(&mut self, down: bool, bus: usize, commands: u64) {
        self.0.insert(bus, if down { BusSwitchState::Down } else { BusSwitchState::Up { commands } });
    }

    /// Releases the buses that are down, because no later command will bring them up. `commands` returns the number of
    /// commands that a bus has accepted.
    pub(super) fn release_down_buses(&mut self, commands: impl Fn(usize) -> u64) {
        for (bus, switched) in self.0.iter_mut().filter(|(_, switched)| **switched == BusSwitchState::Down) {
            *switched = BusSwitchState::Up { commands: commands(*bus) };
        }
    }

    /// Forgets the buses that work again, which have accepted a command since they were brought up. A bus accepts none
    /// until its receiver has noticed the loss and reopened it. `taken` returns the number of accepted commands, or
    /// `None` for a bus that is lost.
    pub(super) fn forget_working_buses(&mut self, taken: impl Fn(usize) -> Option<u64>) {
        self.0.retain(|bus, switched| match switched {
            BusSwitchState::Down => true,
            BusSwitchState::Up { commands } => taken(*bus).is_none_or(|taken| taken <= *commands),
        });
    }
}

/// Reason why a command is refused.
#[derive(Debug, Error)]
pub(super) enum CommandError {
    #[error("the skin has no such bus")]
    NoBus,
    #[error("the skin has no such cell")]
    NoCell,
    #[error("this run did not start the process of the cell")]
    NoProcess,
    #[error("the process {}", phase_text(*.0))]
    Phase(Phase),
    #[error("the skin has no wire between these cells")]
    NoWire,
    #[error("the cells of this bus send torques, not sums, so they use no wires")]
    NoLinks,
    #[error("the bus is already down")]
    AlreadyDown,
    #[error("only a bus that a command of this run took down can be brought up")]
    NotTakenDown,
    #[error("the bus was already brought up, but does not work yet")]
    ComesUp,
    #[error("another program serves this bus: stop that program")]
    NotServed,
    #[error("the bus is not a virtual interface: only vcan, vxcan and embedded buses can be taken down here")]
    NotVirtual,
    #[error("there is no such interface")]
    NoInterface,
    #[error("{source}; give the run CAP_NET_ADMIN, or run `sudo ip link set {name} {state}`")]
    Interface { name: String, state: &'static str, source: io::Error },
    #[error(transparent)]
    Launch(#[from] LaunchError),
}

const fn phase_text(phase: Phase) -> &'static str {
    match phase {
        Phase::Running => "is running",
        Phase::Stopped => "is stopped",
        Phase::Ended => "has ended: restart it",
    }
}

impl RemoteControl {
    pub(super) fn new(remote: Remote) -> Self {
        Self { remote, answers: Vec::new(), count: 0, due: Instant::now() }
    }

    /// Sends the state in the next round.
    pub(super) fn send_state_soon(&mut self) {
        self.due = Instant::now();
    }

    pub(super) fn add_reply(&mut self, done: bool, text: String) {
        self.count += 1;
        if self.answers.len() >= MAX_REPLIES {
            self.answers.remove(0);
        }
        self.answers.push(CommandReply { number: self.count, done, text });
        self.send_state_soon();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_says_why_in_one_line() {
        let source = io::Error::from_raw_os_error(1);
        let refused = CommandError::Interface { name: "vcan0".to_owned(), state: "down", source };
        let why = "Operation not permitted (os error 1); give the run CAP_NET_ADMIN, or run `sudo ip \
                   link set vcan0 down`";
        assert_eq!(refused.to_string(), why);
    }

    #[test]
    fn a_bus_that_was_taken_up_is_expected_until_it_has_worked() {
        let mut buses = SwitchedBuses::default();
        assert!(matches!(buses.check_switch(false, 0), Err(CommandError::NotTakenDown)));
        buses.check_switch(true, 0).unwrap();
        buses.note_bus_switched(true, 0, 100);
        assert!(matches!(buses.check_switch(true, 0), Err(CommandError::AlreadyDown)));
        buses.forget_working_buses(|_| Some(105));
        assert!(buses.is_down(0) && buses.is_loss_expected(0), "what works there is of before");
        // The bus was taken down and up at once, so that its receiver has not noticed the change.
        buses.check_switch(false, 0).unwrap();
        buses.note_bus_switched(false, 0, 105);
        buses.forget_working_buses(|_| Some(105));
        assert!(!buses.is_down(0) && buses.is_loss_expected(0));
        assert!(matches!(buses.check_switch(false, 0), Err(CommandError::ComesUp)));
        buses.forget_working_buses(|_| None);
        assert!(buses.is_loss_expected(0), "the receiver has noticed it");
        // The bus was taken down again before it worked.
        buses.check_switch(true, 0).unwrap();
        buses.note_bus_switched(true, 0, 105);
        buses.note_bus_switched(false, 0, 105);
        buses.forget_working_buses(|_| Some(105));
        assert!(buses.is_loss_expected(0) && !buses.is_loss_expected(1));
        buses.forget_working_buses(|_| Some(106));
        assert!(!buses.is_loss_expected(0), "it works: its next loss is one");
    }

    #[test]
    fn buses_that_a_remote_had_down_come_back_without_it() {
        let mut buses = SwitchedBuses::default();
        buses.note_bus_switched(true, 0, 7);
        buses.note_bus_switched(false, 1, 7);
        buses.release_down_buses(|_| 9);
        assert!(!buses.is_down(0) && buses.is_loss_expected(0) && buses.is_loss_expected(1));
        buses.forget_working_buses(|_| Some(9));
        assert!(buses.is_loss_expected(0) && !buses.is_loss_expected(1));
        buses.forget_working_buses(|_| Some(10));
        assert!(!buses.is_loss_expected(0));
    }
}
