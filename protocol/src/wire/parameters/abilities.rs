//! The abilities of a cell, which it reports in its identity (parameter 0).

use core::fmt;

use super::{MAX_JOINTS, MAX_ROWS, Parameters, RowKind};
use crate::fixed::TorqueFormat;

/// The abilities of a cell: the longest chain and table, and the kinds of rows and torque formats that it supports.
/// They are word 5 of parameter 0.
///
/// | bits | meaning |
/// |---|---|
/// | 0..=3 | joints of the longest chain; 0: 6 |
/// | 4..=9 | rows of the longest table; 0: 6 |
/// | 10 | prismatic rows |
/// | 11 | fixed rows |
/// | 12 | torques in Q5.10 |
/// | 13 | torques in Q7.8 |
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Abilities(u16);

/// An ability that given parameters require and a cell lacks.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum MissingAbility {
    /// A chain with more joints than the cell supports.
    Joints {
        /// Number of joints that the parameters require.
        needed: usize,
        /// Maximum number of joints that the cell supports.
        most: usize,
    },
    /// A table with more rows than the cell supports.
    Rows {
        /// Number of rows that the parameters require.
        needed: usize,
        /// Maximum number of rows that the cell supports.
        most: usize,
    },
    /// A row of a kind that the cell does not support.
    Kind(RowKind),
    /// A torque format that the cell does not support.
    Format(TorqueFormat),
}

impl fmt::Display for MissingAbility {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Joints { needed, most } => write!(f, "{needed} joints (it supports {most})"),
            Self::Rows { needed, most } => write!(f, "{needed} rows (it supports {most})"),
            Self::Kind(kind) => write!(f, "{} rows", kind.name()),
            Self::Format(format) => write!(f, "torques in {}", format.name()),
        }
    }
}

impl Abilities {
    const ROWS_SHIFT: u32 = 4;
    const PRISMATIC_ROW_FLAG: u16 = 1 << 10;
    const FIXED_ROW_FLAG: u16 = 1 << 11;
    const Q5_10_FLAG: u16 = 1 << 12;
    const Q7_8_FLAG: u16 = 1 << 13;

    /// All abilities of this version of the protocol.
    #[expect(clippy::cast_possible_truncation, reason = "14 joints and 32 rows")]
    pub const ALL: Self = Self(
        MAX_JOINTS as u16
            | (MAX_ROWS as u16) << Self::ROWS_SHIFT
            | Self::PRISMATIC_ROW_FLAG
            | Self::FIXED_ROW_FLAG
            | Self::Q5_10_FLAG
            | Self::Q7_8_FLAG,
    );

    /// Decodes the abilities from their word.
    #[must_use]
    pub const fn from_word(word: i16) -> Self {
        Self(word.cast_unsigned())
    }

    /// Returns the abilities as a word.
    #[must_use]
    pub const fn word(self) -> i16 {
        self.0.cast_signed()
    }

    /// Returns the maximum number of joints of a chain.
    #[must_use]
    pub fn max_joints(self) -> usize {
        Self::six_if_zero(self.0 & 0xF)
    }

    /// Returns the maximum number of rows of a table.
    #[must_use]
    pub fn max_rows(self) -> usize {
        Self::six_if_zero(self.0 >> Self::ROWS_SHIFT & 0x3F)
    }

    fn six_if_zero(number: u16) -> usize {
        if number == 0 { 6 } else { number.into() }
    }

    const fn has_bit(self, bit: u16) -> bool {
        self.0 & bit != 0
    }

    /// Returns the first ability that `parameters` require and the cell lacks; `None` if it lacks none.
    #[must_use]
    pub fn first_missing(self, parameters: &Parameters) -> Option<MissingAbility> {
        let (joints, table) = (usize::from(parameters.joints), parameters.all_rows());
        if joints > self.max_joints() {
            return Some(MissingAbility::Joints { needed: joints, most: self.max_joints() });
        }
        if table.len() > self.max_rows() {
            return Some(MissingAbility::Rows { needed: table.len(), most: self.max_rows() });
        }
        let can = |kind| match kind {
            RowKind::Revolute => true,
            RowKind::Prismatic => self.has_bit(Self::PRISMATIC_ROW_FLAG),
            RowKind::Fixed => self.has_bit(Self::FIXED_ROW_FLAG),
        };
        if let Some(row) = table.iter().find(|row| !can(row.kind)) {
            return Some(MissingAbility::Kind(row.kind));
        }
        let has_format = match parameters.torque_format {
            TorqueFormat::Q3_12 => true,
            TorqueFormat::Q5_10 => self.has_bit(Self::Q5_10_FLAG),
            TorqueFormat::Q7_8 => self.has_bit(Self::Q7_8_FLAG),
        };
        (!has_format).then_some(MissingAbility::Format(parameters.torque_format))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parameters::Row;

    #[test]
    fn a_cell_that_says_nothing_can_what_the_first_cells_could() {
        let plain = Parameters { joint: 6, joints: 6, ..Parameters::default() };
        let none = Abilities::from_word(0);
        assert_eq!(none.first_missing(&plain), None);
        let lacks = |abilities: Abilities, parameters: Parameters| {
            abilities.first_missing(&parameters).map(|ability| ability.to_string())
        };
        let seven = Parameters { joint: 7, joints: 7, ..plain };
        assert_eq!(lacks(none, seven).unwrap(), "7 joints (it supports 6)");
        let mut helped = Parameters { row: 7, table_rows: 7, ..plain };
        helped.rows[2].kind = RowKind::Fixed;
        assert_eq!(lacks(none, helped).unwrap(), "7 rows (it supports 6)");
        assert_eq!(lacks(Abilities(7 << 4), helped).unwrap(), "fixed rows");
        let mut sliding = plain;
        sliding.rows[0] = Row { kind: RowKind::Prismatic, ..Row::default() };
        assert_eq!(lacks(none, sliding).unwrap(), "prismatic rows");
        let wide = Parameters { torque_format: TorqueFormat::Q5_10, ..plain };
        assert_eq!(lacks(none, wide).unwrap(), "torques in Q5.10");
        for parameters in [plain, seven, helped, sliding, wide] {
            assert_eq!(Abilities::ALL.first_missing(&parameters), None);
        }
        assert_eq!(Abilities::ALL.word(), 14 | 32 << 4 | 0b1111 << 10);
    }
}
