//! The state of a cell before the test, which is restored after it.

use std::collections::BTreeMap;

use protocol::message::{Answer, Message, State};
use protocol::packet::{WORDS, padded_words};
use protocol::parameters::Parameter;
use protocol::time::Span;
use serde::{Deserialize, Serialize};

use crate::bus::StopReason;
use crate::session::{Reply, Session};

/// The time limit for restoring the state.
const RESTORE_TIMEOUT: Span = Span::from_millis(8_000);
/// The time after which no more answers to requests of the test come.
const ANSWER_SETTLE_TIME: Span = Span::from_millis(60);
const RESTORE_ATTEMPTS: usize = 3;

/// The volatile parameters, which are saved and restored.
const VOLATILE_PARAMETERS: [Parameter; 6] = [
    Parameter::Reply,
    Parameter::Sensing,
    Parameter::Events,
    Parameter::Baseline,
    Parameter::LinksDown,
    Parameter::Mode,
];

/// The state of a cell before the test.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq, Serialize)]
pub struct SavedCell {
    /// The name of the cell's bus.
    pub bus: String,
    /// The cell's node id.
    pub node: u8,
    /// The cell's serial number.
    pub serial: u32,
    /// The hash of the cell's configuration, or 0 without a configuration.
    pub hash: u16,
    /// True if the cell was halted.
    pub halted: bool,
    /// The words of the cell's parameters, by number.
    pub parameters: BTreeMap<u8, [i16; WORDS]>,
}

impl Session<'_> {
    /// Reads the state of the cell. The inner error is a text that names a parameter whose read the cell does not
    /// answer.
    ///
    /// # Errors
    /// Returns [`StopReason`] if the bus fails, or if the test is interrupted.
    pub fn save(&mut self) -> Result<Result<SavedCell, String>, StopReason> {
        let Reply::Value(identity) = self.read_parameter(Parameter::Identity.number())? else {
            return Ok(Err("the cell does not answer a read of parameter 0 (identity)".to_owned()));
        };
        let [low, high, _, hash, state, abilities] = identity.map(i16::cast_unsigned);
        let serial = u32::from(low) | u32::from(high) << 16;
        let abilities = protocol::parameters::Abilities::from_word(abilities.cast_signed());
        let mut parameters = BTreeMap::new();
        let all = Parameter::stored_for_rows(abilities.max_rows()).chain(VOLATILE_PARAMETERS);
        for parameter in all.collect::<Vec<_>>() {
            let number = parameter.number();
            match self.read_parameter(number)? {
                Reply::Value(words) => _ = parameters.insert(number, words),
                // A cell that implements the protocol without baselines.
                Reply::Refused(Answer::REFUSED_UNKNOWN_PARAMETER) if parameter == Parameter::Baseline => {}
                Reply::Refused(_) | Reply::Nothing => {
                    return Ok(Err(format!("the cell does not answer a read of parameter {number}")));
                }
            }
        }
        self.about.serial = Some(serial);
        self.about.abilities = abilities;
        let halted = State(state).has(State::HALTED);
        let (bus, node) = (self.bus_name().to_owned(), self.cell.get());
        Ok(Ok(SavedCell { bus, node, serial, hash, halted, parameters }))
    }

    /// Restores the state of the cell, and returns descriptions of the parts that could not be restored.
    ///
    /// # Errors
    /// Returns [`StopReason`] if the bus fails.
    pub fn restore(&mut self, saved: &SavedCell) -> Result<Vec<String>, StopReason> {
        let mut left = Vec::new();
        self.set_remaining_time(RESTORE_TIMEOUT);
        // Lets late answers to the test pass, so that they do not count as answers to this.
        self.receive_for(ANSWER_SETTLE_TIME)?;
        self.begin_expected_exchange();
        self.send_messages(&[Message::Resume])?;
        if saved.hash == 0 {
            left.push(
                "the cell keeps the configuration of the test: it had none before, and a configuration \
                 cannot be erased"
                    .to_owned(),
            );
        } else if !self.restore_stored_parameters(saved)? {
            left.push(format!(
                "the cell's earlier configuration (hash {:04X}) could not be stored again",
                saved.hash
            ));
        }
        for parameter in VOLATILE_PARAMETERS {
            let Some(words) = saved.parameters.get(&parameter.number()) else { continue };
            // Links are written in test mode only, and the test does not change them.
            if parameter == Parameter::LinksDown && *words == [0; WORDS] {
                continue;
            }
            let mut is_back = false;
            for _ in 0..RESTORE_ATTEMPTS {
                is_back = self.write_parameter(parameter.number(), *words)? == Reply::Value(*words);
                if is_back {
                    break;
                }
            }
            if !is_back {
                left.push(format!("parameter {} could not be written", parameter.number()));
            }
        }
        self.send_messages(&[if saved.halted { Message::Halt } else { Message::Resume }])?;
        Ok(left)
    }

    fn restore_stored_parameters(&mut self, saved: &SavedCell) -> Result<bool, StopReason> {
        for _ in 0..RESTORE_ATTEMPTS {
            let mut is_well = true;
            for (&number, &words) in &saved.parameters {
                if Parameter::from_number(number).is_some_and(Parameter::is_stored) {
                    is_well &= self.write_parameter(number, words)? == Reply::Value(words);
                }
            }
            let hash = padded_words([saved.hash.cast_signed()]);
            is_well &= self.write_parameter(Parameter::Commit.number(), hash)? == Reply::Value(hash);
            if is_well {
                return Ok(true);
            }
        }
        Ok(false)
    }
}
