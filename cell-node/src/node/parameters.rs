//! Reading and writing of a cell's parameters over the bus.

use protocol::message::{Answer, Message, Request, State, VERSION};
use protocol::packet::WORDS;
use protocol::parameters::{
    Abilities, Baseline, Events, LinksDown, Parameter, Parameters, ReplyKind, Sensing, TareCommand,
};
use protocol::time::Micros;

use super::Node;
use crate::baseline::TareRefusal;

/// Volatile parameters that are set at run time: 6 to 9.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct VolatileParameters {
    /// The message with which the cell replies to joints.
    reply: ReplyKind,
    /// The times at which the cell sends measurements.
    pub(super) sensing: Sensing,
    /// The thresholds of event mode.
    pub(super) events: Events,
    /// The ports whose messages and sums are ignored.
    links_down: LinksDown,
}

/// The contents that are being written to flash.
#[derive(Clone, Copy, Debug)]
#[expect(clippy::large_enum_variant, reason = "a cell has no heap")]
pub(super) enum PendingStore {
    /// Committed parameters, with the tag of the commit, which is answered after the write.
    Parameters(Parameters, u8),
    /// The node id that the network assigned.
    NodeId,
}

impl Node {
    /// Handles a request to read or write a parameter, and answers it. A commit is answered after the write to flash.
    pub(super) fn handle_request(&mut self, now: Micros, tag: u8, request: Request) {
        let (written, number) = match request {
            Request::Read { number } => (false, number),
            Request::Write { number, .. } => (true, number),
        };
        let words = match (Parameter::from_number(number), request) {
            (None, _) => Err(Answer::REFUSED_UNKNOWN_PARAMETER),
            (Some(parameter), Request::Read { .. }) => Ok(self.read_parameter(parameter)),
            (Some(Parameter::Commit), Request::Write { words, .. }) => {
                match self.configuration.staged_for_commit(words) {
                    Ok(parameters) => {
                        self.storing = Some(PendingStore::Parameters(*parameters, tag));
                        return;
                    }
                    Err(reason) => Err(reason),
                }
            }
            (Some(parameter), Request::Write { words, .. }) => self.write_parameter(now, parameter, words),
        };
        self.answer_request(tag, number, written, words);
    }

    /// Handles the result of writing to flash. `written` is true if the write succeeded.
    pub fn handle_stored(&mut self, written: bool) {
        // A node id that could not be stored is assigned again after the next start.
        let Some(PendingStore::Parameters(parameters, tag)) = &self.storing else {
            self.storing = None;
            return;
        };
        let tag = *tag;
        if written {
            self.configuration.activate(parameters);
            self.flags = self.flags.with_flags(State::FLASH_DAMAGED, false);
        }
        self.storing = None;
        let hash = || pad_with_zeros([self.configuration.parameters_hash().cast_signed()]);
        let words = written.then(hash).ok_or(Answer::REFUSED_FLASH_FAILED);
        self.answer_request(tag, Parameter::Commit.number(), true, words);
    }

    /// Answers a request with the words of the parameter, or with the reason of a refusal.
    fn answer_request(&mut self, tag: u8, number: u8, written: bool, words: Result<[i16; WORDS], i16>) {
        let Some(from) = self.identity.cell else { return };
        let answer = match words {
            Ok(words) => Answer::Value { number, written, words },
            Err(reason) => Answer::Refused { number, reason },
        };
        self.queue_message(Message::Configured { from, tag, answer });
    }

    fn read_parameter(&self, parameter: Parameter) -> [i16; WORDS] {
        match parameter {
            Parameter::Identity => self.identity_words(),
            Parameter::Mode => pad_with_zeros([self.flags.has(State::TEST_MODE).into()]),
            Parameter::Reply => self.switches.reply.words(),
            Parameter::Sensing => self.switches.sensing.words(),
            Parameter::Events => self.switches.events.words(),
            Parameter::LinksDown => self.switches.links_down.words(),
            Parameter::Baseline => self.baseline.rule().words(),
            Parameter::Tare => pad_with_zeros([self.baseline.is_tared().into()]),
            Parameter::Mount
            | Parameter::Pose
            | Parameter::Contact
            | Parameter::Timing
            | Parameter::Row(_)
            | Parameter::Commit => self.configuration.stored_parameter_words(parameter),
        }
    }

    /// Sets a volatile parameter at once, or stages a stored one. Returns the new words, or the reason of a refusal. A
    /// cell without ports refuses sums and `links_down`; links can be interrupted only in test mode.
    fn write_parameter(
        &mut self,
        now: Micros,
        parameter: Parameter,
        words: [i16; WORDS],
    ) -> Result<[i16; WORDS], i16> {
        let (switches, has_ports) = (&mut self.switches, self.summing.network.has_wires());
        let set = match parameter {
            Parameter::Reply => ReplyKind::from_words(words)
                .filter(|reply| has_ports || *reply == ReplyKind::Torque)
                .map(|reply| switches.reply = reply),
            Parameter::Sensing => Sensing::from_words(words).map(|sensing| switches.sensing = sensing),
            Parameter::Events => Events::from_words(words).map(|events| switches.events = events),
            Parameter::LinksDown => Some(LinksDown::from_words(words))
                .filter(|links_down| self.flags.has(State::TEST_MODE) && (has_ports || links_down.ports == 0))
                .map(|links_down| switches.links_down = links_down),
            Parameter::Mode => {
                self.flags = self.flags.with_flags(State::TEST_MODE, words.first() == Some(&1));
                self.stimuli.clear();
                self.baseline.reset_zero();
                Some(())
            }
            Parameter::Baseline => Baseline::from_words(words).map(|rule| self.baseline.set_rule(rule)),
            Parameter::Tare => {
                let how = TareCommand::from_words(words).ok_or(Answer::REFUSED_INVALID_WORDS)?;
                let done = self.baseline.tare(&self.stimuli.sensed.skin, how);
                return done.map(|()| self.read_parameter(parameter)).map_err(|why| match why {
                    TareRefusal::Off => Answer::REFUSED_INVALID_WORDS,
                    TareRefusal::Touched => Answer::REFUSED_CELL_TOUCHED,
                    TareRefusal::Limit => Answer::REFUSED_ABOVE_BASELINE_LIMIT,
                });
            }
            Parameter::Identity
            | Parameter::Mount
            | Parameter::Pose
            | Parameter::Contact
            | Parameter::Timing
            | Parameter::Row(_)
            | Parameter::Commit => return self.configuration.stage_parameter(parameter, words),
        };
        self.summing.network.ignored_ports = switches.links_down.ports;
        self.summing.sum.set_schedule(match switches.reply {
            ReplyKind::Torque => None,
            ReplyKind::Sum(slots) => Some(slots),
        });
        self.apply_network_changes(now);
        set.ok_or(Answer::REFUSED_INVALID_WORDS).map(|()| self.read_parameter(parameter))
    }

    fn identity_words(&self) -> [i16; WORDS] {
        let [a, b, c, d] = self.identity.serial.to_le_bytes();
        pad_with_zeros([
            i16::from_le_bytes([a, b]),
            i16::from_le_bytes([c, d]),
            VERSION.into(),
            self.configuration.parameters_hash().cast_signed(),
            self.state().0.cast_signed(),
            Abilities::ALL.word(),
        ])
    }
}

/// Returns these words, padded with zeros.
pub(super) fn pad_with_zeros<const N: usize>(first: [i16; N]) -> [i16; WORDS] {
    let mut first = first.into_iter();
    core::array::from_fn(|_| first.next().unwrap_or(0))
}
