//! What a cell stores: the robot's table, its own pose, its gains and thresholds, as the words
//! in which they travel and lie in flash.
//!
//! Each parameter is one packet's six words (unused words are not looked at, and are stored and answered as 0):
//!
//! | number | parameter | words |
//! |---|---|---|
//! | 0 | identity, read only | serial low, serial high, protocol version, configuration hash, state, [`Abilities`] |
//! | 1 | mount | joint k that moves the cell's link (1..=joints), joints of the chain (1..=14), row that carries the cell, rows of the chain (both 0 where each joint has one revolute row and row k carries it), torque format (0 Q3.12, 1 Q5.10, 2 Q7.8) |
//! | 2 | pose in the frame of the row that carries the cell | position x, y, z in m, Q1.14; outward normal x, y, z, Q1.14 |
//! | 3 | contact (Algorithm 1) | alpha_c Q3.12, alpha_p in N Q5.10, F_c,th in N Q5.10, F_p,th Q1.14, F_z,th in N Q5.10 |
//! | 4 | timing | period of the joint broadcast in µs, unsigned |
//! | 5 | mode, volatile | 1: obey stimuli, 0: measure |
//! | 6 | reply, volatile | 0: own torque, 1: sum; width of a slot in µs, unsigned; depth of the deepest cell; 1: carry what rounding took away |
//! | 7 | sensing, volatile | 0: off, 1: continuous, 2: event; period in ms |
//! | 8 | events, volatile | thresholds: contact N Q5.10, proximity Q1.14, temperature °C Q9.6, acceleration g Q3.12; hysteresis, a part of each, Q1.14 |
//! | 9 | links_down, volatile | bit p: port p receives nothing (only in test mode) |
//! | 11 | baseline, volatile | 0: off, 1: hold, 2: follow; threshold in N Q5.10; hysteresis, a part of it, Q1.14; rate in µN/s, unsigned; limit in N Q5.10; N/°C Q1.14 |
//! | 12 | tare, volatile | 0: forget the zero, 1: tare unless it is touched, 2: tare; read: 1 if there is a zero |
//! | 16..=47 | Denavit-Hartenberg row 1..=32 | a, d in m, Q1.14; alpha, theta offset in quarter turns, Q1.14; kind (0 revolute, 1 prismatic, 2 fixed) |
//! | 127 | commit, write only | hash that the written parameters must have |
//!
//! Writing changes a staged copy; a commit with the right hash takes the copy into flash and into use,
//! all of it or nothing.

mod abilities;
mod baseline;
mod error;
mod rows;
mod switches;

pub use abilities::{Abilities, Ability};
pub use baseline::{Baseline, Tare, Zeroing};
pub use error::ParameterError;
pub use rows::{Row, RowKind};
pub use switches::{Events, LinksDown, Reply, Sensing, Slots};

use crate::fixed::{Q1_14, Q3_12, Q5_10, TorqueFormat};
use crate::packet::{MAX_WORDS, WORDS, crc16_of, words};

/// The longest chain of joints.
pub const MAX_JOINTS: usize = MAX_WORDS;
/// The most rows of a chain's table.
pub const MAX_ROWS: usize = 32;
/// Rows that each image has; a longer chain's rows follow them.
const IMAGE_ROWS: usize = 6;
/// The number of row 1.
const FIRST_ROW: u8 = 16;
/// The number after that of the last row.
#[expect(clippy::cast_possible_truncation, reason = "32 rows")]
const AFTER_ROWS: u8 = FIRST_ROW + MAX_ROWS as u8;

/// The parameters' numbers in `configure` and `configured` packets.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Parameter {
    /// 0: who the cell is.
    Identity,
    /// 1: which joint moves it.
    Mount,
    /// 2: where it sits and where it points.
    Pose,
    /// 3: gains and thresholds.
    Contact,
    /// 4: the period of the joint broadcast.
    Timing,
    /// 5: whether it obeys stimuli.
    Mode,
    /// 6: what it answers joints with.
    Reply,
    /// 7: when it sends what it measures.
    Sensing,
    /// 8: which changes are events.
    Events,
    /// 9: the ports whose links are down, for tests.
    LinksDown,
    /// 11: what it takes for the zero of its force sensor.
    Baseline,
    /// 12: it takes what it reads for its zero now.
    Tare,
    /// 16 to 47: one row of the chain's table, counted from 0.
    Row(u8),
    /// 127: take what was written into use.
    Commit,
}

/// The parameters that are kept in flash before the rows, in the order in which they are hashed.
const STORED: [Parameter; 4] = [Parameter::Mount, Parameter::Pose, Parameter::Contact, Parameter::Timing];

/// Every parameter that is no row, and its number.
const NUMBERS: [(Parameter, u8); 13] = [
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
    /// The parameters that are kept in flash for a chain of so many rows, in the order in which they are hashed.
    pub fn stored(rows: usize) -> impl Iterator<Item = Self> {
        let rows = rows.clamp(IMAGE_ROWS, MAX_ROWS);
        STORED.into_iter().chain((0..).take(rows).map(Self::Row))
    }

    /// Whether it is kept in flash.
    #[must_use]
    pub fn is_stored(self) -> bool {
        matches!(self, Self::Row(_)) || STORED.contains(&self)
    }

    /// The parameter with this number, if there is one.
    #[must_use]
    pub fn from_number(number: u8) -> Option<Self> {
        if (FIRST_ROW..AFTER_ROWS).contains(&number) {
            return Some(Self::Row(number - FIRST_ROW));
        }
        NUMBERS.iter().find(|(_, known)| *known == number).map(|(parameter, _)| *parameter)
    }

    /// Its number; that of a commit, which no row has, for a row that does not exist.
    #[must_use]
    pub fn number(self) -> u8 {
        if let Self::Row(row) = self
            && row < AFTER_ROWS - FIRST_ROW
        {
            return FIRST_ROW + row;
        }
        NUMBERS.iter().find(|(known, _)| *known == self).map_or(127, |(_, number)| *number)
    }

    /// Whether it applies as soon as it is written, is not stored, and is lost at a restart.
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

    /// Whether a cell can have these words; those of stored parameters it checks at the commit.
    #[must_use]
    pub fn can_be(self, words: [i16; WORDS]) -> bool {
        match self {
            Self::Reply => Reply::from_words(words).is_some(),
            Self::Sensing => Sensing::from_words(words).is_some(),
            Self::Events => Events::from_words(words).is_some(),
            Self::Baseline => Baseline::from_words(words).is_some(),
            Self::Tare => Tare::from_words(words).is_some(),
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

/// Where a cell sits and where it points, in the frame of the row that carries it.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Pose {
    /// Position in m.
    pub position: [Q1_14; 3],
    /// Outward normal, of unit length; contacts push against it.
    pub normal: [Q1_14; 3],
}

/// Gains and thresholds of the paper's Algorithm 1.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Contact {
    /// Weight of the contact force.
    pub alpha_c: Q3_12,
    /// Weight of the proximity, in N.
    pub alpha_p: Q5_10,
    /// Contact forces below this count as none, in N.
    pub contact_threshold: Q5_10,
    /// Proximities below this count as none.
    pub proximity_threshold: Q1_14,
    /// Fused forces below this count as none, in N.
    pub force_threshold: Q5_10,
}

/// All that a cell computes with.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Parameters {
    /// The joint k that moves the cell's link, 1 to `joints`.
    pub joint: u8,
    /// How many joints the chain has, 1 to 14.
    pub joints: u8,
    /// The row that carries the cell, 1 to `table_rows`; 0, with `table_rows` 0: row k.
    pub row: u8,
    /// How many rows the chain has, `joints` to 32; 0: one for each joint, all of them revolute.
    pub table_rows: u8,
    /// How it sends its own torque.
    pub torque_format: TorqueFormat,
    /// Where the cell sits.
    pub pose: Pose,
    /// How it feels.
    pub contact: Contact,
    /// The period of the joint broadcast in µs; joints older than this are skipped.
    pub period_us: u16,
    /// The chain; rows beyond those in use are zero.
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
        // A constant: the default of an array is code for each of its elements.
        ZERO
    }
}

/// Bytes of the parameters of a chain of up to 6 rows, as they are hashed and kept.
pub const IMAGE_BYTES: usize = (STORED.len() + IMAGE_ROWS) * WORDS * 2;
/// Bytes of those of a chain of 32 rows.
pub const MAX_IMAGE_BYTES: usize = (STORED.len() + MAX_ROWS) * WORDS * 2;

/// The parameters as bytes: [`IMAGE_BYTES`], and 12 more for each row after the sixth.
pub type Image = heapless::Vec<u8, MAX_IMAGE_BYTES>;

impl Parameters {
    /// The words of a stored parameter; zeros for the others.
    #[must_use]
    pub fn words(&self, parameter: Parameter) -> [i16; WORDS] {
        match parameter {
            Parameter::Mount => {
                let format = self.torque_format.number();
                words([self.joint, self.joints, self.row, self.table_rows, format].map(i16::from))
            }
            Parameter::Pose => {
                let ([x, y, z], [nx, ny, nz]) = (self.pose.position, self.pose.normal);
                words([x, y, z, nx, ny, nz].map(Q1_14::to_bits))
            }
            Parameter::Contact => words([
                self.contact.alpha_c.to_bits(),
                self.contact.alpha_p.to_bits(),
                self.contact.contact_threshold.to_bits(),
                self.contact.proximity_threshold.to_bits(),
                self.contact.force_threshold.to_bits(),
            ]),
            Parameter::Timing => words([self.period_us.cast_signed()]),
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

    /// Takes the words of one parameter as they are; [`Parameters::check`] looks at the whole.
    ///
    /// # Errors
    /// When the parameter is not one that is stored, a count does not fit its byte, or there is no such kind of row or
    /// format; then nothing is changed.
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

    /// Whether a cell can compute with this.
    ///
    /// # Errors
    /// The first thing that is wrong: joints, the normal's length, negative gains, no period, rows.
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

    /// Whether the rows have as many joints as the chain, and the row that carries the cell follows joint k.
    fn check_rows(&self, joints: i16) -> Result<(), ParameterError> {
        let (row, rows) = (i16::from(self.row), i16::from(self.table_rows));
        let moving = |rows: &[Row]| rows.iter().filter(|row| row.moves()).count();
        let table = self.table();
        let is_short = self.table_rows == 0;
        let has_joints = moving(table) == usize::from(self.joints);
        if usize::from(self.table_rows) > MAX_ROWS || !has_joints || is_short && !self.is_plain() {
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

    /// Whether each row in use is revolute.
    fn is_plain(&self) -> bool {
        self.table().iter().all(|row| row.kind == RowKind::Revolute)
    }

    /// The rows of the whole chain.
    #[must_use]
    pub fn table(&self) -> &[Row] {
        let rows = if self.table_rows == 0 { self.joints } else { self.table_rows };
        self.rows.get(..usize::from(rows)).unwrap_or_default()
    }

    /// The rows from the base to the cell.
    #[must_use]
    pub fn chain(&self) -> &[Row] {
        let row = if self.row == 0 { self.joint } else { self.row };
        self.rows.get(..usize::from(row)).unwrap_or_default()
    }

    /// These parameters with the shortest words that mean the same: no rows are named where they follow from the
    /// joints.
    #[must_use]
    pub fn shortest(self) -> Self {
        let short = Self { row: 0, table_rows: 0, ..self };
        if self.table_rows == self.joints && self.row == self.joint && short.is_plain() {
            short
        } else {
            self
        }
    }

    /// All stored parameters as bytes, in the order of [`Parameter::stored`], words little endian.
    #[must_use]
    pub fn image(&self) -> Image {
        self.image_parts().flatten().collect()
    }

    /// [`Parameters::image`], one parameter after the other: a small stack has no room for all of them.
    pub fn image_parts(&self) -> impl Iterator<Item = [u8; WORDS * 2]> {
        Parameter::stored(self.table().len()).map(|parameter| self.image_part(parameter))
    }

    /// The bytes of one parameter.
    #[inline(never)]
    fn image_part(&self, parameter: Parameter) -> [u8; WORDS * 2] {
        let mut bytes = [0; WORDS * 2];
        for (bytes, word) in bytes.as_chunks_mut().0.iter_mut().zip(self.words(parameter)) {
            *bytes = word.to_le_bytes();
        }
        bytes
    }

    /// Reads an image and checks it.
    ///
    /// # Errors
    /// When [`Parameters::set`] or [`Parameters::check`] refuses it, or it is longer or shorter than its rows.
    pub fn from_image(image: &[u8]) -> Result<Self, ParameterError> {
        let mut parameters = Self::default();
        let mut words = image.as_chunks::<2>().0.as_chunks::<WORDS>().0.iter();
        for parameter in Parameter::stored(MAX_ROWS) {
            let Some(chunk) = words.next() else { break };
            parameters.set(parameter, chunk.map(i16::from_le_bytes))?;
        }
        parameters.check()?;
        let (parts, rest) = image.as_chunks();
        if !rest.is_empty() || !parameters.image_parts().eq(parts.iter().copied()) {
            let (rows, joints) = (parameters.table_rows.into(), parameters.joints.into());
            return Err(ParameterError::Rows { got: rows, joints });
        }
        Ok(parameters)
    }

    /// The configuration hash that heartbeats carry: CRC-16 (as in packets) over [`Parameters::image`].
    #[must_use]
    pub fn hash(&self) -> u16 {
        crc16_of(self.image_parts())
    }
}

#[cfg(test)]
mod tests;
