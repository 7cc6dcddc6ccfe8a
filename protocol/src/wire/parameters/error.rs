//! Errors of parameters.

use thiserror::Error;

use super::{MAX_JOINTS, MAX_ROWS};

/// The error for words that are invalid for a parameter.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum ParameterError {
    /// The parameter does not exist, or is not one that is written and stored.
    #[error("parameter {0} does not exist or is read-only")]
    NotWritable(u8),
    /// The number of joints is out of range.
    #[error("{got} joints are not possible; use 1 to {MAX_JOINTS}")]
    Joints {
        /// The requested number of joints.
        got: i16,
    },
    /// The joint that moves the cell does not exist.
    #[error("joint {got} does not exist; the chain has joints 1 to {joints}")]
    Joint {
        /// The requested joint.
        got: i16,
        /// The number of joints of the chain.
        joints: i16,
    },
    /// The normal does not have unit length.
    #[error("the squared length of the outward normal is {got} / 2^28; it must be 63/64 to 65/64")]
    Normal {
        /// Square of the length, in steps of 2^-28.
        got: i64,
    },
    /// A gain or threshold is negative.
    #[error("word {word} (from 0) of the contact parameter is {got}; it must be 0 or more")]
    Negative {
        /// The index of the word, from 0.
        word: u8,
        /// The value of the word.
        got: i16,
    },
    /// The period of the joint broadcast is zero.
    #[error("the period of joint broadcasts is 0 us; it must be above 0")]
    Period,
    /// The number of rows is out of range, or does not match the joints.
    #[error(
        "{got} rows are not possible; use at least one for each of the {joints} joints, and at most \
         {MAX_ROWS}"
    )]
    Rows {
        /// The requested number of rows.
        got: i16,
        /// The number of joints of the chain.
        joints: i16,
    },
    /// The row that carries the cell is not the row of its joint or a fixed row after it.
    #[error(
        "row {got} of {rows} cannot carry the cell; use the row of the cell's joint, or a fixed row after it"
    )]
    Row {
        /// The requested row.
        got: i16,
        /// The number of rows of the table.
        rows: i16,
    },
    /// The kind of a row is undefined.
    #[error("row {row} has kind {got}; use 0 (revolute), 1 (prismatic) or 2 (fixed)")]
    Kind {
        /// The number of the row, from 1.
        row: u8,
        /// The requested kind.
        got: i16,
    },
    /// The torque format is undefined.
    #[error("torque format {got} does not exist: use 0 (Q3.12), 1 (Q5.10) or 2 (Q7.8)")]
    Format {
        /// The requested format.
        got: i16,
    },
}

impl ParameterError {
    /// Returns the number that stands for this error in a refusal.
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
