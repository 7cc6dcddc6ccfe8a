//! Rows of the Denavit-Hartenberg table of a chain.

use super::ParameterError;
use crate::fixed::Q1_14;
use crate::packet::{WORDS, padded_words};

/// The kind of a row, by its joint.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum RowKind {
    /// A revolute joint about the z axis. The joint position is added to theta.
    #[default]
    Revolute,
    /// A prismatic joint along the z axis. The joint position, in m, is added to d.
    Prismatic,
    /// A fixed row, without a joint.
    Fixed,
}

impl RowKind {
    /// All kinds. The index of a kind is its number in the parameter of a row.
    pub const ALL: [Self; 3] = [Self::Revolute, Self::Prismatic, Self::Fixed];

    /// Returns the name of the kind.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Revolute => "revolute",
            Self::Prismatic => "prismatic",
            Self::Fixed => "fixed",
        }
    }
}

/// One row of a chain's table in standard Denavit-Hartenberg form, `Rz(theta) Tz(d) Tx(a) Rx(alpha)`.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Row {
    /// The kind of the joint.
    pub kind: RowKind,
    /// Length of the link in m.
    pub a: Q1_14,
    /// Offset along the joint's axis in m.
    pub d: Q1_14,
    /// Twist in quarter turns.
    pub alpha: Q1_14,
    /// Angle in quarter turns. In a revolute row, the joint position is added to it; in other rows it is the whole
    /// angle.
    pub theta_offset: Q1_14,
}

impl Row {
    /// A revolute row in which all lengths and angles are zero.
    pub(super) const ZERO: Self = Self {
        kind: RowKind::Revolute,
        a: Q1_14::ZERO,
        d: Q1_14::ZERO,
        alpha: Q1_14::ZERO,
        theta_offset: Q1_14::ZERO,
    };

    /// Returns true if the row has a joint.
    #[must_use]
    pub fn has_joint(&self) -> bool {
        self.kind != RowKind::Fixed
    }

    /// Encodes the row as the words of its parameter.
    #[must_use]
    pub(super) fn words(self) -> [i16; WORDS] {
        let [a, d, alpha, theta_offset] = [self.a, self.d, self.alpha, self.theta_offset].map(Q1_14::to_bits);
        padded_words([a, d, alpha, theta_offset, self.kind as i16])
    }

    /// Decodes the words of a row's parameter. `row` is the index of the row, from 0, for errors.
    pub(super) fn from_words(row: u8, words: [i16; WORDS]) -> Result<Self, ParameterError> {
        let [a, d, alpha, theta_offset, kind, _] = words;
        let known = usize::try_from(kind).ok().and_then(|kind| RowKind::ALL.get(kind));
        let Some(&kind) = known else {
            return Err(ParameterError::Kind { row: row.saturating_add(1), got: kind });
        };
        let [a, d, alpha, theta_offset] = [a, d, alpha, theta_offset].map(Q1_14::from_bits);
        Ok(Self { kind, a, d, alpha, theta_offset })
    }
}
