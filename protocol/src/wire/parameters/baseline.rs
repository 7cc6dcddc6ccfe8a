//! The baseline settings of a cell's force sensor, parameters 11 and 12. The baseline is the sensor's reading without a
//! touch.

use crate::fixed::{Q1_14, Q5_10};
use crate::packet::{self, WORDS};

/// The baseline mode, parameter 11. It is volatile: a cell starts with [`Baseline::Off`].
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Baseline {
    /// The cell uses the raw sensor value.
    #[default]
    Off,
    /// The cell subtracts the zero that a tare has found from the sensor value.
    On(BaselineSettings),
}

/// The settings with which a cell finds the zero of its force sensor and follows the drift of the sensor.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct BaselineSettings {
    /// Force above the zero from which the cell counts as touched, in N; greater than 0.
    pub threshold: Q5_10,
    /// Fraction of the threshold by which the force must fall below it for a release, 0 to 1.
    pub hysteresis: Q1_14,
    /// Rate at which the zero follows the sensor while the cell is not touched, in µN/s; 0 holds the zero.
    pub rate_un_per_s: u16,
    /// Maximum distance of the zero from 0, in N.
    pub limit: Q5_10,
    /// Drift of the zero with temperature, in N/°C.
    pub n_per_c: Q1_14,
}

impl Baseline {
    const MODE_HOLD: i16 = 1;
    const MODE_FOLLOW: i16 = 2;

    /// Encodes the mode as the words of parameter 11.
    #[must_use]
    pub fn words(self) -> [i16; WORDS] {
        let Self::On(zeroing) = self else { return [0; WORDS] };
        let BaselineSettings { threshold, hysteresis, rate_un_per_s, limit, n_per_c } = zeroing;
        packet::padded_words([
            if rate_un_per_s == 0 { Self::MODE_HOLD } else { Self::MODE_FOLLOW },
            threshold.to_bits(),
            hysteresis.to_bits(),
            rate_un_per_s.cast_signed(),
            limit.to_bits(),
            n_per_c.to_bits(),
        ])
    }

    /// Decodes the words of parameter 11. Returns `None` for an undefined mode, a threshold of 0 or below, a hysteresis
    /// outside 0 to 1, a negative limit, or the mode *follow* with a rate of 0.
    #[must_use]
    pub fn from_words(words: [i16; WORDS]) -> Option<Self> {
        let [mode, threshold, hysteresis, rate, limit, n_per_c] = words;
        let rate_un_per_s = match mode {
            0 => return Some(Self::Off),
            Self::MODE_HOLD => 0,
            Self::MODE_FOLLOW if rate != 0 => rate.cast_unsigned(),
            _ => return None,
        };
        let sound = threshold > 0 && (0..=1 << 14).contains(&hysteresis) && limit >= 0;
        sound.then_some(Self::On(BaselineSettings {
            threshold: Q5_10::from_bits(threshold),
            hysteresis: Q1_14::from_bits(hysteresis),
            rate_un_per_s,
            limit: Q5_10::from_bits(limit),
            n_per_c: Q1_14::from_bits(n_per_c),
        }))
    }
}

/// A tare command: a write of parameter 12.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum TareCommand {
    /// 0: discards the zero. The cell finds a new one as after a start.
    Forget,
    /// 1: takes the present reading as the zero, unless the cell is touched.
    Untouched,
    /// 2: takes the present reading as the zero, even if the cell is touched.
    Forced,
}

impl TareCommand {
    /// Decodes the words of parameter 12. Returns `None` for an undefined command.
    #[must_use]
    pub const fn from_words(words: [i16; WORDS]) -> Option<Self> {
        match words {
            [0, ..] => Some(Self::Forget),
            [1, ..] => Some(Self::Untouched),
            [2, ..] => Some(Self::Forced),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_that_cannot_be_are_none_and_unused_ones_are_zero() {
        let sound = [2, 102, 8_192, 2_000, 512, -33];
        assert_eq!(Baseline::from_words(sound).map(Baseline::words), Some(sound));
        let hold = Baseline::from_words([1, 102, 0, 2_000, 512, 0]).map(Baseline::words);
        assert_eq!(hold, Some([1, 102, 0, 0, 512, 0]));
        assert_eq!(Baseline::from_words([0, -1, -1, -1, -1, -1]), Some(Baseline::Off));
        let spoilt = [
            [3, 102, 0, 1, 512, 0],
            [-1, 102, 0, 1, 512, 0],
            [2, 0, 0, 1, 512, 0],
            [2, -1, 0, 1, 512, 0],
            [2, 102, -1, 1, 512, 0],
            [2, 102, 16_385, 1, 512, 0],
            [2, 102, 0, 0, 512, 0],
            [2, 102, 0, 1, -1, 0],
        ];
        assert!(spoilt.iter().all(|words| Baseline::from_words(*words).is_none()));
    }
}
