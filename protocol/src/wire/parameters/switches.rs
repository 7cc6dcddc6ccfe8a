//! Volatile parameters that the gateway sets at run time: 6 to 9. The baseline is volatile too, but has its own module.

use crate::fixed::{Q1_14, Q3_12, Q5_10, Q9_6};
use crate::packet::{self, WORDS};

/// The message with which a cell replies to joints, parameter 6. It is volatile: a cell starts with
/// [`ReplyKind::Torque`].
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum ReplyKind {
    /// The cell's own torque, in the torque format of its parameters.
    #[default]
    Torque,
    /// The sum of the cell's own torque and those of its children in the tree, in Q7.8. Cells send at times that depend
    /// on their depth.
    Sum(SumSchedule),
}

/// The schedule by which the cells of a tree send their sums, the deepest first.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct SumSchedule {
    /// Width of a slot in µs.
    pub slot_us: u16,
    /// Depth of the deepest cell; a root has depth 0. A cell at depth d sends in slot `deepest - d`.
    pub deepest: u8,
    /// True if a cell adds the rounding error of a sum to its next sum.
    pub carry: bool,
}

impl ReplyKind {
    /// Encodes the reply as the words of parameter 6.
    #[must_use]
    pub fn words(self) -> [i16; WORDS] {
        match self {
            Self::Torque => [0; WORDS],
            Self::Sum(SumSchedule { slot_us, deepest, carry }) => {
                packet::padded_words([1, slot_us.cast_signed(), i16::from(deepest), i16::from(carry)])
            }
        }
    }

    /// Decodes the words of parameter 6. Returns `None` for an undefined reply, a slot of 0, a depth above 253, or a
    /// carry other than 0 and 1.
    #[must_use]
    pub fn from_words(words: [i16; WORDS]) -> Option<Self> {
        match words {
            [0, ..] => Some(Self::Torque),
            [1, slot_us, deepest, carry @ (0 | 1), ..] if slot_us != 0 => Some(Self::Sum(SumSchedule {
                slot_us: slot_us.cast_unsigned(),
                deepest: u8::try_from(deepest).ok().filter(|deepest| *deepest <= 253)?,
                carry: carry == 1,
            })),
            _ => None,
        }
    }
}

/// The times at which a cell sends measurements, parameter 7. It is volatile: a cell starts with [`Sensing::Off`].
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Sensing {
    /// Measurements are sent only in response to a report command.
    #[default]
    Off,
    /// Measurements are sent periodically.
    Continuous {
        /// The period in ms.
        period_ms: u16,
    },
    /// Measurements are sent when a value exceeds its threshold or is released, and with each heartbeat.
    Event,
}

impl Sensing {
    /// Encodes the mode as the words of parameter 7.
    #[must_use]
    pub fn words(self) -> [i16; WORDS] {
        match self {
            Self::Off => [0; WORDS],
            Self::Continuous { period_ms } => packet::padded_words([1, period_ms.cast_signed()]),
            Self::Event => packet::padded_words([2]),
        }
    }

    /// Decodes the words of parameter 7. Returns `None` for an undefined mode or a period of 0.
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

/// The thresholds of event mode, parameter 8. They are volatile: a cell starts with [`Events::default`].
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Events {
    /// Threshold of each contact word, in N.
    pub contact: Q5_10,
    /// Threshold of the proximity.
    pub proximity: Q1_14,
    /// Threshold of each temperature, in degrees Celsius.
    pub temperature: Q9_6,
    /// Threshold of the acceleration on each axis, in g.
    pub acceleration: Q3_12,
    /// Fraction of the threshold by which a value must fall below it for a release, 0 to 1.
    pub hysteresis: Q1_14,
}

impl Default for Events {
    /// Returns thresholds of 0.1 N, 0.05, 0.5 °C and 0.1 g, and a hysteresis of one half.
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
    /// Encodes the thresholds as the words of parameter 8.
    #[must_use]
    pub fn words(self) -> [i16; WORDS] {
        packet::padded_words([
            self.contact.to_bits(),
            self.proximity.to_bits(),
            self.temperature.to_bits(),
            self.acceleration.to_bits(),
            self.hysteresis.to_bits(),
        ])
    }

    /// Decodes the words of parameter 8. Returns `None` if a word is negative or the hysteresis is above 1.
    #[must_use]
    pub fn from_words(words: [i16; WORDS]) -> Option<Self> {
        let [thresholds @ .., _] = words;
        let [contact, proximity, temperature, acceleration, hysteresis] = thresholds;
        let sound = thresholds.iter().all(|&word| word >= 0) && hysteresis <= 1 << 14;
        sound.then_some(Self {
            contact: Q5_10::from_bits(contact),
            proximity: Q1_14::from_bits(proximity),
            temperature: Q9_6::from_bits(temperature),
            acceleration: Q3_12::from_bits(acceleration),
            hysteresis: Q1_14::from_bits(hysteresis),
        })
    }
}

impl LinksDown {
    /// Encodes the mask as the words of parameter 9.
    #[must_use]
    pub fn words(self) -> [i16; WORDS] {
        packet::padded_words([i16::from(self.ports)])
    }

    /// Decodes the words of parameter 9. Bits without a port are ignored.
    #[must_use]
    pub const fn from_words(words: [i16; WORDS]) -> Self {
        let [deaf, ..] = words;
        Self { ports: deaf.to_le_bytes()[0] & 0x1F }
    }
}

/// The ports of a cell that receive neither messages nor sums, parameter 9. A bench uses it to interrupt a link: each
/// end stops one direction. It is effective only in test mode.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct LinksDown {
    /// Bit p is set if port p receives nothing; bit 4 is the wire to the gateway's side.
    pub ports: u8,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_bits_of_ports_are_looked_at() {
        for (word, deaf) in [(0, 0), (0b1_0010, 0b1_0010), (-1, 0x1F), (0x7FE0, 0)] {
            assert_eq!(LinksDown::from_words([word, 0, 0, 0, 0, 0]).ports, deaf);
        }
    }

    #[test]
    fn events_come_back_from_their_words_unless_one_is_negative_or_the_hysteresis_above_1() {
        let words = [1, 2, 3, 4, 1 << 14, 0];
        let events = Events::from_words(words).unwrap();
        assert_eq!((events.contact.to_bits(), events.temperature.to_bits(), events.words()), (1, 3, words));
        for (at, word) in [(0, -1), (1, -1), (2, -1), (3, -1), (4, -1), (4, (1 << 14) + 1)] {
            let mut unsound = words;
            unsound[at] = word;
            assert_eq!(Events::from_words(unsound), None, "{unsound:?}");
        }
    }
}
