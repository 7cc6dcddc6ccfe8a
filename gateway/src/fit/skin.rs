//! Fit of a skin on real buses in the worst case.

use analysis::fit::{self, BusFit, PAPER_COMPUTATION_NS};
use protocol::can::Format;
use protocol::skin::{Skin, SkinBus};
use protocol::usage::{Failure, print_text};
use protocol::wire_time::BitRates;

use super::{FitCommand, skin_text};
use crate::output::print_note;
use crate::print::{comma_separated, to_pretty_json};

impl FitCommand {
    /// Computes and prints the fit of a skin.
    pub(super) fn print_skin_fit(&self, skin: &Skin) -> Result<(), Failure> {
        let computation_ns = self.computation.unwrap_or(PAPER_COMPUTATION_NS);
        let chosen = if self.table { None } else { self.bit_rates_of_buses(skin)? };
        let (buses, whole, rows) = match chosen {
            None => (Vec::new(), None, fit::rates_table(skin, self.format, computation_ns)),
            Some(chosen) => {
                let buses = chosen.into_iter().enumerate();
                let fit =
                    |(index, (format, rates))| fit::assess_bus(skin, index, format, rates, computation_ns);
                let buses: Vec<BusFit> = buses.filter_map(fit).collect();
                let whole = fit::spread_over_buses(skin, &buses);
                (buses, whole, Vec::new())
            }
        };
        let is_partly_described = !rows.is_empty() && skin.buses.iter().any(|bus| bus.bitrate.is_some());
        if is_partly_described && !self.table && !self.json {
            let without = skin.buses.iter().filter(|bus| bus.bitrate.is_none()).map(|bus| &bus.name);
            let (without, skin) = (comma_separated(without), &skin.name);
            print_note(format_args!(
                "the skin {skin} gives no bitrate for {without}, so the table lists common bit rates"
            ));
        }
        print_text(&match self.json {
            true => to_pretty_json(&fit::fit_json(skin, &buses, whole.as_ref(), &rows))?,
            false => {
                skin_text::table(skin, &rows) + &skin_text::format_bus_fits(skin, &buses, whole.as_ref())
            }
        })
    }

    /// Returns the format and the bit rates of each bus, or `None` if neither the command line nor the skin gives rates
    /// for all buses.
    fn bit_rates_of_buses(&self, skin: &Skin) -> Result<Option<Vec<(Format, BitRates)>>, Failure> {
        let formats: Vec<_> = skin.buses.iter().map(|bus| self.format.unwrap_or(bus.format)).collect();
        let Some(nominal) = self.nominal else {
            let described =
                skin.buses.iter().zip(&formats).map(|(bus, &format)| bit_rates_from_skin(bus, format));
            return described.collect();
        };
        if self.data.is_some() && !formats.contains(&Format::Fd) {
            return Err(Failure::usage_error(
                "--data is only for CAN FD, but all buses are classic: leave it out, or add --format fd",
            ));
        }
        let rates = |format| match (format, self.data) {
            (Format::Classic, _) => BitRates::classic(nominal).map_err(Failure::usage_error),
            (Format::Fd, Some(data)) => BitRates::new(nominal, data).map_err(Failure::usage_error),
            (Format::Fd, None) => {
                BitRates::classic(nominal).map_err(Failure::usage_error)?;
                Err(Failure::usage_error(format!(
                    "CAN FD needs a data bit rate: add --data with {nominal} to {} bit/s, or --format classic",
                    BitRates::MAX_DATA_BIT_RATE
                )))
            }
        };
        formats.into_iter().map(|format| Ok((format, rates(format)?))).collect::<Result<_, _>>().map(Some)
    }
}

/// Returns the bit rates that the skin gives for a bus, with the format.
fn bit_rates_from_skin(bus: &SkinBus, format: Format) -> Result<Option<(Format, BitRates)>, Failure> {
    let rates = bus.described_rates(format).transpose();
    let rates = rates.map_err(|error| Failure::usage_error(format!("bus {}: {error}", bus.name)))?;
    Ok(rates.map(|rates| (format, rates)))
}
