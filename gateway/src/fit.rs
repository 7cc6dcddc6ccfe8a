//! `skinbus fit`.

mod text;

use std::path::PathBuf;

use analysis::fit::{self, BusFit, COMPUTATION_NS, rates};
use clap::Args;
use protocol::can::Format;
use protocol::skin::{Bus, Skin};
use protocol::usage::{Failure, print};
use protocol::wire_time::{BitRates, bit_rate};

use super::arguments::{FORMATS, one_of};
use super::output::note;
use super::print::{json, list};

/// Compute whether a skin fits on real buses: load, time from joints to the last answer, cells and buses
///
/// The worst case: all frames are taken as long as bit stuffing can make them, all cells as answering, and the bus as
/// free of errors. Heartbeats count; commands and what only a bench sends do not. For the load of a run see `skinbus
/// shadow`. Default rates: those of the description where it has them for every bus, else a table over common ones.
/// docs/reference/bus-timing.md describes the computation.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus fit gateway/examples/ur5-253.toml
  skinbus fit gateway/examples/ur5-253.toml --nominal 1M --data 5M
  skinbus skin generate --cells 253 --buses 3 > three.toml; skinbus fit three.toml --nominal 500k --format classic")]
pub(crate) struct Fit {
    /// The skin's description
    #[arg(value_name = "SKIN")]
    file: PathBuf,
    /// Bits in a second while identifiers are compared, as 1000000, 500k or 1M: of all buses
    #[arg(long, value_name = "RATE", value_parser = bit_rate)]
    nominal: Option<u32>,
    /// Bits in a second of the data of CAN FD frames
    #[arg(long, value_name = "RATE", value_parser = bit_rate, requires = "nominal")]
    data: Option<u32>,
    /// A table over common bit rates, whatever the description has
    #[arg(long, conflicts_with = "nominal")]
    table: bool,
    /// The frame format of packets on all buses, whatever the description has
    #[arg(long, value_parser = one_of(FORMATS))]
    format: Option<Format>,
    /// The longest that a cell takes from joints to its answer, in µs [the paper's cell: 68.5]
    #[arg(long, value_name = "US", value_parser = computation)]
    computation: Option<u64>,
    /// Everything as JSON
    #[arg(long)]
    json: bool,
}

impl Fit {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let skin = Skin::read(&self.file).map_err(Failure::usage)?;
        let computation_ns = self.computation.unwrap_or(COMPUTATION_NS);
        let chosen = if self.table { None } else { self.rates(&skin)? };
        let (buses, whole, rows) = match chosen {
            None => (Vec::new(), None, fit::table(&skin, self.format, computation_ns)),
            Some(chosen) => {
                let buses = chosen.into_iter().enumerate();
                let fit = |(index, (format, rates))| fit::bus(&skin, index, format, rates, computation_ns);
                let buses: Vec<BusFit> = buses.filter_map(fit).collect();
                let whole = fit::whole(&skin, &buses);
                (buses, whole, Vec::new())
            }
        };
        let is_partly_described = !rows.is_empty() && skin.buses.iter().any(|bus| bus.bitrate.is_some());
        if is_partly_described && !self.table && !self.json {
            let without = skin.buses.iter().filter(|bus| bus.bitrate.is_none()).map(|bus| &bus.name);
            let (without, skin) = (list(without), &skin.name);
            note(format_args!("no bitrate of {without}: these are common bit rates, not those of {skin}"));
        }
        print(&match self.json {
            true => json(&fit::json(&skin, &buses, whole.as_ref(), &rows))?,
            false => text::table(&skin, &rows) + &text::buses(&skin, &buses, whole.as_ref()),
        })
    }

    /// Format and rates of every bus; `None` when neither the command line nor the description has them for all.
    fn rates(&self, skin: &Skin) -> Result<Option<Vec<(Format, BitRates)>>, Failure> {
        let formats: Vec<_> = skin.buses.iter().map(|bus| self.format.unwrap_or(bus.format)).collect();
        let Some(nominal) = self.nominal else {
            let described = skin.buses.iter().zip(&formats).map(|(bus, &format)| described(bus, format));
            return described.collect();
        };
        if self.data.is_some() && !formats.contains(&Format::Fd) {
            return Err(Failure::usage(
                "--data is for CAN FD, and here all buses are classic: leave it out, or add --format fd",
            ));
        }
        let rates = |format| match (format, self.data) {
            (Format::Classic, _) => BitRates::classic(nominal).map_err(Failure::usage),
            (Format::Fd, Some(data)) => BitRates::new(nominal, data).map_err(Failure::usage),
            (Format::Fd, None) => {
                BitRates::classic(nominal).map_err(Failure::usage)?;
                Err(Failure::usage(format!(
                    "CAN FD needs a data bit rate: add --data, {nominal} to {}, or --format classic",
                    BitRates::MAX_DATA
                )))
            }
        };
        formats.into_iter().map(|format| Ok((format, rates(format)?))).collect::<Result<_, _>>().map(Some)
    }
}

/// The rates of a bus in its description.
fn described(bus: &Bus, format: Format) -> Result<Option<(Format, BitRates)>, Failure> {
    let rates = rates::described(bus, format).transpose();
    let rates = rates.map_err(|error| Failure::usage(format!("bus {}: {error}", bus.name)))?;
    Ok(rates.map(|rates| (format, rates)))
}

/// µs, with up to three decimals, as ns.
fn computation(text: &str) -> Result<u64, String> {
    let allowed = "0 to 65000 µs";
    let us: f64 = text.parse().map_err(|_| format!("not a number; allowed is {allowed}"))?;
    if !(0.0..=65_000.0).contains(&us) {
        return Err(format!("allowed is {allowed}"));
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 65 000 000")]
    let ns = (us * 1e3).ceil() as u64;
    Ok(ns)
}
