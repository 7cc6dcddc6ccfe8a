//! Bit rates of a bus, and their notation in text.

use core::fmt;
use core::str::FromStr;

use thiserror::Error;

/// The nominal and data bit rate of a bus, within the limits of CAN.
///
/// The notation is `1M/5M`, or `1M` if both rates are equal (classic CAN).
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct BitRates {
    nominal: u32,
    data: u32,
}

/// The error for an invalid bit rate.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum BitRatesError {
    /// The text is not a bit rate.
    #[error("not a bit rate: write it in bit/s, such as 1000000, 500k or 1M")]
    Text,
    /// The nominal bit rate is out of range.
    #[error(
        "nominal bit rate {got} bit/s: CAN allows {} to {} (10k to 1M)",
        BitRates::MIN_NOMINAL_BIT_RATE,
        BitRates::MAX_NOMINAL_BIT_RATE
    )]
    Nominal {
        /// The requested rate in bit/s.
        got: u32,
    },
    /// The data bit rate is out of range.
    #[error(
        "data bit rate {got} bit/s: CAN FD allows {min} (the nominal one) to {} (8M)",
        BitRates::MAX_DATA_BIT_RATE
    )]
    Data {
        /// The requested rate in bit/s.
        got: u32,
        /// The minimum in bit/s: the nominal bit rate.
        min: u32,
    },
}

impl BitRates {
    /// The minimum nominal bit rate in bit/s, also for skin descriptions.
    pub const MIN_NOMINAL_BIT_RATE: u32 = 10_000;
    /// The maximum nominal bit rate in bit/s.
    pub const MAX_NOMINAL_BIT_RATE: u32 = 1_000_000;
    /// The maximum data bit rate in bit/s.
    pub const MAX_DATA_BIT_RATE: u32 = 8_000_000;

    /// Creates a pair of rates in bit/s.
    ///
    /// # Errors
    /// Returns an error if `nominal` is not in [10 000, 1 000 000], or `data` is not
    /// between `nominal` and 8 000 000.
    pub const fn new(nominal: u32, data: u32) -> Result<Self, BitRatesError> {
        if nominal < Self::MIN_NOMINAL_BIT_RATE || nominal > Self::MAX_NOMINAL_BIT_RATE {
            return Err(BitRatesError::Nominal { got: nominal });
        }
        if data < nominal || data > Self::MAX_DATA_BIT_RATE {
            return Err(BitRatesError::Data { got: data, min: nominal });
        }
        Ok(Self { nominal, data })
    }

    /// Creates the rates of a classic bus: one rate in bit/s for all bits.
    ///
    /// # Errors
    /// Returns an error if the rate is not in [10 000, 1 000 000].
    pub const fn classic(nominal: u32) -> Result<Self, BitRatesError> {
        Self::new(nominal, nominal)
    }

    /// Returns the nominal rate in bit/s. Arbitration and frames without bit rate switch use it.
    #[must_use]
    pub const fn nominal_rate(self) -> u32 {
        self.nominal
    }

    /// Returns the data rate in bit/s. The data phase of frames with bit rate switch uses it.
    #[must_use]
    pub const fn data_rate(self) -> u32 {
        self.data
    }
}

/// Parses one bit rate: `1000000`, `500k`, `1M`, `2.5M`. [`BitRates::new`] checks the limits of CAN.
///
/// # Errors
/// Returns an error if the rate is not a whole number of bit/s in [0, 2^32).
pub fn parse_bit_rate(text: &str) -> Result<u32, BitRatesError> {
    let (number, unit) = match text.as_bytes().last() {
        Some(b'k' | b'K') => (text.get(..text.len() - 1).unwrap_or(""), 1_000),
        Some(b'M') => (text.get(..text.len() - 1).unwrap_or(""), 1_000_000),
        _ => (text, 1),
    };
    let (whole, fraction) = number.split_once('.').unwrap_or((number, "0"));
    let is_number = |digits: &str| !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    if !is_number(whole) || !is_number(fraction) {
        return Err(BitRatesError::Text);
    }
    let mut rate =
        whole.parse().ok().and_then(|whole: u32| whole.checked_mul(unit)).ok_or(BitRatesError::Text)?;
    let mut place = unit;
    for digit in fraction.bytes().map(|byte| u32::from(byte - b'0')) {
        if place < 10 && digit > 0 {
            return Err(BitRatesError::Text);
        }
        place /= 10;
        rate = rate.checked_add(digit * place).ok_or(BitRatesError::Text)?;
    }
    Ok(rate)
}

impl FromStr for BitRates {
    type Err = BitRatesError;

    fn from_str(text: &str) -> Result<Self, BitRatesError> {
        let (nominal, data) = text.split_once('/').unwrap_or((text, text));
        Self::new(parse_bit_rate(nominal)?, parse_bit_rate(data)?)
    }
}

impl fmt::Display for BitRates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_rate(f, self.nominal)?;
        if self.data != self.nominal {
            f.write_str("/")?;
            write_rate(f, self.data)?;
        }
        Ok(())
    }
}

fn write_rate(f: &mut fmt::Formatter<'_>, rate: u32) -> fmt::Result {
    match rate {
        _ if rate.is_multiple_of(1_000_000) => write!(f, "{}M", rate / 1_000_000),
        _ if rate.is_multiple_of(1_000) => write!(f, "{}k", rate / 1_000),
        _ => write!(f, "{rate}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bit_rates_are_read_as_people_write_them() {
        for (text, rate) in [
            ("1000000", 1_000_000),
            ("1M", 1_000_000),
            ("500k", 500_000),
            ("500K", 500_000),
            ("2.5M", 2_500_000),
            ("83.333k", 83_333),
            ("0.125M", 125_000),
            ("1.0", 1),
            ("4294967295", u32::MAX),
        ] {
            assert_eq!(parse_bit_rate(text), Ok(rate), "{text}");
        }
        for text in [
            "",
            "M",
            "k",
            "1m",
            "1 M",
            "-1M",
            "+1M",
            "1.",
            ".5M",
            "1.05",
            "1.2345k",
            "5000M",
            "4294967296",
            "1M/5M",
        ] {
            assert_eq!(parse_bit_rate(text), Err(BitRatesError::Text), "{text}");
        }
    }

    #[test]
    fn both_rates_are_written_as_they_are_read() {
        for text in ["1M/5M", "500k/2M", "1M", "83333/83k"] {
            let rates: Result<BitRates, _> = text.parse();
            if text == "83333/83k" {
                assert_eq!(rates, Err(BitRatesError::Data { got: 83_000, min: 83_333 }));
            } else {
                assert_eq!(rates.unwrap().to_string(), text);
            }
        }
        assert_eq!("125000/2500000".parse::<BitRates>().unwrap().to_string(), "125k/2500k");
    }

    #[test]
    fn what_can_does_not_allow_is_refused_with_its_range() {
        let error = |text: &str| text.parse::<BitRates>().unwrap_err().to_string();
        assert_eq!(error("2M/5M"), "nominal bit rate 2000000 bit/s: CAN allows 10000 to 1000000 (10k to 1M)");
        assert_eq!(error("9999"), "nominal bit rate 9999 bit/s: CAN allows 10000 to 1000000 (10k to 1M)");
        assert_eq!(
            error("500k/10M"),
            "data bit rate 10000000 bit/s: CAN FD allows 500000 (the nominal one) to 8000000 (8M)"
        );
        assert_eq!(
            error("1M/500k"),
            "data bit rate 500000 bit/s: CAN FD allows 1000000 (the nominal one) to 8000000 (8M)"
        );
        assert_eq!(error("fast"), "not a bit rate: write it in bit/s, such as 1000000, 500k or 1M");
        assert!(BitRates::new(10_000, 8_000_000).is_ok());
    }
}
