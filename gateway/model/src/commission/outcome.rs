//! What became of a cell, and of a bus, in words.

use core::fmt;

use protocol::id::CellId;
use protocol::message::VERSION;
use protocol::packet::WORDS;
use protocol::parameters::Parameter;
use protocol::schema::reason;
use serde::{Serialize, Serializer};
use thiserror::Error;

use crate::decode::parameter::{Name, Words};

/// What a cell is asked.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Step {
    /// To stage a parameter.
    Write(Parameter),
    /// To take what is staged into flash and into use.
    Commit,
    /// To say a parameter that is in use.
    Read(Parameter),
}

impl Step {
    /// The parameter that it is about.
    pub(super) const fn parameter(self) -> Parameter {
        match self {
            Self::Write(parameter) | Self::Read(parameter) => parameter,
            Self::Commit => Parameter::Commit,
        }
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Name(self.parameter().number());
        match self {
            Self::Write(_) => write!(f, "a write of {name}"),
            Self::Commit => write!(f, "a commit"),
            Self::Read(_) => write!(f, "a read of {name}"),
        }
    }
}

/// What became of a cell; as JSON in words, `outcome` and `why`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "outcome", content = "why", rename_all = "lowercase")]
pub enum Outcome {
    /// It was written, read back and compared.
    Written,
    /// It had the skin's configuration already, by its hash.
    #[serde(rename = "already so")]
    AlreadySo,
    /// It had it already, and every word was read and compared.
    Verified,
    /// It would be written, if this were no dry run.
    #[serde(rename = "would be written")]
    WouldWrite,
    /// It could not be done; it computes with what it had before, or with all of the new.
    Failed(Reason),
}

/// Why a cell was not commissioned.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Reason {
    /// It was not heard.
    #[error("is not on the bus: switch it on, or look at its wires")]
    Missing,
    /// It was heard, and then no more.
    #[error("has gone from the bus")]
    Gone,
    /// Two cells say that they are it.
    #[error("is there twice, under the numbers {0} and {1}: give one of them another serial number")]
    Twins(CellId, CellId),
    /// Its number is not its own.
    #[error("shares the number {number} with the cell of serial number {other}: switch one of them off")]
    Shared {
        /// The number.
        number: CellId,
        /// The other's serial number.
        other: u32,
    },
    /// It speaks another version of the protocol.
    #[error("speaks version {got} of the protocol, and this program {VERSION}: bring both to one version")]
    Version {
        /// Its version.
        got: u16,
    },
    /// It said nothing to a request.
    #[error("does not answer {step}, asked {tries} times")]
    Silent {
        /// What it was asked.
        step: Step,
        /// How often.
        tries: u8,
    },
    /// It will not.
    #[error("refuses {step}: {}", reason(i64::from(*.code)))]
    Refused {
        /// What it was asked.
        step: Step,
        /// Its reason.
        code: i16,
    },
    /// It says something else than what it was told.
    #[error(
        "answers {step} with {}, not {}",
        Words(.step.parameter().number(), *.got),
        Words(.step.parameter().number(), *.target)
    )]
    Differs {
        /// What it was asked.
        step: Step,
        /// What should be there.
        target: [i16; WORDS],
        /// What it says.
        got: [i16; WORDS],
    },
    /// It says another hash than that of what it reads back.
    #[error("says the configuration hash {got:04X} in its heartbeats, not {target:04X}")]
    Hash {
        /// That of the skin.
        target: u16,
        /// Its own.
        got: u16,
    },
    /// It ended before its turn was over.
    #[error("was not reached before the end; what it has is whole, the old or the new")]
    Stopped,
}

impl Serialize for Reason {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Why a whole bus is left alone from some moment on.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Trouble {
    /// Another gateway speaks.
    OtherGateway,
    /// Somebody else writes parameters.
    Meddler,
}

impl Trouble {
    /// The same for people, of the bus of this name.
    #[must_use]
    pub fn on(self, bus: &str) -> String {
        match self {
            Self::OtherGateway => format!("another gateway is on {bus}: stop it first"),
            Self::Meddler => format!("somebody else configures cells on {bus}: let that end first"),
        }
    }
}
