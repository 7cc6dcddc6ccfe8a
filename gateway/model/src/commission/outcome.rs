//! What became of a cell, and of a bus, in words.

use core::fmt;

use protocol::id::CellId;
use protocol::message::VERSION;
use protocol::packet::WORDS;
use protocol::parameters::{Ability, Parameter};
use protocol::schema::reason;
use serde::{Serialize, Serializer};
use thiserror::Error;

use crate::decode::parameter::{Name, Words};

/// A request to a cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Step {
    /// Stage a parameter.
    Write(Parameter),
    /// Store the staged parameters in flash, and use them.
    Commit,
    /// Read a parameter that is in use.
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
    /// It failed; the cell has either its old configuration or all of the new one.
    Failed(Reason),
}

/// Why a cell was not commissioned.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Reason {
    /// It sent no heartbeat.
    #[error("is not on the bus: switch it on, or look at its wires")]
    Missing,
    /// It sent heartbeats, and then no more.
    #[error("has gone from the bus")]
    Gone,
    /// Two cells have its serial number.
    #[error("is there twice, with the node ids {0} and {1}: give one of them another serial number")]
    Twins(CellId, CellId),
    /// Another cell uses its node id too.
    #[error("shares node id {number} with the cell of serial number {other}: switch one of them off")]
    Shared {
        /// The node id.
        number: CellId,
        /// The serial number of the other cell.
        other: u32,
    },
    /// It speaks another version of the protocol.
    #[error("speaks version {got} of the protocol, and this program {VERSION}: bring both to one version")]
    Version {
        /// Its version.
        got: u16,
    },
    /// It did not answer a request.
    #[error("does not answer {step}, sent {tries} times")]
    Silent {
        /// The request.
        step: Step,
        /// How often.
        tries: u8,
    },
    /// It refused a request.
    #[error("refuses {step}: {}", reason(i64::from(*.code)))]
    Refused {
        /// The request.
        step: Step,
        /// Its reason.
        code: i16,
    },
    /// It cannot compute what the skin asks for.
    #[error("cannot have {0}: give it newer firmware, or leave it out of the skin")]
    Cannot(Ability),
    /// Its answer differs from what was written.
    #[error(
        "answers {step} with {}, not {}",
        Words(.step.parameter().number(), *.got),
        Words(.step.parameter().number(), *.target)
    )]
    Differs {
        /// The request.
        step: Step,
        /// What should be there.
        target: [i16; WORDS],
        /// What it answered.
        got: [i16; WORDS],
    },
    /// The hash in its heartbeats is not that of the parameters it reads back.
    #[error("sends the configuration hash {got:04X} in its heartbeats, not {target:04X}")]
    Hash {
        /// That of the skin.
        target: u16,
        /// Its own.
        got: u16,
    },
    /// It ended before its turn was over.
    #[error("was not reached before the end; its configuration is complete, either the old or the new one")]
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
