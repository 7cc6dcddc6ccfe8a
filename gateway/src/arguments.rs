//! Arguments that several commands share, and parsers of their values.

use std::net::SocketAddr;
use std::ops::RangeInclusive;

use bench::bus::time::BusTimeChoice;
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use protocol::bus::{BusKind, KindChoice, KindChoices, KindOption};
use protocol::can::Format;
use protocol::skin::{CellName, Skin};
use protocol::usage::Failure;

use super::print::comma_separated;

/// A possible value of an option: its name, its help text (empty if the name says enough), and the value.
pub(crate) type OptionValue<T> = (&'static str, &'static str, T);

/// Frame formats of a packet.
pub(crate) const FORMATS: &[OptionValue<Format>] = &[
    ("fd", "Each packet is one CAN FD frame", Format::Fd),
    ("classic", "Each packet is two to four classic frames", Format::Classic),
];

/// Creates a parser that accepts one of these words.
pub(crate) fn one_of_values<T: Copy + Send + Sync + 'static>(
    words: &'static [OptionValue<T>],
) -> impl TypedValueParser<Value = T> {
    let allowed = words.iter().map(|(word, about, _)| match *about {
        "" => PossibleValue::new(*word),
        about => PossibleValue::new(*word).help(about),
    });
    PossibleValuesParser::new(allowed).try_map(|given| {
        let found = words.iter().find(|(word, ..)| *word == given);
        found.map(|(.., value)| *value).ok_or("not one of the words")
    })
}

/// Parses a time in seconds: a number, with or without a unit.
pub(crate) fn parse_time(text: &str) -> Option<f64> {
    let units = [("ms", 1e-3), ("min", 60.0), ("h", 3_600.0), ("s", 1.0)];
    let given = units.iter().find_map(|(unit, each)| Some((text.strip_suffix(unit)?, *each)));
    let (number, each) = given.unwrap_or((text, 1.0));
    number.parse::<f64>().ok().map(|number| number * each)
}

/// Parses a time above 0 s, up to 1e7 s.
pub(crate) fn parse_duration(text: &str) -> Result<f64, String> {
    let seconds = parse_time(text).filter(|seconds| *seconds > 0.0 && *seconds <= 1e7);
    seconds.ok_or_else(|| "use a time above 0 s, up to 1e7 s, such as 10, 500ms, 90s, 10min or 2h".to_owned())
}

/// Parses a time from 0 s to 1e9 s, and returns it in ns.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 1e18: checked")]
pub(crate) fn parse_time_ns(text: &str) -> Result<u64, String> {
    let seconds = parse_time(text).filter(|seconds| (0.0..=1e9).contains(seconds));
    let nanos = seconds.map(|seconds| (seconds * 1e9).round() as u64);
    nanos.ok_or_else(|| "use a time from 0 s to 1e9 s, such as 10, 500ms, 90s, 10min or 2h".to_owned())
}

/// Parses the address at which a page is served.
pub(crate) fn parse_address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| {
        "use an IP address and a port, such as 127.0.0.1:8100 or [::1]:8100; port 0 is any free one"
            .to_owned()
    })
}

/// The option for the kinds of one or several buses.
#[derive(Args, Clone, Debug)]
pub(crate) struct BusKinds {
    #[arg(long, value_name = "[BUS=]KIND", help = kinds_help())]
    bus_kind: Vec<KindOption>,
}

/// The option for the time that frames take on embedded buses.
#[derive(Args, Clone, Copy, Debug)]
pub(crate) struct BusTimeOption {
    /// Time that frames take on embedded buses: none; real, from the skin's bit rates (else 1M/5M); or, with a transmit
    /// queue of N frames, real:fifo:N or real:priority:N [default: as the skin says, else none]
    #[arg(long, value_name = "TIME")]
    bus_time: Option<BusTimeChoice>,
}

impl BusTimeOption {
    pub(crate) fn choice(self) -> BusTimeChoice {
        self.bus_time.unwrap_or_default()
    }
}

fn kinds_help() -> String {
    format!(
        "Kind of all buses, or as BUS=KIND of one (repeatable): {}. Default: auto, socketcan if the bus has an \
         interface of its name, else embedded",
        BusKind::choices()
    )
}

impl BusKinds {
    /// Returns the kinds that the option names, for any buses.
    pub(crate) fn kinds_of_any_buses(&self) -> Result<KindChoices, Failure> {
        self.kinds_or_default(KindChoice::Auto)
    }

    /// Returns the kinds that the option names, for any buses. `otherwise` is the kind of the buses that it does not
    /// name.
    pub(crate) fn kinds_or_default(&self, otherwise: KindChoice) -> Result<KindChoices, Failure> {
        KindChoices::from_options(&self.bus_kind, otherwise).map_err(Failure::usage_error)
    }

    /// Returns the kinds of these buses, or an error if the option names another bus.
    pub(crate) fn kinds_of_buses<'a>(
        &self,
        buses: impl IntoIterator<Item = &'a str>,
    ) -> Result<KindChoices, Failure> {
        self.kinds_of_any_buses()?.restrict_to(buses).map_err(Failure::usage_error)
    }
}

/// Reads a whole number from the environment variable `name`, for settings that few users need.
pub(crate) fn environment_number(name: &str, allowed: RangeInclusive<u32>) -> Result<Option<u32>, Failure> {
    let Some(given) = std::env::var_os(name).filter(|given| !given.is_empty()) else { return Ok(None) };
    let number = given.to_str().and_then(|text| text.parse().ok()).filter(|number| allowed.contains(number));
    number.map(Some).ok_or_else(|| {
        let (given, [min, max]) = (given.display(), [allowed.start(), allowed.end()]);
        Failure::usage_error(format!("the environment variable {name} is {given}: use {min} to {max}"))
    })
}

/// Reads the number of cells per process from the environment, for the few users who need it.
pub(crate) fn cells_per_process() -> Result<usize, Failure> {
    Ok(environment_number("SKINBUS_CELLS_PER_PROCESS", 1..=254)?.unwrap_or(1) as usize)
}

/// The option for the number of cells per process.
#[derive(Args, Clone, Copy, Debug)]
pub(crate) struct ProcessOptions {
    /// Run up to N cells in each process
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=254))]
    pub(crate) cells_per_process: u8,
}

/// Returns the names of a skin's buses.
pub(crate) fn bus_names(skin: &Skin) -> impl Iterator<Item = &str> {
    skin.buses.iter().map(|bus| bus.name.as_str())
}

/// Returns the index of the bus with this name in the skin that `file` describes.
pub(crate) fn find_bus(skin: &Skin, file: &str, name: &str) -> Result<usize, Failure> {
    skin.bus_index(name).ok_or_else(|| {
        let names = comma_separated(bus_names(skin));
        Failure::usage_error(format!("the skin file {file} has no bus {name}; its buses are {names}"))
    })
}

/// Returns the index into [`Skin::cells`] of the cell with this name, if there is exactly one. `option` names the
/// option in errors.
pub(crate) fn find_cell(skin: &Skin, name: &CellName, option: &str) -> Result<usize, Failure> {
    let CellName { bus, node } = name;
    let names = || comma_separated(bus_names(skin));
    if bus.as_ref().is_some_and(|bus| skin.bus_index(bus).is_none()) {
        return Err(Failure::usage_error(format!(
            "{option} {name}: the skin has no such bus; it has {}",
            names()
        )));
    }
    let there: Vec<_> = skin.cells_named(name).collect();
    match there.as_slice() {
        [(index, _)] => Ok(*index),
        [] => Err(Failure::usage_error(format!(
            "{option} {node}: the skin has no such cell on {}",
            bus.clone().unwrap_or_else(names)
        ))),
        cells => {
            let choices = cells.iter().map(|(_, cell)| skin.full_cell_name(cell.bus, cell.node));
            let choices = comma_separated(choices.map(|name| name.to_string()));
            Err(Failure::usage_error(format!(
                "{option} {node}: several buses have a cell with this node id; choose one of {choices}"
            )))
        }
    }
}
