//! The parameters of a cell: the robot's table, the cell's pose, its gains and thresholds, as words on the
//! bus and in flash.
//!
//! Each parameter is the six words of one packet. Unused words are ignored when written, and are stored and read as 0:
//!
//! | number | parameter | words |
//! |---|---|---|
//! | 0 | identity, read only | serial low, serial high, protocol version, configuration hash, state, [`Abilities`] |
//! | 1 | mount | joint k that moves the cell's link (1..=joints), joints of the chain (1..=14), row that carries the cell, rows of the chain (both 0 where each joint has one revolute row and row k carries it), torque format (0 Q3.12, 1 Q5.10, 2 Q7.8) |
//! | 2 | pose in the frame of the row that carries the cell | position x, y, z in m, Q1.14; outward normal x, y, z, Q1.14 |
//! | 3 | contact (Algorithm 1) | alpha_c Q3.12, alpha_p in N Q5.10, F_c,th in N Q5.10, F_p,th Q1.14, F_z,th in N Q5.10 |
//! | 4 | timing | period of the joint broadcast in µs, unsigned |
//! | 5 | mode, volatile | 1: obey stimuli, 0: measure |
//! | 6 | reply, volatile | 0: own torque, 1: sum; width of a slot in µs, unsigned; depth of the deepest cell; 1: carry the rounding error |
//! | 7 | sensing, volatile | 0: off, 1: continuous, 2: event; period in ms |
//! | 8 | events, volatile | thresholds: contact N Q5.10, proximity Q1.14, temperature °C Q9.6, acceleration g Q3.12; hysteresis, a part of each, Q1.14 |
//! | 9 | links_down, volatile | bit p: port p receives nothing (only in test mode) |
//! | 11 | baseline, volatile | 0: off, 1: hold, 2: follow; threshold in N Q5.10; hysteresis, a part of it, Q1.14; rate in µN/s, unsigned; limit in N Q5.10; N/°C Q1.14 |
//! | 12 | tare, volatile | 0: forget the zero, 1: tare unless it is touched, 2: tare; read: 1 if there is a zero |
//! | 16..=47 | Denavit-Hartenberg row 1..=32 | a, d in m, Q1.14; alpha, theta offset in quarter turns, Q1.14; kind (0 revolute, 1 prismatic, 2 fixed) |
//! | 127 | commit, write only | hash that the written parameters must have |
//!
//! A write changes a staged copy. A commit with the correct hash stores the whole copy in flash and activates
//! it; any other commit changes nothing.

mod abilities;
mod baseline;
mod error;
mod rows;
mod switches;

pub use abilities::{Abilities, MissingAbility};
pub use baseline::{Baseline, BaselineSettings, TareCommand};
pub use error::ParameterError;
pub use rows::{Row, RowKind};
pub use switches::{Events, LinksDown, ReplyKind, Sensing, SumSchedule};

use crate::fixed::{Q1_14, Q3_12, Q5_10, TorqueFormat};
use crate::packet::{MAX_WORDS, WORDS, crc16_of_parts, padded_words};

/// Maximum number of joints of a chain.
pub const MAX_JOINTS: usize = MAX_WORDS;
/// Maximum number of rows of a chain's table.
pub const MAX_ROWS: usize = 32;
/// Minimum number of rows in a flash image. An image with more rows has them after these.
const MIN_IMAGE_ROWS: usize = 6;
/// The parameter number of row 1.
const FIRST_ROW_NUMBER: u8 = 16;
/// The parameter number after the last row.
#[expect(clippy::cast_possible_truncation, reason = "32 rows")]
const END_ROW_NUMBER: u8 = FIRST_ROW_NUMBER + MAX_ROWS as u8;

/// A parameter. `configure` and `configured` packets carry its number.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Parameter {
    /// 0: serial number, version, state and abilities.
    Identity,
    /// 1: the joint and row that carry the cell, and the torque format.
    Mount,
    /// 2: position and normal.
    Pose,
    /// 3: gains and thresholds.
    Contact,
    /// 4: the period of the joint broadcast.
    Timing,
    /// 5: stimuli or sensors.
    Mode,
    /// 6: the reply to joints.
    Reply,
    /// 7: the times at which the cell sends measurements.
    Sensing,
    /// 8: the thresholds of event mode.
    Events,
    /// 9: ports whose links are down, for tests.
    LinksDown,
    /// 11: the baseline of the force sensor.
    Baseline,
    /// 12: a tare command.
    Tare,
    /// 16 to 47: one row of the chain's table. The index is counted from 0.
    Row(u8),
    /// 127: stores and activates the written parameters.
    Commit,
}

/// The stored parameters other than rows. They are hashed in this order, before the rows.
const STORED_BEFORE_ROWS: [Parameter; 4] =
    [Parameter::Mount, Parameter::Pose, Parameter::Contact, Parameter::Timing];

/// The number of every parameter other than the rows.
const PARAMETER_NUMBERS: [(Parameter, u8); 13] = [
    (Parameter::Identity, 0),
    (Parameter::Mount, 1),
    (Parameter::Pose, 2),
    (Parameter::Contact, 3),
    (Parameter::Timing, 4),
    (Parameter::Mode, 5),
    (Parameter::Reply, 6),
    (Parameter::Sensing, 7),
    (Parameter::Events, 8),
    (Parameter::LinksDown, 9),
    (Parameter::Baseline, 11),
    (Parameter::Tare, 12),
    (Parameter::Commit, 127),
];

impl Parameter {
    /// Returns the parameters that are stored for a chain with `rows` rows, in the order in which they are
    /// hashed.
    pub fn stored_for_rows(rows: usize) -> impl Iterator<Item = Self> {
        let rows = rows.clamp(MIN_IMAGE_ROWS, MAX_ROWS);
        STORED_BEFORE_ROWS.into_iter().chain((0..).take(rows).map(Self::Row))
    }

    /// Returns true if the cell keeps the parameter in flash.
    #[must_use]
    pub fn is_stored(self) -> bool {
        matches!(self, Self::Row(_)) || STORED_BEFORE_ROWS.contains(&self)
    }

    /// Returns the parameter with this number; `None` for other numbers.
    #[must_use]
    pub fn from_number(number: u8) -> Option<Self> {
        if (FIRST_ROW_NUMBER..END_ROW_NUMBER).contains(&number) {
            return Some(Self::Row(number - FIRST_ROW_NUMBER));
        }
        PARAMETER_NUMBERS.iter().find(|(_, known)| *known == number).map(|(parameter, _)| *parameter)
    }

    /// Returns the number of the parameter. For a row above the 32nd, returns the number of the commit.
    #[must_use]
    pub fn number(self) -> u8 {
        if let Self::Row(row) = self
            && row < END_ROW_NUMBER - FIRST_ROW_NUMBER
        {
            return FIRST_ROW_NUMBER + row;
        }
        PARAMETER_NUMBERS.iter().find(|(known, _)| *known == self).map_or(127, |(_, number)| *number)
    }

    /// Returns true if a write of the parameter takes effect at once and is lost when the cell restarts.
    #[must_use]
    pub const fn is_volatile(self) -> bool {
        matches!(
            self,
            Self::Mode
                | Self::Reply
                | Self::Sensing
                | Self::Events
                | Self::LinksDown
                | Self::Baseline
                | Self::Tare
        )
    }

    /// Returns true if a cell accepts these words for the parameter. Words of stored parameters are always accepted
    /// here, because they are checked at the commit.
    #[must_use]
    pub fn accepts(self, words: [i16; WORDS]) -> bool {
        match self {
            Self::Reply => ReplyKind::from_words(words).is_some(),
            Self::Sensing => Sensing::from_words(words).is_some(),
            Self::Events => Events::from_words(words).is_some(),
            Self::Baseline => Baseline::from_words(words).is_some(),
            Self::Tare => TareCommand::from_words(words).is_some(),
            Self::Identity
            | Self::Mount
            | Self::Pose
            | Self::Contact
            | Self::Timing
            | Self::Mode
            | Self::LinksDown
            | Self::Row(_)
            | Self::Commit => true,
        }
    }
}

/// Position and orientation of a cell, in the frame of the row that carries it.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Pose {
    /// Position in m.
    pub position: [Q1_14; 3],
    /// Outward unit normal. Contact forces act against it.
    pub normal: [Q1_14; 3],
}

/// Gains and thresholds of the paper's Algorithm 1, which fuses contact force and proximity.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Contact {
    /// Gain of the contact force.
    pub alpha_c: Q3_12,
    /// Gain of the proximity, in N.
    pub alpha_p: Q5_10,
    /// Contact forces below this threshold, in N, count as zero.
    pub contact_threshold: Q5_10,
    /// Proximities below this threshold count as zero.
    pub proximity_threshold: Q1_14,
    /// Fused forces below this threshold, in N, count as zero.
    pub force_threshold: Q5_10,
}

/// The stored parameters of a cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Parameters {
    /// The joint k that moves the cell's link, 1 to `joints`.
    pub joint: u8,
    /// Number of joints of the chain, 1 to 14.
    pub joints: u8,
    /// Number of the row that carries the cell, 1 to `table_rows`. If `table_rows` is 0, it is also 0, and row k
    /// carries the cell.
    pub row: u8,
    /// Number of rows of the chain, `joints` to 32. The value 0 means that each joint has one revolute row.
    pub table_rows: u8,
    /// The format of the cell's own torque.
    pub torque_format: TorqueFormat,
    /// The pose of the cell.
    pub pose: Pose,
    /// Gains and thresholds.
    pub contact: Contact,
    /// The period of the joint broadcast in µs. A joints message that arrives later than this is skipped.
    pub period_us: u16,
    /// Table of the chain. Unused rows are zero.
    pub rows: [Row; MAX_ROWS],
}

impl Default for Parameters {
    fn default() -> Self {
        const ZERO: Parameters = Parameters {
            joint: 0,
            joints: 0,
            row: 0,
            table_rows: 0,
            torque_format: TorqueFormat::Q3_12,
            pose: Pose { position: [Q1_14::ZERO; 3], normal: [Q1_14::ZERO; 3] },
            contact: Contact {
                alpha_c: Q3_12::ZERO,
                alpha_p: Q5_10::ZERO,
                contact_threshold: Q5_10::ZERO,
                proximity_threshold: Q1_14::ZERO,
                force_threshold: Q5_10::ZERO,
            },
            period_us: 0,
            rows: [Row::ZERO; MAX_ROWS],
        };
        // A constant, because the default of an array compiles to code for each element.
        ZERO
    }
}

/// Size in bytes of the image for a chain with up to 6 rows.
pub const IMAGE_BYTES: usize = (STORED_BEFORE_ROWS.len() + MIN_IMAGE_ROWS) * WORDS * 2;
/// Size in bytes of the image for a chain with 32 rows.
pub const MAX_IMAGE_BYTES: usize = (STORED_BEFORE_ROWS.len() + MAX_ROWS) * WORDS * 2;

/// The stored parameters as bytes: [`IMAGE_BYTES`], and 12 more for each row after the sixth.
pub type ParameterImage = heapless::Vec<u8, MAX_IMAGE_BYTES>;

impl Parameters {
    /// Returns the words of a stored parameter; zeros for other parameters.
    #[must_use]
    pub fn words(&self, parameter: Parameter) -> [i16; WORDS] {
        match parameter {
            Parameter::Mount => {
                let format = self.torque_format.number();
                padded_words([self.joint, self.joints, self.row, self.table_rows, format].map(i16::from))
            }
            Parameter::Pose => {
                let ([x, y, z], [nx, ny, nz]) = (self.pose.position, self.pose.normal);
                padded_words([x, y, z, nx, ny, nz].map(Q1_14::to_bits))
            }
            Parameter::Contact => padded_words([
                self.contact.alpha_c.to_bits(),
                self.contact.alpha_p.to_bits(),
                self.contact.contact_threshold.to_bits(),
                self.contact.proximity_threshold.to_bits(),
                self.contact.force_threshold.to_bits(),
            ]),
            Parameter::Timing => padded_words([self.period_us.cast_signed()]),
            Parameter::Row(row) => self.rows.get(usize::from(row)).copied().unwrap_or_default().words(),
            Parameter::Identity
            | Parameter::Mode
            | Parameter::Reply
            | Parameter::Sensing
            | Parameter::Events
            | Parameter::LinksDown
            | Parameter::Baseline
            | Parameter::Tare
            | Parameter::Commit => [0; WORDS],
        }
    }

    /// Sets one parameter from its words. [`Parameters::check`] validates all parameters together.
    ///
    /// # Errors
    /// Returns an error if the parameter is not stored, a count does not fit a byte, or the kind of a row or
    /// the torque format is undefined. The parameters do not change then.
    pub fn set(&mut self, parameter: Parameter, words: [i16; WORDS]) -> Result<(), ParameterError> {
        let [w0, w1, w2, w3, w4, w5, ..] = words;
        match parameter {
            Parameter::Mount => {
                let joints = u8::try_from(w1).map_err(|_| ParameterError::Joints { got: w1 })?;
                let joint = u8::try_from(w0).map_err(|_| ParameterError::Joint { got: w0, joints: w1 })?;
                let table_rows =
                    u8::try_from(w3).map_err(|_| ParameterError::Rows { got: w3, joints: w1 })?;
                let row = u8::try_from(w2).map_err(|_| ParameterError::Row { got: w2, rows: w3 })?;
                let format = TorqueFormat::from_number(w4).ok_or(ParameterError::Format { got: w4 })?;
                (self.joint, self.joints, self.row, self.table_rows) = (joint, joints, row, table_rows);
                self.torque_format = format;
            }
            Parameter::Pose => {
                self.pose = Pose {
                    position: [w0, w1, w2].map(Q1_14::from_bits),
                    normal: [w3, w4, w5].map(Q1_14::from_bits),
                };
            }
            Parameter::Contact => {
                self.contact = Contact {
                    alpha_c: Q3_12::from_bits(w0),
                    alpha_p: Q5_10::from_bits(w1),
                    contact_threshold: Q5_10::from_bits(w2),
                    proximity_threshold: Q1_14::from_bits(w3),
                    force_threshold: Q5_10::from_bits(w4),
                };
            }
            Parameter::Timing => self.period_us = w0.cast_unsigned(),
            Parameter::Row(number) => {
                let unknown = ParameterError::NotWritable(parameter.number());
                *self.rows.get_mut(usize::from(number)).ok_or(unknown)? = Row::from_words(number, words)?;
            }
            Parameter::Identity
            | Parameter::Mode
            | Parameter::Reply
            | Parameter::Sensing
            | Parameter::Events
            | Parameter::LinksDown
            | Parameter::Baseline
            | Parameter::Tare
            | Parameter::Commit => {
                return Err(ParameterError::NotWritable(parameter.number()));
            }
        }
        Ok(())
    }

    /// Checks that the parameters are valid and consistent, so that a cell can compute torques with them.
    ///
    /// # Errors
    /// Returns the first error found in the joints, the normal, the gains and thresholds, the period or the rows.
    pub fn check(&self) -> Result<(), ParameterError> {
        let (joint, joints) = (i16::from(self.joint), i16::from(self.joints));
        if self.joints == 0 || usize::from(self.joints) > MAX_JOINTS {
            return Err(ParameterError::Joints { got: joints });
        }
        if self.joint == 0 || joint > joints {
            return Err(ParameterError::Joint { got: joint, joints });
        }
        let square = self.pose.normal.iter().map(|n| i64::from(n.to_bits()).pow(2)).sum::<i64>();
        if (square - (1 << 28)).abs() > 1 << 22 {
            return Err(ParameterError::Normal { got: square });
        }
        for (word, got) in (0_u8..).zip(self.words(Parameter::Contact)) {
            if got < 0 {
                return Err(ParameterError::Negative { word, got });
            }
        }
        if self.period_us == 0 {
            return Err(ParameterError::Period);
        }
        self.check_rows(joints)
    }

    /// Checks that the table has as many rows with a joint as the chain has joints, and that the cell's row is the row
    /// of joint k or a fixed row after it.
    fn check_rows(&self, joints: i16) -> Result<(), ParameterError> {
        let (row, rows) = (i16::from(self.row), i16::from(self.table_rows));
        let moving = |rows: &[Row]| rows.iter().filter(|row| row.has_joint()).count();
        let table = self.all_rows();
        let is_short = self.table_rows == 0;
        let has_joints = moving(table) == usize::from(self.joints);
        if usize::from(self.table_rows) > MAX_ROWS || !has_joints || is_short && !self.is_all_revolute() {
            return Err(ParameterError::Rows { got: rows, joints });
        }
        if is_short && self.row == 0 {
            return Ok(());
        }
        let below = table.get(..usize::from(self.row)).filter(|_| self.row > 0 && !is_short);
        if below.is_none_or(|below| moving(below) != usize::from(self.joint)) {
            return Err(ParameterError::Row { got: row, rows });
        }
        Ok(())
    }

    /// Returns true if all rows of the chain are revolute.
    fn is_all_revolute(&self) -> bool {
        self.all_rows().iter().all(|row| row.kind == RowKind::Revolute)
    }

    /// Returns the rows of the whole chain, from base to tip.
    #[must_use]
    pub fn all_rows(&self) -> &[Row] {
        let rows = if self.table_rows == 0 { self.joints } else { self.table_rows };
        self.rows.get(..usize::from(rows)).unwrap_or_default()
    }

    /// Returns the rows from the base to the row that carries the cell.
    #[must_use]
    pub fn rows_to_cell(&self) -> &[Row] {
        let row = if self.row == 0 { self.joint } else { self.row };
        self.rows.get(..usize::from(row)).unwrap_or_default()
    }

    /// Returns equivalent parameters in the shortest form, in which the row numbers are 0 if they follow from the
    /// joints.
    #[must_use]
    pub fn shortest_form(self) -> Self {
        let short = Self { row: 0, table_rows: 0, ..self };
        if self.table_rows == self.joints && self.row == self.joint && short.is_all_revolute() {
            short
        } else {
            self
        }
    }

    /// Encodes all stored parameters, in the order of [`Parameter::stored_for_rows`], words little endian.
    #[must_use]
    pub fn encode_image(&self) -> ParameterImage {
        self.encode_image_parts().flatten().collect()
    }

    /// Returns [`Parameters::encode_image`] in pieces of one parameter each, for callers with a small stack.
    pub fn encode_image_parts(&self) -> impl Iterator<Item = [u8; WORDS * 2]> {
        Parameter::stored_for_rows(self.all_rows().len()).map(|parameter| self.encode_parameter(parameter))
    }

    /// Encodes one parameter.
    #[inline(never)]
    fn encode_parameter(&self, parameter: Parameter) -> [u8; WORDS * 2] {
        let mut bytes = [0; WORDS * 2];
        for (bytes, word) in bytes.as_chunks_mut().0.iter_mut().zip(self.words(parameter)) {
            *bytes = word.to_le_bytes();
        }
        bytes
    }

    /// Decodes an image and checks it.
    ///
    /// # Errors
    /// Returns an error if [`Parameters::set`] or [`Parameters::check`] rejects the parameters, or the length of the
    /// image does not match its number of rows.
    pub fn from_image(image: &[u8]) -> Result<Self, ParameterError> {
        let mut parameters = Self::default();
        let mut words = image.as_chunks::<2>().0.as_chunks::<WORDS>().0.iter();
        for parameter in Parameter::stored_for_rows(MAX_ROWS) {
            let Some(chunk) = words.next() else { break };
            parameters.set(parameter, chunk.map(i16::from_le_bytes))?;
        }
        parameters.check()?;
        let (parts, rest) = image.as_chunks();
        if !rest.is_empty() || !parameters.encode_image_parts().eq(parts.iter().copied()) {
            let (rows, joints) = (parameters.table_rows.into(), parameters.joints.into());
            return Err(ParameterError::Rows { got: rows, joints });
        }
        Ok(parameters)
    }

    /// Returns the configuration hash, as sent in heartbeats: the CRC-16 of packets over [`Parameters::encode_image`].
    #[must_use]
    pub fn hash(&self) -> u16 {
        crc16_of_parts(self.encode_image_parts())
    }
}

#[cfg(test)]
mod tests;
