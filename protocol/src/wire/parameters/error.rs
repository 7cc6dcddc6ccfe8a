//! Why a parameter is refused.

use thiserror::Error;

use super::{MAX_JOINTS, MAX_ROWS};

/// Why words cannot be taken for a parameter.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum ParameterError {
    /// No such number, or one that cannot be written this way.
    #[error("parameter {0} cannot be written")]
    NotWritable(u8),
    /// The number of joints.
    #[error("{got} joints; 1 to {MAX_JOINTS} are possible")]
    Joints {
        /// What was asked for.
        got: i16,
    },
    /// The joint that moves the cell.
    #[error("joint {got} does not exist; the chain has joints 1 to {joints}")]
    Joint {
        /// What was asked for.
        got: i16,
        /// How many there are.
        joints: i16,
    },
    /// The normal's length.
    #[error("the outward normal has length^2 {got} / 2^28; within 1/64 of 2^28 is allowed")]
    Normal {
        /// Its square, in steps of 2^-28.
        got: i64,
    },
    /// A threshold below zero, or a gain.
    #[error("word {word} of the contact parameter is {got}; it must not be negative")]
    Negative {
        /// Which word, from 0.
        word: u8,
        /// What it is.
        got: i16,
    },
    /// The broadcast period.
    #[error("a joint broadcast every 0 us is not possible")]
    Period,
    /// The number of rows, or their joints.
    #[error("{got} rows; a row for each of the {joints} joints is needed, and {MAX_ROWS} are possible")]
    Rows {
        /// How many rows there should be.
        got: i16,
        /// How many joints there are.
        joints: i16,
    },
    /// The row that carries the cell.
    #[error("row {got} of {rows} does not follow the joint that moves the cell")]
    Row {
        /// What was asked for.
        got: i16,
        /// How many there are.
        rows: i16,
    },
    /// The kind of a row.
    #[error("row {row} has kind {got}; 0 revolute, 1 prismatic and 2 fixed are possible")]
    Kind {
        /// Which row, from 1.
        row: u8,
        /// What was asked for.
        got: i16,
    },
    /// The torque format.
    #[error("torque format {got} does not exist: 0 Q3.12, 1 Q5.10, 2 Q7.8 do")]
    Format {
        /// What was asked for.
        got: i16,
    },
}

impl ParameterError {
    /// The number that stands for this error in a refusal.
    #[must_use]
    pub const fn code(self) -> i16 {
        match self {
            Self::NotWritable(_) => 1,
            Self::Joints { .. } => 2,
            Self::Joint { .. } => 3,
            Self::Normal { .. } => 4,
            Self::Negative { .. } => 5,
            Self::Period => 6,
            Self::Rows { .. } => 7,
            Self::Row { .. } => 8,
            Self::Kind { .. } => 9,
            Self::Format { .. } => 10,
        }
    }
}
