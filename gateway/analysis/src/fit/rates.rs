//! The bit rates of a bus: the requested ones, or else those in the skin, or else common ones.

use protocol::can::Format;
use protocol::skin::SkinBus;
use protocol::wire_time::{BitRates, BitRatesError};

/// Bit rates that the caller requests for all buses.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct RequestedRates {
    /// Rate of the arbitration phase, and of all of a classic frame.
    pub nominal: Option<u32>,
    /// Rate of the data phase of FD frames.
    pub data: Option<u32>,
}

/// The bit rates of a bus, and where they come from.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ChosenRates {
    /// The rates.
    pub rates: BitRates,
    /// True if the skin or the caller gives the rates; false if they are defaults.
    pub is_chosen: bool,
}

impl RequestedRates {
    /// Returns the rates of a bus that is not in a skin.
    ///
    /// # Errors
    /// Returns [`BitRatesError`] if CAN does not allow these rates.
    pub fn rates(&self) -> Result<BitRates, BitRatesError> {
        let nominal = self.nominal.unwrap_or(SkinBus::DEFAULT_NOMINAL_BIT_RATE);
        BitRates::new(nominal, self.data.unwrap_or_else(|| nominal.max(SkinBus::DEFAULT_DATA_BIT_RATE)))
    }

    /// Returns the rates of a bus of a skin.
    ///
    /// # Errors
    /// Returns [`BitRatesError`] if CAN does not allow these rates.
    pub fn for_bus(&self, bus: &SkinBus) -> Result<ChosenRates, BitRatesError> {
        let is_chosen = self.nominal.is_some() || self.data.is_some() || bus.bitrate.is_some();
        let rates = match (self.nominal, self.data, bus.described_rates(bus.format)) {
            (None, None, Some(described)) => described?,
            (nominal, data, _) => {
                let nominal = nominal.or(bus.bitrate);
                let data = data.or(bus.data_bitrate);
                match bus.format {
                    Format::Fd => Self { nominal, data }.rates()?,
                    Format::Classic => {
                        BitRates::classic(nominal.unwrap_or(SkinBus::DEFAULT_NOMINAL_BIT_RATE))?
                    }
                }
            }
        };
        Ok(ChosenRates { rates, is_chosen })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::skin::Skin;

    fn rates(nominal: Option<u32>, data: Option<u32>, described: &str) -> (String, bool) {
        let text = model::generate::generate(&model::generate::SkinRequest::default()).unwrap();
        let text = text.replace("format = \"fd\"", described);
        let skin = Skin::parse("skin.toml", &text).unwrap();
        let chosen = RequestedRates { nominal, data }.for_bus(&skin.buses[0]).unwrap();
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
