//! The results of commissioning a cell and a bus, and their texts.

use core::fmt;

use protocol::id::CellId;
use protocol::message::VERSION;
use protocol::packet::WORDS;
use protocol::parameters::{MissingAbility, Parameter};
use protocol::schema::reason;
use serde::{Serialize, Serializer};
use thiserror::Error;

use crate::decode::parameter::{ParameterName, ParameterWords};

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
    /// Returns the parameter of the request.
    pub(super) const fn parameter(self) -> Parameter {
        match self {
            Self::Write(parameter) | Self::Read(parameter) => parameter,
            Self::Commit => Parameter::Commit,
        }
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = ParameterName(self.parameter().number());
        match self {
            Self::Write(_) => write!(f, "a write of {name}"),
            Self::Commit => write!(f, "a commit"),
            Self::Read(_) => write!(f, "a read of {name}"),
        }
    }
}

/// The result of a cell; as JSON, the texts `outcome` and `why`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "outcome", content = "why", rename_all = "lowercase")]
pub enum Outcome {
    /// It was written, read back and compared.
    Written,
    /// Its hash matched the skin's configuration already.
    #[serde(rename = "already so")]
    AlreadySo,
    /// Its hash matched already, and all its parameters were read back and compared.
    Verified,
    /// A dry run: it would be written.
    #[serde(rename = "would be written")]
    WouldWrite,
    /// It failed. The cell has either its old configuration or all of the new one.
    Failed(Reason),
}

/// The reason why a cell was not commissioned.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Reason {
    /// It sent no heartbeat.
    #[error("is not on the bus: switch it on, or check its wiring")]
    Missing,
    /// Its heartbeats stopped.
    #[error("has gone from the bus")]
    Gone,
    /// Two cells have its serial number.
    #[error("is on the bus twice, with node ids {0} and {1}: give one of them another serial number")]
    Twins(CellId, CellId),
    /// Another cell uses its node id too.
    #[error("shares node id {number} with the cell of serial number {other}: switch one of them off")]
    Shared {
        /// The node id.
        number: CellId,
        /// The serial number of the other cell.
        other: u32,
    },
    /// It uses another version of the protocol.
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
        /// Number of transmissions.
        tries: u8,
    },
    /// It refused a request.
    #[error("refuses {step}: {}", reason(i64::from(*.code)))]
    Refused {
        /// The request.
        step: Step,
        /// The reason code in its answer.
        code: i16,
    },
    /// It lacks an ability that the skin needs.
    #[error("does not support {0}: install newer firmware, or leave it out of the skin")]
    Cannot(MissingAbility),
    /// Its answer differs from the written value.
    #[error(
        "answers {step} with {}, not {}",
        ParameterWords(.step.parameter().number(), *.got),
        ParameterWords(.step.parameter().number(), *.target)
    )]
    Differs {
        /// The request.
        step: Step,
        /// The expected words.
        target: [i16; WORDS],
        /// The words in its answer.
        got: [i16; WORDS],
    },
    /// The hash in its heartbeats does not match the parameters that it reads back.
    #[error("sends the configuration hash {got:04X} in its heartbeats, not {target:04X}")]
    Hash {
        /// The skin's hash.
        target: u16,
        /// The hash in its heartbeats.
        got: u16,
    },
    /// The commissioning ended before this cell was done.
    #[error("was not reached before the end; its configuration is complete, either the old or the new one")]
    Stopped,
}

impl Serialize for Reason {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// The reason for stopping the commissioning of a whole bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum AbortReason {
    /// Another gateway sends on the bus.
    OtherGateway,
    /// Another program writes parameters.
    Meddler,
}

impl AbortReason {
    /// Returns the text for users, with the name of the bus.
    #[must_use]
    pub fn on(self, bus: &str) -> String {
        match self {
            Self::OtherGateway => format!("another gateway is on {bus}: stop it first"),
            Self::Meddler => format!("another program configures cells on {bus}: wait until it has finished"),
        }
    }
}
