//! The bit rates of a bus: the requested ones, else the skin's, else common ones.

use protocol::can::Format;
use protocol::skin::Bus;
use protocol::wire_time::{BitRates, BitRatesError};

/// The default, in bit/s.
const NOMINAL: u32 = 1_000_000;
/// The default for FD frames' data.
const DATA: u32 = 5_000_000;

/// Requested bit rates, for all buses.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Requested {
    /// Of identifiers, and of all of a classic frame.
    pub nominal: Option<u32>,
    /// Of FD frames' data.
    pub data: Option<u32>,
}

/// The rates of a bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Chosen {
    /// The rates.
    pub rates: BitRates,
    /// Whether the skin or the caller has chosen them; else they are common ones.
    pub is_chosen: bool,
}

impl Requested {
    /// Of a bus that no skin describes.
    ///
    /// # Errors
    /// When CAN does not have such rates.
    pub fn rates(&self) -> Result<BitRates, BitRatesError> {
        let nominal = self.nominal.unwrap_or(NOMINAL);
        BitRates::new(nominal, self.data.unwrap_or_else(|| nominal.max(DATA)))
    }

    /// Of a bus of a skin.
    ///
    /// # Errors
    /// When CAN does not have such rates.
    pub fn of_bus(&self, bus: &Bus) -> Result<Chosen, BitRatesError> {
        let is_chosen = self.nominal.is_some() || self.data.is_some() || bus.bitrate.is_some();
        let rates = match (self.nominal, self.data, described(bus, bus.format)) {
            (None, None, Some(described)) => described?,
            (nominal, data, _) => {
                let nominal = nominal.or(bus.bitrate);
                let data = data.or(bus.data_bitrate);
                match bus.format {
                    Format::Fd => Self { nominal, data }.rates()?,
                    Format::Classic => BitRates::classic(nominal.unwrap_or(NOMINAL))?,
                }
            }
        };
        Ok(Chosen { rates, is_chosen })
    }
}

/// The rates that a bus' description has, in a format; a data bit rate that it does not have is the nominal one.
#[must_use]
pub fn described(bus: &Bus, format: Format) -> Option<Result<BitRates, BitRatesError>> {
    let nominal = bus.bitrate?;
    Some(match format {
        Format::Fd => BitRates::new(nominal, bus.data_bitrate.unwrap_or(nominal)),
        Format::Classic => BitRates::classic(nominal),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::skin::Skin;

    fn rates(nominal: Option<u32>, data: Option<u32>, described: &str) -> (String, bool) {
        let text = model::generate::generate(&model::generate::Target::default()).unwrap();
        let text = text.replace("format = \"fd\"", described);
        let skin = Skin::parse("skin.toml", &text).unwrap();
        let chosen = Requested { nominal, data }.of_bus(&skin.buses[0]).unwrap();
        (chosen.rates.to_string(), chosen.is_chosen)
    }

    #[test]
    fn rates_are_those_requested_or_the_skins_or_common_ones() {
        let fd = "format = \"fd\"";
        let both = "format = \"fd\"\nbitrate = 500000\ndata_bitrate = 2000000";
        let one = "format = \"fd\"\nbitrate = 500000";
        let classic = "format = \"classic\"";
        let slow = "format = \"classic\"\nbitrate = 250000";
        let (m, k500, m8) = (Some(1_000_000), Some(500_000), Some(8_000_000));
        for (nominal, data, described, expected) in [
            (None, None, fd, ("1M/5M", false)),
            (None, None, both, ("500k/2M", true)),
            (None, None, one, ("500k", true)),
            (None, None, classic, ("1M", false)),
            (None, None, slow, ("250k", true)),
            (m, None, both, ("1M/2M", true)),
            (None, m8, both, ("500k/8M", true)),
            (k500, None, fd, ("500k/5M", true)),
            (k500, m8, slow, ("500k", true)),
        ] {
            assert_eq!(rates(nominal, data, described), (expected.0.to_owned(), expected.1), "{described}");
        }
    }
}
