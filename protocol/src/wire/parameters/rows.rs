//! The table of a chain.

use super::ParameterError;
use crate::fixed::Q1_14;
use crate::packet::{WORDS, words};

/// What a row of the table does when its joint moves.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum RowKind {
    /// It turns about z: the position is added to theta.
    #[default]
    Revolute,
    /// It slides along z: the position, in m, is added to d.
    Prismatic,
    /// Nothing: it has no joint.
    Fixed,
}

impl RowKind {
    /// Every kind; a kind's place is the number that stands for it.
    pub const ALL: [Self; 3] = [Self::Revolute, Self::Prismatic, Self::Fixed];

    /// Its name.
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
    /// What its joint does.
    pub kind: RowKind,
    /// Length of the link in m.
    pub a: Q1_14,
    /// Offset along the joint's axis in m.
    pub d: Q1_14,
    /// Twist in quarter turns.
    pub alpha: Q1_14,
    /// What is added to the joint's position, in quarter turns; the whole angle where the joint does not turn.
    pub theta_offset: Q1_14,
}

impl Row {
    /// A revolute row without lengths and angles.
    pub(super) const ZERO: Self = Self {
        kind: RowKind::Revolute,
        a: Q1_14::ZERO,
        d: Q1_14::ZERO,
        alpha: Q1_14::ZERO,
        theta_offset: Q1_14::ZERO,
    };

    /// Whether it has a joint.
    #[must_use]
    pub fn moves(&self) -> bool {
        self.kind != RowKind::Fixed
    }

    /// The words of the parameter.
    #[must_use]
    pub(super) fn words(self) -> [i16; WORDS] {
        let [a, d, alpha, theta_offset] = [self.a, self.d, self.alpha, self.theta_offset].map(Q1_14::to_bits);
        words([a, d, alpha, theta_offset, self.kind as i16])
    }

    /// Decodes the words of a row, which is counted from 0.
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
