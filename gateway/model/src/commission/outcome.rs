//! The results of commissioning a cell and a bus, and their texts.

use core::fmt;

use protocol::id::CellId;
use protocol::message::VERSION;
use protocol::packet::WORDS;
use protocol::parameters::{MissingAbility, Parameter};
use protocol::schema::refusal_reason;
use serde::{Serialize, Serializer};
use thiserror::Error;

use crate::decode::parameter::{ParameterName, ParameterWords};

/// A step of the commissioning of a cell: a request that is sent to it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum RequestStep {
    /// Stage a parameter.
    Write(Parameter),
    /// Store the staged parameters in flash, and use them.
    Commit,
    /// Read a parameter that is in use.
    Read(Parameter),
}

impl RequestStep {
    /// Returns the parameter of the request.
    pub(super) const fn parameter(self) -> Parameter {
        match self {
            Self::Write(parameter) | Self::Read(parameter) => parameter,
            Self::Commit => Parameter::Commit,
        }
    }
}

impl fmt::Display for RequestStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = ParameterName(self.parameter().number());
        match self {
            Self::Write(_) => write!(f, "a write of {name}"),
            Self::Commit => write!(f, "a commit"),
            Self::Read(_) => write!(f, "a read of {name}"),
        }
    }
}

/// The result of commissioning a cell; serialised as the texts `outcome` and `why`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "outcome", content = "why", rename_all = "lowercase")]
pub enum Outcome {
    /// The parameters were written, read back and compared.
    Written,
    /// The cell was skipped, because its hash already matched the skin's configuration.
    #[serde(rename = "already so")]
    AlreadySo,
    /// The hash of the cell already matched; all its parameters were read back and compared.
    Verified,
    /// The cell would be written, but this was a dry run.
    #[serde(rename = "would be written")]
    WouldWrite,
    /// The commissioning of the cell failed. The cell has either its old configuration or all of the new one.
    Failed(FailureReason),
}

/// The reason why a cell was not commissioned.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum FailureReason {
    /// The cell sent no heartbeat.
    #[error("is not on the bus: switch it on, or check its wiring")]
    Missing,
    /// The heartbeats of the cell stopped.
    #[error("has disappeared from the bus")]
    Gone,
    /// Two cells, with these node ids, have the same serial number.
    #[error("is on the bus twice, with node ids {0} and {1}: give one of them another serial number")]
    Twins(CellId, CellId),
    /// Another cell uses the same node id.
    #[error("shares node id {number} with the cell of serial number {other}: switch one of them off")]
    Shared {
        /// The shared node id.
        number: CellId,
        /// The serial number of the other cell.
        other: u32,
    },
    /// The cell uses another version of the protocol.
    #[error(
        "uses protocol version {got}, but this program uses version {VERSION}: install matching versions"
    )]
    Version {
        /// The version that the cell reports.
        got: u16,
    },
    /// The cell did not answer a request.
    #[error("did not answer {step}, although it was sent {tries} times")]
    Silent {
        /// The unanswered request.
        step: RequestStep,
        /// Number of transmissions.
        tries: u8,
    },
    /// The cell refused a request.
    #[error("refused {step}: {}", refusal_reason(i64::from(*.code)))]
    Refused {
        /// The refused request.
        step: RequestStep,
        /// The reason code in the answer of the cell.
        code: i16,
    },
    /// The cell lacks an ability that the skin needs.
    #[error("does not support {0}: install newer firmware, or change the skin file so that it is not needed")]
    Cannot(MissingAbility),
    /// The answer of the cell differs from the written value.
    #[error(
        "answered {step} with {} instead of {}",
        ParameterWords(.step.parameter().number(), *.got),
        ParameterWords(.step.parameter().number(), *.target)
    )]
    Differs {
        /// The request that was answered.
        step: RequestStep,
        /// The expected words.
        target: [i16; WORDS],
        /// The words in the answer.
        got: [i16; WORDS],
    },
    /// The hash in the heartbeats of the cell does not match the parameters that it reads back.
    #[error("has configuration hash {got:04X} in its heartbeats, not {target:04X}")]
    Hash {
        /// The hash of the skin's configuration for the cell.
        target: u16,
        /// The hash in the heartbeats of the cell.
        got: u16,
    },
    /// The commissioning ended before this cell was done.
    #[error("was not finished before commissioning ended; its configuration is either all old or all new")]
    Stopped,
}

impl Serialize for FailureReason {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// The reason for stopping the commissioning of a whole bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum AbortReason {
    /// Another gateway sends on the bus.
    OtherGateway,
    /// Another program writes parameters of cells on the bus.
    OtherWriter,
}

impl AbortReason {
    /// Returns the reason as a sentence for users, with the name of the bus.
    #[must_use]
    pub fn describe(self, bus: &str) -> String {
        match self {
            Self::OtherGateway => format!("another gateway is on {bus}: stop it first"),
            Self::OtherWriter => {
                format!("another program is configuring cells on {bus}: wait until it has finished")
            }
        }
    }
}
