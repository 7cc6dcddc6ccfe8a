//! The exchange with an external controller without socket and clock: handling of received datagrams, and the pending
//! answer.

use std::path::PathBuf;

use super::absence::{ControllerAbsence, OtherDatagrams};
use super::datagram::{InvalidDatagram, JointCommand, ReceivedDatagram};
use crate::controller::{BadCycle, ControllerInput, ControllerOutput, SpeedLimits};

/// Numbers of events since the start of the exchange.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub(super) struct ExchangeCounts {
    /// Number of hellos.
    pub(super) hellos: u64,
    /// Number of answers that arrived in time.
    pub(super) answers: u64,
    /// Number of ticks that the peer did not answer.
    pub(super) missing: u64,
    /// Number of answers that arrived after their tick had ended.
    pub(super) late: u64,
    /// Number of second answers to the same tick.
    pub(super) repeated: u64,
    /// Number of datagrams from senders other than the peer.
    pub(super) other_senders: u64,
    /// Number of states that were not sent because the peer's queue was full.
    pub(super) unsent: u64,
    /// Number of peers that ended.
    pub(super) gone: u64,
    /// Number of datagrams that could not be received, and of hellos from senders without an address.
    pub(super) failed: u64,
    /// Numbers of invalid datagrams from the peer, by reason, in the order of
    /// [`InvalidDatagram::ALL`](super::datagram::InvalidDatagram::ALL).
    pub(super) nonsense: [u64; InvalidDatagram::ALL.len()],
}

impl ExchangeCounts {
    /// Returns all counters with their names.
    pub(super) fn named_counters(&self) -> impl Iterator<Item = (String, u64)> {
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

    /// Returns the reason for which the controller counts as absent; `None` if it does not. It is absent if it never
    /// answered, or not in the last `silent` ticks, which are enough to halt the robot of a controller that had
    /// started.
    pub(super) fn absence(&self, socket: PathBuf, silent: Option<u32>) -> Option<ControllerAbsence> {
        let &Self { hellos, answers, missing, late, other_senders, failed, .. } = self;
        match (hellos, answers, silent) {
            (0, ..) => {
                let others = OtherDatagrams { named: other_senders, unnamed: failed };
                Some(ControllerAbsence::NoHello { socket, others })
            }
            (_, 0, _) => {
                let nonsense = self.nonsense.iter().sum();
                Some(ControllerAbsence::NoAnswer { socket, missing, late, nonsense })
            }
            (.., Some(ticks)) => Some(ControllerAbsence::Gone { socket, answers, ticks }),
            (.., None) => None,
        }
    }

    fn count_invalid(&mut self, why: InvalidDatagram) {
        let at = InvalidDatagram::ALL.iter().position(|it| *it == why);
        if let Some(count) = at.and_then(|at| self.nonsense.get_mut(at)) {
            *count += 1;
        }
    }
}

/// The sender of a datagram.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum DatagramSender {
    Peer,
    Other,
}

/// The result of sending a state to the peer.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum SendResult {
    Taken,
    QueueFull,
    PeerGone,
}

/// The exchange of datagrams with the peer.
#[derive(Clone, Debug, Default)]
pub(super) struct DatagramExchange {
    connected: bool,
    /// Number of the tick whose answer is awaited.
    due: Option<u64>,
    answer: Option<JointCommand>,
    nonsense: bool,
    pub(super) counts: ExchangeCounts,
    /// Number of the robot's joints.
    joints: usize,
}

impl DatagramExchange {
    /// Creates an exchange for a robot with `joints` joints.
    pub(super) fn new(joints: usize) -> Self {
        Self { joints, ..Self::default() }
    }

    /// Handles a received datagram. Returns true if the datagram is a hello that makes its sender the peer.
    pub(super) fn handle_datagram(&mut self, bytes: &[u8], sender: DatagramSender) -> bool {
        let answer = match (ReceivedDatagram::decode(bytes, self.joints), sender) {
            (Ok(ReceivedDatagram::Hello), _) => {
                let counts =
                    ExchangeCounts { hellos: self.counts.hellos + 1, ..core::mem::take(&mut self.counts) };
                // A second hello of the peer keeps its pending answer.
                if sender == DatagramSender::Other || !self.connected {
                    *self = Self::new(self.joints);
                }
                (self.connected, self.counts) = (true, counts);
                return true;
            }
            (_, DatagramSender::Other) => {
                self.counts.other_senders += 1;
                return false;
            }
            (Err(why), DatagramSender::Peer) => {
                self.nonsense = true;
                self.counts.count_invalid(why);
                return false;
            }
            (Ok(ReceivedDatagram::Answer(answer)), DatagramSender::Peer) => answer,
        };
        match self.due {
            Some(due) if answer.tick > due => {
                self.nonsense = true;
                self.counts.count_invalid(InvalidDatagram::Ahead);
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

    /// Returns the command of the peer for this tick. To be called after all received datagrams have been handled.
    pub(super) fn step(&mut self, input: &ControllerInput, pace: &SpeedLimits) -> ControllerOutput {
        let (due, answer) = (self.due.take(), self.answer.take());
        let nonsense = core::mem::take(&mut self.nonsense);
        if answer.is_some() {
            self.counts.answers += 1;
        } else if due.is_some() {
            self.counts.missing += 1;
        }
        match (answer, due) {
            _ if nonsense => ControllerOutput::Bad(BadCycle::Nonsense),
            (Some(JointCommand::Velocity(velocity)), _) => {
                ControllerOutput::Move(pace.limit_velocities(velocity, input))
            }
            (Some(JointCommand::Position(goal)), _) => {
                ControllerOutput::Move(pace.velocities_towards(&goal, input))
            }
            (None, Some(_)) => ControllerOutput::Bad(BadCycle::NoAnswer),
            (None, None) => ControllerOutput::Bad(BadCycle::NoPeer),
        }
    }

    /// Records the result of sending the state of a tick.
    pub(super) fn record_send_result(&mut self, tick: u64, sent: SendResult) {
        match sent {
            SendResult::Taken => self.due = Some(tick),
            SendResult::QueueFull => {
                self.due = Some(tick);
                self.counts.unsent += 1;
            }
            SendResult::PeerGone => {
                self.connected = false;
                self.counts.gone += 1;
            }
        }
    }
}
