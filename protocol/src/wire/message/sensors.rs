//! Sensor pages: measurements, and the simulated values of a stimulus.

use super::MessageError;
use crate::fixed::{Q1_14, Q3_12, Q5_10, Q9_6};
use crate::id::Kind;
use crate::packet::{self, WORDS};

/// A page of sensor values: measured by a cell, or simulated by a stimulus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum SensorPage {
    /// Page 0: contact forces, proximity and temperatures.
    Skin(SkinSensors),
    /// Page 1: accelerometer x, y, z in g.
    Acceleration([Q3_12; 3]),
    /// Page 3: the baseline of the force sensor. A cell measures it; a stimulus cannot contain it.
    Baseline(BaselinePage),
}

/// Sensor page 3: the baseline of the force sensor.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct BaselinePage {
    /// The zero in N, which is subtracted from the sum of the contact words.
    pub zero: Q5_10,
    /// The drift of the zero with temperature, in N/°C.
    pub n_per_c: Q1_14,
    /// The temperature at which the zero was measured, in degrees Celsius.
    pub temperature: Q9_6,
    /// True if the cell has a zero, from a tare.
    pub tared: bool,
    /// True while the cell is touched. The zero does not follow the sensor during a touch.
    pub touched: bool,
    /// True if the zero is at its limit.
    pub limited: bool,
    /// Number of refused tares, modulo 2^16.
    pub refused: u16,
}

/// Sensor page 0: contact forces, proximity and temperatures.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SkinSensors {
    /// Three capacitive contact forces in N. The force of a touch is their sum.
    pub contact: [Q5_10; 3],
    /// Proximity, from 0 (nothing near) to 1.
    pub proximity: Q1_14,
    /// Two temperatures in degrees Celsius.
    pub temperature: [Q9_6; 2],
}

/// The values of all simulated pages: the contact state of a cell.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SensorReadings {
    /// Page 0.
    pub skin: SkinSensors,
    /// Page 1: acceleration in g.
    pub acceleration: [Q3_12; 3],
}

impl SensorReadings {
    /// Sets the values of a page. Other pages than simulated ones have no effect.
    pub const fn set_page(&mut self, page: &SensorPage) {
        match *page {
            SensorPage::Skin(skin) => self.skin = skin,
            SensorPage::Acceleration(acceleration) => self.acceleration = acceleration,
            SensorPage::Baseline(_) => {}
        }
    }

    /// Returns the simulated pages, in the order of [`SensorPage::SIMULATED_PAGE_NAMES`].
    #[must_use]
    pub const fn simulated_pages(&self) -> [SensorPage; SensorPage::SIMULATED_PAGE_NAMES.len()] {
        [SensorPage::Skin(self.skin), SensorPage::Acceleration(self.acceleration)]
    }
}

impl SensorPage {
    /// The names of the simulated pages: those that a cell measures and a stimulus sets.
    pub const SIMULATED_PAGE_NAMES: [&str; 2] = ["skin", "acceleration"];

    /// Returns the index in [`Self::SIMULATED_PAGE_NAMES`]; `None` for a page that is only measured.
    #[must_use]
    pub const fn simulated_index(&self) -> Option<usize> {
        match self {
            Self::Skin(_) => Some(0),
            Self::Acceleration(_) => Some(1),
            Self::Baseline(_) => None,
        }
    }

    /// Returns the page of a stimulus with these words.
    ///
    /// # Errors
    /// Returns an error if a stimulus has no page of this number.
    pub fn from_stimulus(number: u8, words: [i16; WORDS]) -> Result<Self, MessageError> {
        Self::decode(Kind::Stimulus, number, words)
    }

    /// Returns the number of the page.
    #[must_use]
    pub fn number(&self) -> u8 {
        self.encode().0
    }

    /// Returns the words of the page.
    #[must_use]
    pub fn words(&self) -> [i16; WORDS] {
        self.encode().1
    }

    pub(super) fn decode(kind: Kind, page: u8, words: [i16; WORDS]) -> Result<Self, MessageError> {
        let [a, b, c, d, e, f, ..] = words;
        match page {
            0 => Ok(Self::Skin(SkinSensors {
                contact: [a, b, c].map(Q5_10::from_bits),
                proximity: Q1_14::from_bits(d),
                temperature: [e, f].map(Q9_6::from_bits),
            })),
            1 => Ok(Self::Acceleration([a, b, c].map(Q3_12::from_bits))),
            3 if kind == Kind::Sensors => Ok(Self::Baseline(BaselinePage {
                zero: Q5_10::from_bits(a),
                n_per_c: Q1_14::from_bits(b),
                temperature: Q9_6::from_bits(c),
                tared: d & 1 != 0,
                touched: d & 2 != 0,
                limited: d & 4 != 0,
                refused: e.cast_unsigned(),
            })),
            _ => Err(MessageError::Page { kind, page }),
        }
    }

    pub(super) fn encode(self) -> (u8, [i16; WORDS]) {
        match self {
            Self::Skin(SkinSensors { contact, proximity, temperature }) => {
                let ([a, b, c], [e, f]) = (contact.map(Q5_10::to_bits), temperature.map(Q9_6::to_bits));
                (0, packet::padded_words([a, b, c, proximity.to_bits(), e, f]))
            }
            Self::Acceleration(xyz) => (1, packet::padded_words(xyz.map(Q3_12::to_bits))),
            Self::Baseline(BaselinePage { zero, n_per_c, temperature, tared, touched, limited, refused }) => {
                let state = i16::from(tared) | i16::from(touched) << 1 | i16::from(limited) << 2;
                let words =
                    [zero.to_bits(), n_per_c.to_bits(), temperature.to_bits(), state, refused.cast_signed()];
                (3, packet::padded_words(words))
            }
        }
    }
}
