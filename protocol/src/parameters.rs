//! What a cell knows by heart: the robot's table, its own pose, its gains and thresholds, as the words
//! in which they travel and lie in flash.
//!
//! Each parameter is one packet's six words (unused words are 0 and are not looked at):
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
//! | 9 | cuts, volatile | bit p: port p hears nothing (only in test mode) |
//! | 16..=21 | Denavit-Hartenberg row of joint 1..=6 | a, d in m, Q1.14; alpha, theta offset in quarter turns, Q1.14 |
//! | 127 | commit, write only | hash that the written parameters must have |
//!
//! Writing changes a staged copy; a commit with the right hash takes the copy into flash and into use,
//! all of it or nothing.

use thiserror::Error;

use crate::fixed::{Q1_14, Q3_12, Q5_10, Q9_6};
use crate::packet::{WORDS, crc16};

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
    /// 9: which ports are cut, for tests.
    Cuts,
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

const ROW_BASE: u8 = 16;

impl Parameter {
    /// The parameters that are kept in flash, in the order in which they are hashed.
    pub const STORED: [Self; 10] = STORED;

    /// The parameter with this number, if there is one.
    #[must_use]
    pub const fn from_number(number: u8) -> Option<Self> {
        match number {
            0 => Some(Self::Identity),
            1 => Some(Self::Mount),
            2 => Some(Self::Pose),
            3 => Some(Self::Contact),
            4 => Some(Self::Timing),
            5 => Some(Self::Mode),
            6 => Some(Self::Reply),
            7 => Some(Self::Sensing),
            8 => Some(Self::Events),
            9 => Some(Self::Cuts),
            ROW_BASE..=21 => Some(Self::Row(number - ROW_BASE)),
            127 => Some(Self::Commit),
            _ => None,
        }
    }

    /// Whether it is in force as soon as it is written, is not stored, and is forgotten by a start.
    #[must_use]
    pub const fn is_volatile(self) -> bool {
        match self {
            Self::Mode | Self::Reply | Self::Sensing | Self::Events | Self::Cuts => true,
            Self::Identity
            | Self::Mount
            | Self::Pose
            | Self::Contact
            | Self::Timing
            | Self::Row(_)
            | Self::Commit => false,
        }
    }

    /// Its number.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::Identity => 0,
            Self::Mount => 1,
            Self::Pose => 2,
            Self::Contact => 3,
            Self::Timing => 4,
            Self::Mode => 5,
            Self::Reply => 6,
            Self::Sensing => 7,
            Self::Events => 8,
            Self::Cuts => 9,
            Self::Row(row) => ROW_BASE + row,
            Self::Commit => 127,
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

/// What a cell answers joints with, parameter 6. Volatile: a cell starts with [`Reply::Torque`].
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Reply {
    /// Its own torque, Q3.12.
    #[default]
    Torque,
    /// The sum of its own and its children's, Q7.8, in slots by depth.
    Sum(Slots),
}

/// When sums are said.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Slots {
    /// Width of a slot in µs.
    pub slot_us: u16,
    /// Depth of the deepest cell; a root's is 0. A cell at depth d speaks in slot `deepest - d`.
    pub deepest: u8,
    /// Whether what rounding took away is carried into a cell's next value.
    pub carry: bool,
}

impl Reply {
    /// The words of the parameter.
    #[must_use]
    pub const fn words(self) -> [i16; WORDS] {
        match self {
            Self::Torque => [0; WORDS],
            Self::Sum(Slots { slot_us, deepest, carry }) => {
                [1, slot_us.cast_signed(), deepest as i16, carry as i16, 0, 0]
            }
        }
    }

    /// What the words say; `None` when they cannot be: no such reply, no slot, or a depth above 253.
    #[must_use]
    pub fn from_words(words: [i16; WORDS]) -> Option<Self> {
        let [kind, slot_us, deepest, carry, ..] = words;
        match kind {
            0 => Some(Self::Torque),
            1 if slot_us != 0 => Some(Self::Sum(Slots {
                slot_us: slot_us.cast_unsigned(),
                deepest: u8::try_from(deepest).ok().filter(|deepest| *deepest <= 253)?,
                carry: carry == 1,
            })),
            _ => None,
        }
    }
}

/// When a cell sends what it measures without being asked, parameter 7. Volatile: a cell starts with
/// [`Sensing::Off`].
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Sensing {
    /// Only when a report asks for it.
    #[default]
    Off,
    /// Every so many ms.
    Continuous {
        /// From one to the next.
        period_ms: u16,
    },
    /// On change beyond a threshold, on release, and with each heartbeat.
    Event,
}

impl Sensing {
    /// The words of the parameter.
    #[must_use]
    pub const fn words(self) -> [i16; WORDS] {
        match self {
            Self::Off => [0; WORDS],
            Self::Continuous { period_ms } => [1, period_ms.cast_signed(), 0, 0, 0, 0],
            Self::Event => [2, 0, 0, 0, 0, 0],
        }
    }

    /// What the words say; `None` when they cannot be: no such mode, or a period of 0.
    #[must_use]
    pub const fn from_words(words: [i16; WORDS]) -> Option<Self> {
        match words {
            [0, ..] => Some(Self::Off),
            [1, period_ms, ..] if period_ms != 0 => {
                Some(Self::Continuous { period_ms: period_ms.cast_unsigned() })
            }
            [2, ..] => Some(Self::Event),
            _ => None,
        }
    }
}

/// Which changes of what a cell measures are events, parameter 8. Volatile: a cell starts with
/// [`Events::default`].
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Events {
    /// Of each contact word, in N.
    pub contact: Q5_10,
    /// Of the proximity.
    pub proximity: Q1_14,
    /// Of each temperature, in degrees Celsius.
    pub temperature: Q9_6,
    /// Of each axis' acceleration, in g.
    pub acceleration: Q3_12,
    /// What part of a threshold a value has to fall below it for a release, 0 to 1.
    pub hysteresis: Q1_14,
}

impl Default for Events {
    /// 0.1 N, 0.05, 0.5 °C, 0.1 g; a release is half a threshold below it.
    fn default() -> Self {
        Self {
            contact: Q5_10::from_bits(102),
            proximity: Q1_14::from_bits(819),
            temperature: Q9_6::from_bits(32),
            acceleration: Q3_12::from_bits(410),
            hysteresis: Q1_14::from_bits(8_192),
        }
    }
}

impl Events {
    /// The words of the parameter.
    #[must_use]
    pub const fn words(self) -> [i16; WORDS] {
        [
            self.contact.to_bits(),
            self.proximity.to_bits(),
            self.temperature.to_bits(),
            self.acceleration.to_bits(),
            self.hysteresis.to_bits(),
            0,
        ]
    }

    /// What the words say; `None` when one is negative, or the hysteresis above 1.
    #[must_use]
    pub fn from_words(words: [i16; WORDS]) -> Option<Self> {
        let [contact, proximity, temperature, acceleration, hysteresis, _] = words;
        let sound = words.iter().all(|&word| word >= 0) && hysteresis <= 1 << 14;
        sound.then_some(Self {
            contact: Q5_10::from_bits(contact),
            proximity: Q1_14::from_bits(proximity),
            temperature: Q9_6::from_bits(temperature),
            acceleration: Q3_12::from_bits(acceleration),
            hysteresis: Q1_14::from_bits(hysteresis),
        })
    }
}

impl Cuts {
    /// The words of the parameter.
    #[must_use]
    pub const fn words(self) -> [i16; WORDS] {
        [self.deaf as i16, 0, 0, 0, 0, 0]
    }

    /// What the words say; other bits than those of ports are not looked at.
    #[must_use]
    pub const fn from_words(words: [i16; WORDS]) -> Self {
        let [deaf, ..] = words;
        Self { deaf: deaf.to_le_bytes()[0] & 0x1F }
    }
}

/// Which ports of a cell hear nothing, neither messages nor sums, parameter 9: how a bench cuts a wire, in one
/// direction at each end. Obeyed in test mode only.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Cuts {
    /// Bit p: port p hears nothing; bit 4 is the wire to the gateway's side.
    pub deaf: u8,
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
            Parameter::Mount => [i16::from(self.joint), i16::from(self.joints), 0, 0, 0, 0],
            Parameter::Pose => {
                let ([x, y, z], [nx, ny, nz]) = (self.pose.position, self.pose.normal);
                [x, y, z, nx, ny, nz].map(Q1_14::to_bits)
            }
            Parameter::Contact => [
                self.contact.alpha_c.to_bits(),
                self.contact.alpha_p.to_bits(),
                self.contact.contact_threshold.to_bits(),
                self.contact.proximity_threshold.to_bits(),
                self.contact.force_threshold.to_bits(),
                0,
            ],
            Parameter::Timing => [self.period_us.cast_signed(), 0, 0, 0, 0, 0],
            Parameter::Row(row) => {
                let row = self.rows.get(usize::from(row)).copied().unwrap_or_default();
                [row.a.to_bits(), row.d.to_bits(), row.alpha.to_bits(), row.theta_offset.to_bits(), 0, 0]
            }
            Parameter::Identity
            | Parameter::Mode
            | Parameter::Reply
            | Parameter::Sensing
            | Parameter::Events
            | Parameter::Cuts
            | Parameter::Commit => [0; WORDS],
        }
    }

    /// Takes the words of one parameter as they are; [`Parameters::check`] looks at the whole.
    ///
    /// # Errors
    /// When the parameter is not one that is stored, or a count does not fit its byte.
    pub fn set(&mut self, parameter: Parameter, words: [i16; WORDS]) -> Result<(), ParameterError> {
        let [w0, w1, w2, w3, w4, w5] = words;
        match parameter {
            Parameter::Mount => {
                self.joints = u8::try_from(w1).map_err(|_| ParameterError::Joints { got: w1 })?;
                self.joint = u8::try_from(w0).map_err(|_| ParameterError::Joint { got: w0, joints: w1 })?;
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
            | Parameter::Cuts
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
            let mut wanted = Parameters { joint: k, joints: 6, period_us, ..sound() };
            for (row, [a, d, alpha, offset]) in wanted.rows.iter_mut().zip(words) {
                *row = Row { a: Q1_14::from_bits(a), d: Q1_14::from_bits(d), alpha: Q1_14::from_bits(alpha), theta_offset: Q1_14::from_bits(offset) };
            }
            prop_assert_eq!(Parameters::from_image(&wanted.image()), Ok(wanted));
        }

        #[test]
        fn no_image_panics(bytes in proptest::collection::vec(any::<u8>(), IMAGE_BYTES)) {
            let _ = Parameters::from_image(bytes.as_slice().try_into().unwrap());
        }
    }
}
