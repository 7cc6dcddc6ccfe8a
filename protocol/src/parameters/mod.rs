//! What a cell stores: the robot's table, its own pose, its gains and thresholds, as the words
//! in which they travel and lie in flash.
//!
//! Each parameter is one packet's six words (unused words are not looked at, and are stored and answered as 0):
//!
//! | number | parameter | words |
//! |---|---|---|
//! | 0 | identity, read only | serial low, serial high, protocol version, configuration hash, state, 0 |
//! | 1 | mount | joint k that moves the cell's link (1..=joints), joints of the robot (1..=6) |
//! | 2 | pose in the frame of joint k | position x, y, z in m, Q1.14; outward normal x, y, z, Q1.14 |
//! | 3 | contact (Algorithm 1) | alpha_c Q3.12, alpha_p in N Q5.10, F_c,th in N Q5.10, F_p,th Q1.14, F_z,th in N Q5.10 |
//! | 4 | timing | period of the joint broadcast in µs, unsigned |
//! | 5 | mode, volatile | 1: obey stimuli, 0: measure |
//! | 6 | reply, volatile | 0: own torque, 1: sum; width of a slot in µs, unsigned; depth of the deepest cell; 1: carry what rounding took away |
//! | 7 | sensing, volatile | 0: off, 1: continuous, 2: event; period in ms |
//! | 8 | events, volatile | thresholds: contact N Q5.10, proximity Q1.14, temperature °C Q9.6, acceleration g Q3.12; hysteresis, a part of each, Q1.14 |
//! | 9 | links_down, volatile | bit p: port p receives nothing (only in test mode) |
//! | 16..=21 | Denavit-Hartenberg row of joint 1..=6 | a, d in m, Q1.14; alpha, theta offset in quarter turns, Q1.14 |
//! | 127 | commit, write only | hash that the written parameters must have |
//!
//! Writing changes a staged copy; a commit with the right hash takes the copy into flash and into use,
//! all of it or nothing.

mod switches;

pub use switches::{Events, LinksDown, Reply, Sensing, Slots};

use thiserror::Error;

use crate::fixed::{Q1_14, Q3_12, Q5_10};
use crate::packet::{WORDS, crc16, words};

/// The longest chain of joints.
pub const MAX_JOINTS: usize = WORDS;

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
    /// 16 to 21: one row of the robot's table, counted from 0.
    Row(u8),
    /// 127: take what was written into use.
    Commit,
}

/// The parameters that are kept in flash, in the order in which they are hashed.
const STORED: [Parameter; 10] = [
    Parameter::Mount,
    Parameter::Pose,
    Parameter::Contact,
    Parameter::Timing,
    Parameter::Row(0),
    Parameter::Row(1),
    Parameter::Row(2),
    Parameter::Row(3),
    Parameter::Row(4),
    Parameter::Row(5),
];

/// Every parameter and its number.
const NUMBERS: [(Parameter, u8); 17] = [
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
    (Parameter::Row(0), 16),
    (Parameter::Row(1), 17),
    (Parameter::Row(2), 18),
    (Parameter::Row(3), 19),
    (Parameter::Row(4), 20),
    (Parameter::Row(5), 21),
    (Parameter::Commit, 127),
];

impl Parameter {
    /// The parameters that are kept in flash, in the order in which they are hashed.
    pub const STORED: [Self; 10] = STORED;

    /// The parameter with this number, if there is one.
    #[must_use]
    pub fn from_number(number: u8) -> Option<Self> {
        NUMBERS.iter().find(|(_, known)| *known == number).map(|(parameter, _)| *parameter)
    }

    /// Its number; that of a commit, which no row has, for a row that does not exist.
    #[must_use]
    pub fn number(self) -> u8 {
        NUMBERS.iter().find(|(known, _)| *known == self).map_or(127, |(_, number)| *number)
    }

    /// Whether it applies as soon as it is written, is not stored, and is lost at a restart.
    #[must_use]
    pub const fn is_volatile(self) -> bool {
        matches!(self, Self::Mode | Self::Reply | Self::Sensing | Self::Events | Self::LinksDown)
    }

    /// Whether a cell can have these words; those of stored parameters it checks at the commit.
    #[must_use]
    pub fn can_be(self, words: [i16; WORDS]) -> bool {
        match self {
            Self::Reply => Reply::from_words(words).is_some(),
            Self::Sensing => Sensing::from_words(words).is_some(),
            Self::Events => Events::from_words(words).is_some(),
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

/// One row of the robot's table in standard Denavit-Hartenberg form, `Rz(theta) Tz(d) Tx(a) Rx(alpha)`.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Row {
    /// Length of the link in m.
    pub a: Q1_14,
    /// Offset along the joint's axis in m.
    pub d: Q1_14,
    /// Twist in quarter turns.
    pub alpha: Q1_14,
    /// What is added to the joint's position, in quarter turns.
    pub theta_offset: Q1_14,
}

/// Where a cell sits and where it points, in the frame of joint k.
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
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Parameters {
    /// The joint k that moves the cell's link, 1 to `joints`.
    pub joint: u8,
    /// How many joints the robot has, 1 to 6.
    pub joints: u8,
    /// Where the cell sits.
    pub pose: Pose,
    /// How it feels.
    pub contact: Contact,
    /// The period of the joint broadcast in µs; joints older than this are skipped.
    pub period_us: u16,
    /// The robot; rows beyond `joints` are zero.
    pub rows: [Row; MAX_JOINTS],
}

/// Why words cannot be taken for a parameter.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum ParameterError {
    /// No such number, or one that cannot be written this way.
    #[error("parameter {0} cannot be written")]
    NotWritable(u8),
    /// The number of joints.
    #[error("{got} joints; 1 to 6 are possible")]
    Joints {
        /// What was asked for.
        got: i16,
    },
    /// The joint that moves the cell.
    #[error("joint {got} does not exist; the robot has joints 1 to {joints}")]
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
        }
    }
}

/// Bytes of the parameters as they are hashed and kept.
pub const IMAGE_BYTES: usize = STORED.len() * WORDS * 2;

impl Parameters {
    /// The words of a stored parameter; zeros for the others.
    #[must_use]
    pub fn words(&self, parameter: Parameter) -> [i16; WORDS] {
        match parameter {
            Parameter::Mount => words([i16::from(self.joint), i16::from(self.joints)]),
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
            Parameter::Row(row) => {
                let row = self.rows.get(usize::from(row)).copied().unwrap_or_default();
                words([row.a, row.d, row.alpha, row.theta_offset].map(Q1_14::to_bits))
            }
            Parameter::Identity
            | Parameter::Mode
            | Parameter::Reply
            | Parameter::Sensing
            | Parameter::Events
            | Parameter::LinksDown
            | Parameter::Commit => [0; WORDS],
        }
    }

    /// Takes the words of one parameter as they are; [`Parameters::check`] looks at the whole.
    ///
    /// # Errors
    /// When the parameter is not one that is stored, or a count does not fit its byte; then nothing is changed.
    pub fn set(&mut self, parameter: Parameter, words: [i16; WORDS]) -> Result<(), ParameterError> {
        let [w0, w1, w2, w3, w4, w5, ..] = words;
        match parameter {
            Parameter::Mount => {
                let joints = u8::try_from(w1).map_err(|_| ParameterError::Joints { got: w1 })?;
                let joint = u8::try_from(w0).map_err(|_| ParameterError::Joint { got: w0, joints: w1 })?;
                (self.joint, self.joints) = (joint, joints);
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
                *self.rows.get_mut(usize::from(number)).ok_or(unknown)? = Row {
                    a: Q1_14::from_bits(w0),
                    d: Q1_14::from_bits(w1),
                    alpha: Q1_14::from_bits(w2),
                    theta_offset: Q1_14::from_bits(w3),
                };
            }
            Parameter::Identity
            | Parameter::Mode
            | Parameter::Reply
            | Parameter::Sensing
            | Parameter::Events
            | Parameter::LinksDown
            | Parameter::Commit => {
                return Err(ParameterError::NotWritable(parameter.number()));
            }
        }
        Ok(())
    }

    /// Whether a cell can compute with this.
    ///
    /// # Errors
    /// The first thing that is wrong: joints, the normal's length, negative gains, no period.
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
        Ok(())
    }

    /// The rows in use.
    #[must_use]
    pub fn chain(&self) -> &[Row] {
        self.rows.get(..usize::from(self.joint)).unwrap_or_default()
    }

    /// All stored parameters as bytes, in the order of [`Parameter::STORED`], words little endian.
    #[must_use]
    pub fn image(&self) -> [u8; IMAGE_BYTES] {
        let mut image = [0; IMAGE_BYTES];
        let words = STORED.iter().flat_map(|&parameter| self.words(parameter));
        for (bytes, word) in image.as_chunks_mut::<2>().0.iter_mut().zip(words) {
            *bytes = word.to_le_bytes();
        }
        image
    }

    /// Reads an image and checks it.
    ///
    /// # Errors
    /// When [`Parameters::set`] or [`Parameters::check`] refuses it.
    pub fn from_image(image: &[u8; IMAGE_BYTES]) -> Result<Self, ParameterError> {
        let mut parameters = Self::default();
        let (words, _) = image.as_chunks::<2>();
        for (&parameter, chunk) in STORED.iter().zip(words.as_chunks::<WORDS>().0) {
            parameters.set(parameter, chunk.map(i16::from_le_bytes))?;
        }
        parameters.check()?;
        Ok(parameters)
    }

    /// The configuration hash that heartbeats carry: CRC-16 (as in packets) over [`Parameters::image`].
    #[must_use]
    pub fn hash(&self) -> u16 {
        crc16(&self.image())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sound() -> Parameters {
        let mut rows = [Row::default(); MAX_JOINTS];
        rows[0] = Row { a: Q1_14::nearest(0.5), alpha: Q1_14::nearest(1.0), ..Row::default() };
        Parameters {
            joint: 1,
            joints: 2,
            pose: Pose {
                position: [Q1_14::nearest(0.1); 3],
                normal: [Q1_14::ZERO, Q1_14::ZERO, Q1_14::nearest(1.0)],
            },
            contact: Contact { alpha_c: Q3_12::nearest(1.0), ..Contact::default() },
            period_us: 16_000,
            rows,
        }
    }

    #[test]
    fn every_parameter_number_comes_back() {
        for number in 0..=u8::MAX {
            if let Some(parameter) = Parameter::from_number(number) {
                assert_eq!(parameter.number(), number);
            }
        }
        assert_eq!(Parameter::from_number(22), None);
        let volatile =
            (0..=u8::MAX).filter(|&it| Parameter::from_number(it).is_some_and(Parameter::is_volatile));
        assert!(volatile.eq(5..=9));
    }

    #[test]
    fn what_is_wrong_is_said() {
        assert_eq!(sound().check(), Ok(()));
        let wrong = Parameters { joint: 3, ..sound() };
        assert_eq!(
            wrong.check().unwrap_err().to_string(),
            "joint 3 does not exist; the robot has joints 1 to 2"
        );
        assert!(Parameters { joints: 7, ..sound() }.check().is_err());
        assert!(Parameters { period_us: 0, ..sound() }.check().is_err());
        assert!(Parameters { pose: Pose::default(), ..sound() }.check().is_err());
        let contact = Contact { force_threshold: Q5_10::from_bits(-1), ..Contact::default() };
        assert_eq!(
            Parameters { contact, ..sound() }.check(),
            Err(ParameterError::Negative { word: 4, got: -1 })
        );
    }

    #[test]
    fn the_hash_sees_every_word() {
        let hash = sound().hash();
        for parameter in Parameter::STORED {
            let mut other = sound();
            let mut words = other.words(parameter);
            words[0] ^= 1;
            other.set(parameter, words).unwrap();
            assert_ne!(other.hash(), hash, "{parameter:?}");
        }
    }

    proptest! {
        #[test]
        fn an_image_comes_back(k in 1_u8..=6, words in any::<[[i16; 4]; 6]>(), period_us in 1_u16..) {
            let mut target = Parameters { joint: k, joints: 6, period_us, ..sound() };
            for (row, [a, d, alpha, offset]) in target.rows.iter_mut().zip(words) {
                *row = Row { a: Q1_14::from_bits(a), d: Q1_14::from_bits(d), alpha: Q1_14::from_bits(alpha), theta_offset: Q1_14::from_bits(offset) };
            }
            prop_assert_eq!(Parameters::from_image(&target.image()), Ok(target));
        }

        #[test]
        fn no_image_panics(bytes in proptest::collection::vec(any::<u8>(), IMAGE_BYTES)) {
            let _ = Parameters::from_image(bytes.as_slice().try_into().unwrap());
        }
    }
}
