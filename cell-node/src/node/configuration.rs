//! The parameters in use by a cell, and the staged parameters.
//!
//! Writes go to a staged copy. A commit with the hash of the staged copy stores it in flash and then
//! activates it, as a whole. A cell that is interrupted between two writes keeps its previous parameters.

use protocol::message::Answer;
use protocol::packet::{Length, WORDS};
use protocol::parameters::{Parameter, ParameterError, Parameters};
use protocol::time::Span;

use crate::kernel::Wrench;

/// The parameters in use, with the kernel prepared from them.
#[derive(Debug)]
pub(super) struct ActiveParameters {
    /// The parameters.
    pub(super) parameters: Parameters,
    /// The kernel.
    pub(super) kernel: Wrench,
    hash: u16,
}

/// The parameters in use, and the staged ones.
#[derive(Debug)]
pub(super) struct Configuration {
    is_configured: bool,
    /// The parameters in use; valid only if the cell is configured. This is not an `Option`, because a new value of an
    /// `Option` would be built on the stack and copied.
    in_use: ActiveParameters,
    staged: Parameters,
}

impl Configuration {
    /// Creates the configuration of an unconfigured cell.
    #[inline(never)]
    pub(super) fn new() -> Self {
        let parameters = Parameters::default();
        let in_use = ActiveParameters { parameters, kernel: Wrench::empty(), hash: 0 };
        Self { is_configured: false, in_use, staged: parameters }
    }

    /// Computes with the sine of another build from now on.
    #[cfg(feature = "earlier-sine")]
    pub(super) const fn set_sine(&mut self, sine: protocol::sine::SineMethod) {
        self.in_use.kernel.set_sine(sine);
    }

    /// Activates the parameters from flash, unless they are invalid.
    pub(super) fn restore_parameters(&mut self, parameters: &Parameters) {
        if parameters.check().is_ok() {
            self.activate(parameters);
        }
    }

    /// Returns the parameters in use; `None` if the cell is not configured.
    pub(super) fn active_parameters(&self) -> Option<&ActiveParameters> {
        self.is_configured.then_some(&self.in_use)
    }

    /// Returns the hash of the parameters in use; 0 for an unconfigured cell.
    pub(super) fn parameters_hash(&self) -> u16 {
        self.active_parameters().map_or(0, |in_use| in_use.hash)
    }

    /// Returns the words of a stored parameter: those in use, or if the cell is not configured the staged ones.
    pub(super) fn stored_parameter_words(&self, parameter: Parameter) -> [i16; WORDS] {
        self.active_parameters().map_or(&self.staged, |in_use| &in_use.parameters).words(parameter)
    }

    /// Stages one parameter. Returns the staged words, or the reason of the refusal.
    pub(super) fn stage_parameter(
        &mut self,
        parameter: Parameter,
        words: [i16; WORDS],
    ) -> Result<[i16; WORDS], i16> {
        self.staged.set(parameter, words).map_err(ParameterError::code)?;
        Ok(self.staged.words(parameter))
    }

    /// Returns the staged parameters for a commit with this hash. Returns the reason of a refusal if they are invalid
    /// or have another hash.
    pub(super) fn staged_for_commit(&self, [hash, ..]: [i16; WORDS]) -> Result<&Parameters, i16> {
        self.staged.check().map_err(ParameterError::code)?;
        if self.staged.hash() == hash.cast_unsigned() {
            Ok(&self.staged)
        } else {
            Err(Answer::REFUSED_WRONG_HASH)
        }
    }

    /// Activates these parameters and prepares the kernel.
    pub(super) fn activate(&mut self, parameters: &Parameters) {
        self.staged = *parameters;
        self.in_use.parameters = *parameters;
        self.in_use.kernel.prepare(parameters);
        self.in_use.hash = parameters.hash();
        self.is_configured = true;
    }
}

impl ActiveParameters {
    /// Returns the packet length of joints, torques and sums for this chain.
    pub(super) fn packet_length(&self) -> Length {
        Length::for_joints(self.parameters.joints.into())
    }

    /// Returns the period of the joint broadcast.
    pub(super) fn broadcast_period(&self) -> Span {
        Span(self.parameters.period_us.into())
    }
}
