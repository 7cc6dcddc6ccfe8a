//! The parameters that a cell computes with, and the staged ones.
//!
//! Writes go to a staged copy. A commit that names the staged copy's hash takes it into flash, and then
//! into use, as a whole: a cell that is interrupted between two writes keeps computing with what it had.

use protocol::message::Answer;
use protocol::packet::{Length, WORDS};
use protocol::parameters::{Parameter, ParameterError, Parameters};
use protocol::time::Span;

use crate::kernel::Wrench;

/// Parameters in use, with the kernel that was made of them.
#[derive(Debug)]
pub(super) struct InUse {
    /// The words.
    pub(super) parameters: Parameters,
    /// What computes with them.
    pub(super) kernel: Wrench,
    hash: u16,
}

/// The parameters in use, and the staged ones.
#[derive(Debug)]
pub(super) struct Configuration {
    is_configured: bool,
    /// Only if the cell is configured. No `Option`, because a new one would be built on the stack and copied.
    in_use: InUse,
    staged: Parameters,
}

impl Configuration {
    /// Of a cell that is not configured.
    #[inline(never)]
    pub(super) fn new() -> Self {
        let parameters = Parameters::default();
        let in_use = InUse { parameters, kernel: Wrench::nothing(), hash: 0 };
        Self { is_configured: false, in_use, staged: parameters }
    }

    /// Starts with what flash held; parameters that cannot be are not used.
    pub(super) fn start(&mut self, parameters: &Parameters) {
        if parameters.check().is_ok() {
            self.activate(parameters);
        }
    }

    /// The parameters in use, if the cell is configured.
    pub(super) fn in_use(&self) -> Option<&InUse> {
        self.is_configured.then_some(&self.in_use)
    }

    /// Hash of the parameters in use; 0 while there are none.
    pub(super) fn hash(&self) -> u16 {
        self.in_use().map_or(0, |in_use| in_use.hash)
    }

    /// The words of a stored parameter: those in use, or of an unconfigured cell the staged ones.
    pub(super) fn read(&self, parameter: Parameter) -> [i16; WORDS] {
        self.in_use().map_or(&self.staged, |in_use| &in_use.parameters).words(parameter)
    }

    /// Stages one parameter; the words that are staged now, or why not.
    pub(super) fn stage(&mut self, parameter: Parameter, words: [i16; WORDS]) -> Result<[i16; WORDS], i16> {
        self.staged.set(parameter, words).map_err(ParameterError::code)?;
        Ok(self.staged.words(parameter))
    }

    /// What is staged, if it can be and has the hash that a commit names; else why not.
    pub(super) fn staged_with(&self, [hash, ..]: [i16; WORDS]) -> Result<&Parameters, i16> {
        self.staged.check().map_err(ParameterError::code)?;
        if self.staged.hash() == hash.cast_unsigned() { Ok(&self.staged) } else { Err(Answer::WRONG_HASH) }
    }

    /// Takes parameters into use.
    pub(super) fn activate(&mut self, parameters: &Parameters) {
        self.staged = *parameters;
        self.in_use.parameters = *parameters;
        self.in_use.kernel.prepare(parameters);
        self.in_use.hash = parameters.hash();
        self.is_configured = true;
    }
}

impl InUse {
    /// How long joints, torques and sums are.
    pub(super) fn length(&self) -> Length {
        Length::for_joints(self.parameters.joints.into())
    }

    /// From one joint broadcast to the next.
    pub(super) fn period(&self) -> Span {
        Span(self.parameters.period_us.into())
    }
}
