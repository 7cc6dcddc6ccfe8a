//! Pending answer, and handling of the datagrams received in a tick: without socket and clock.

use std::path::PathBuf;

use super::absence::{Absence, OtherDatagrams};
use super::datagram::{JointCommand, ReceivedDatagram, InvalidDatagram};
use crate::controller::{BadCycle, Input, SpeedLimits, ControllerOutput};

/// Counts of events since the start.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub(super) struct ExchangeCounts {
    /// Hellos.
    pub(super) hellos: u64,
    /// Answers in time.
    pub(super) answers: u64,
    /// Ticks without an answer from the peer.
    pub(super) missing: u64,
    /// Answers to a tick that had ended.
    pub(super) late: u64,
    /// Second answers to the same tick.
    pub(super) repeated: u64,
    /// Datagrams from senders other than the peer.
    pub(super) other_senders: u64,
    /// States that did not fit into the peer's queue.
    pub(super) unsent: u64,
    /// Peers that ended.
    pub(super) gone: u64,
    /// Datagrams that could not be received, and hellos from unnamed senders.
    pub(super) failed: u64,
    /// Invalid datagrams from the peer, in the order of [`Nonsense::ALL`].
    pub(super) nonsense: [u64; InvalidDatagram::ALL.len()],
}

impl ExchangeCounts {
    /// All counts with their names.
    pub(super) fn each(&self) -> impl Iterator<Item = (String, u64)> {
        let own = [
            ("hellos", self.hellos),
            ("answers", self.answers),
            ("missing", self.missing),
            ("late", self.late),
            ("repeated", self.repeated),
            ("other senders", self.other_senders),
            ("unsent", self.unsent),
            ("gone", self.gone),
            ("failed", self.failed),
        ];
        let nonsense = InvalidDatagram::ALL.iter().zip(self.nonsense);
        own.into_iter()
            .map(|(name, count)| (name.to_owned(), count))
            .chain(nonsense.map(|(why, count)| (format!("nonsense: {why}"), count)))
    }

    /// Reason why the controller counts as absent, if it does: it never answered, or not in the last `silent` ticks,
    /// which are enough to halt a robot whose controller had started.
    pub(super) fn absence(&self, socket: PathBuf, silent: Option<u32>) -> Option<Absence> {
        let &Self { hellos, answers, missing, late, other_senders, failed, .. } = self;
        match (hellos, answers, silent) {
            (0, ..) => {
                let others = OtherDatagrams { named: other_senders, unnamed: failed };
                Some(Absence::NoHello { socket, others })
            }
            (_, 0, _) => {
                let nonsense = self.nonsense.iter().sum();
                Some(Absence::NoAnswer { socket, missing, late, nonsense })
            }
            (.., Some(ticks)) => Some(Absence::Gone { socket, answers, ticks }),
            (.., None) => None,
        }
    }

    fn nonsense(&mut self, why: InvalidDatagram) {
        let at = InvalidDatagram::ALL.iter().position(|it| *it == why);
        if let Some(count) = at.and_then(|at| self.nonsense.get_mut(at)) {
            *count += 1;
        }
    }
}

/// Sender of a datagram.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Sender {
    Peer,
    Other,
}

/// Result of sending a state.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum SendResult {
    Taken,
    QueueFull,
    NobodyThere,
}

/// Exchange of datagrams with the peer.
#[derive(Clone, Debug, Default)]
pub(super) struct Exchange {
    connected: bool,
    /// Tick whose answer is due.
    due: Option<u64>,
    answer: Option<JointCommand>,
    nonsense: bool,
    pub(super) counts: ExchangeCounts,
    /// Number of the robot's joints.
    joints: usize,
}

impl Exchange {
    /// Creates an exchange for a robot with `joints` joints.
    pub(super) fn new(joints: usize) -> Self {
        Self { joints, ..Self::default() }
    }

    /// Handles a datagram. Returns true if its sender is the peer from now on.
    pub(super) fn handle(&mut self, bytes: &[u8], sender: Sender) -> bool {
        let answer = match (ReceivedDatagram::decode(bytes, self.joints), sender) {
            (Ok(ReceivedDatagram::Hello), _) => {
                let counts = ExchangeCounts { hellos: self.counts.hellos + 1, ..core::mem::take(&mut self.counts) };
                // A second hello of the peer keeps its pending answer.
                if sender == Sender::Other || !self.connected {
                    *self = Self::new(self.joints);
                }
                (self.connected, self.counts) = (true, counts);
                return true;
            }
            (_, Sender::Other) => {
                self.counts.other_senders += 1;
                return false;
            }
            (Err(why), Sender::Peer) => {
                self.nonsense = true;
                self.counts.nonsense(why);
                return false;
            }
            (Ok(ReceivedDatagram::Answer(answer)), Sender::Peer) => answer,
        };
        match self.due {
            Some(due) if answer.tick > due => {
                self.nonsense = true;
                self.counts.nonsense(InvalidDatagram::Ahead);
            }
            Some(due) if answer.tick == due => {
                if self.answer.is_some() {
                    self.counts.repeated += 1;
                } else {
                    self.answer = Some(answer.command);
                }
            }
            Some(_) | None => self.counts.late += 1,
        }
        false
    }

    /// Returns the command of the tick; call it after all datagrams have been handled.
    pub(super) fn step(&mut self, input: &Input, pace: &SpeedLimits) -> ControllerOutput {
        let (due, answer) = (self.due.take(), self.answer.take());
        let nonsense = core::mem::take(&mut self.nonsense);
        if answer.is_some() {
            self.counts.answers += 1;
        } else if due.is_some() {
            self.counts.missing += 1;
        }
        match (answer, due) {
            _ if nonsense => ControllerOutput::Bad(BadCycle::Nonsense),
            (Some(JointCommand::Velocity(velocity)), _) => ControllerOutput::Move(pace.limited(velocity, input)),
            (Some(JointCommand::Position(goal)), _) => ControllerOutput::Move(pace.towards(&goal, input)),
            (None, Some(_)) => ControllerOutput::Bad(BadCycle::NoAnswer),
            (None, None) => ControllerOutput::Bad(BadCycle::NoPeer),
        }
    }

    /// Notes the result of sending this tick's state.
    pub(super) fn sent(&mut self, tick: u64, sent: SendResult) {
        match sent {
            SendResult::Taken => self.due = Some(tick),
            SendResult::QueueFull => {
                self.due = Some(tick);
                self.counts.unsent += 1;
            }
            SendResult::NobodyThere => {
                self.connected = false;
                self.counts.gone += 1;
            }
        }
    }
}
