//! What a cell computes with, and what somebody is about to make it compute with.
//!
//! Writes go to a staged copy. A commit that names the staged copy's hash takes it into flash, and then
//! into use, as a whole: a cell that is interrupted between two writes keeps computing with what it had.

use protocol::message::{Answer, SkinSensors};
use protocol::packet::WORDS;
use protocol::parameters::{Parameter, ParameterError, Parameters};

use crate::contact::Force;
use crate::kernel::{Kernel, Wrench};

/// What flash held when the cell started.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Flash {
    /// Nothing yet.
    Empty,
    /// Something that its CRC does not vouch for.
    Damaged,
    /// Sound parameters.
    Sound(Parameters),
}

/// Parameters in use, with the kernel that was made of them.
#[derive(Debug)]
pub(super) struct InUse {
    /// The words.
    pub(super) parameters: Parameters,
    /// What computes with them.
    pub(super) kernel: Wrench,
    hash: u16,
}

/// What a write leads to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Written {
    /// The answer, at once.
    Answer(Answer),
    /// Flash has to be written first; then [`Configuration::stored`] gives the answer.
    Store(Parameters),
}

/// The parameters in use, and the staged ones.
#[derive(Debug)]
pub(super) struct Configuration {
    in_use: Option<InUse>,
    staged: Parameters,
}

impl Configuration {
    /// Starts with what flash held; parameters that cannot be are not used.
    #[must_use]
    pub(super) fn new(flash: &Flash) -> Self {
        let mut configuration = Self { in_use: None, staged: Parameters::default() };
        if let Flash::Sound(parameters) = *flash
            && parameters.check().is_ok()
        {
            configuration.activate(parameters);
        }
        configuration
    }

    /// The parameters in use, if the cell is configured.
    #[must_use]
    pub(super) const fn in_use(&self) -> Option<&InUse> {
        self.in_use.as_ref()
    }

    /// Hash of the parameters in use; 0 while there are none.
    #[must_use]
    pub(super) fn hash(&self) -> u16 {
        self.in_use.as_ref().map_or(0, |in_use| in_use.hash)
    }

    /// The words of a stored parameter: those in use, or of an unconfigured cell the staged ones.
    #[must_use]
    pub(super) fn read(&self, parameter: Parameter) -> [i16; WORDS] {
        self.in_use.as_ref().map_or(&self.staged, |in_use| &in_use.parameters).words(parameter)
    }

    /// Stages one parameter, or commits what is staged.
    pub(super) fn write(&mut self, parameter: Parameter, words: [i16; WORDS]) -> Written {
        if parameter == Parameter::Commit {
            return self.commit(words);
        }
        let number = parameter.number();
        Written::Answer(match self.staged.set(parameter, words) {
            Ok(()) => Answer::Value { number, written: true, words },
            Err(error) => refused(parameter, &error),
        })
    }

    fn commit(&self, words: [i16; WORDS]) -> Written {
        let [hash, ..] = words;
        if let Err(error) = self.staged.check() {
            return Written::Answer(refused(Parameter::Commit, &error));
        }
        if self.staged.hash() != hash.cast_unsigned() {
            let number = Parameter::Commit.number();
            return Written::Answer(Answer::Refused { number, reason: Answer::WRONG_HASH });
        }
        Written::Store(self.staged)
    }

    /// Flash was written, or could not be: takes the parameters into use, or leaves everything as it is.
    pub(super) fn stored(&mut self, parameters: Parameters, written: bool) -> Answer {
        let number = Parameter::Commit.number();
        if !written {
            return Answer::Refused { number, reason: Answer::FLASH_FAILED };
        }
        self.activate(parameters);
        Answer::Value { number, written: true, words: [parameters.hash().cast_signed(), 0, 0, 0, 0, 0] }
    }

    fn activate(&mut self, parameters: Parameters) {
        self.staged = parameters;
        self.in_use = Some(InUse { parameters, kernel: Wrench::new(&parameters), hash: parameters.hash() });
    }
}

impl InUse {
    /// The force that is felt, by Algorithm 1.
    #[must_use]
    pub(super) fn force(&self, sensors: &SkinSensors) -> Force {
        Force::fuse(sensors.contact, sensors.proximity, &self.parameters.contact)
    }
}

fn refused(parameter: Parameter, error: &ParameterError) -> Answer {
    Answer::Refused { number: parameter.number(), reason: error.code() }
}
