//! `skinbus sensing`.

use bench::sensing::{open, switch};
use clap::Args;
use model::decode::parameter::Words;
use protocol::can::Format;
use protocol::id::CellId;
use protocol::parameters::{Parameter, Sensing as Mode};
use protocol::skin::sensing::continuous;
use protocol::usage::{Failure, print};

use super::arguments::{BusKind, FORMATS, Word, one_of};

/// Set when the cells of a running bench send their sensors: never, at a rate, or on changes
///
/// Takes effect at once, waits until every cell on the bus has confirmed it, and lists those that do not. A gateway
/// that runs on the bus restores it: it switches a restarted cell to its last mode. Which changes count is parameter 8,
/// which a skin has under [events]: `skinbus frame configure --write events`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus sensing vcan0 event
  skinbus sensing vcan0 continuous 62.5 --node 12
  skinbus sensing vcan0 off")]
pub(crate) struct Sensing {
    /// The bus
    bus: String,
    /// When cells send their sensors
    #[arg(value_parser = one_of(MODES))]
    mode: When,
    /// How often, in continuous mode: frames of each cell a second
    #[arg(value_name = "HZ", allow_negative_numbers = true)]
    hz: Option<f64>,
    /// Only this cell, 1 to 254; else all
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=254))]
    node: Option<u8>,
    /// The frame format of packets on the bus
    #[arg(long, value_parser = one_of(FORMATS), default_value = "fd")]
    format: Format,
    #[command(flatten)]
    kind: BusKind,
}

/// When cells send their sensors.
#[derive(Clone, Copy, Debug)]
enum When {
    Off,
    Continuous,
    Event,
}

const MODES: &[Word<When>] = &[
    ("off", "Only on a report", When::Off),
    ("continuous", "At a rate", When::Continuous),
    ("event", "On changes, and with each heartbeat", When::Event),
];

impl Sensing {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let mode = self.mode().map_err(Failure::usage)?;
        let bus = open(&self.bus, self.kind.bus_kind, self.format).map_err(Failure::usage)?;
        let on = format!("{} ({})", bus.name(), bus.kind());
        let only = self.node.and_then(|node| CellId::new(node.into()).ok());
        let confirmed = switch(bus, self.format, only, mode).map_err(Failure::run)?;
        print(&format!("{confirmed} on {on}: {}\n", Words(Parameter::Sensing.number(), mode.words())))
    }

    fn mode(&self) -> Result<Mode, String> {
        match (self.mode, self.hz) {
            (When::Off, None) => Ok(Mode::Off),
            (When::Event, None) => Ok(Mode::Event),
            (When::Continuous, Some(hz)) => continuous(hz).map_err(|why| format!("HZ = {hz}: {why}")),
            (When::Continuous, None) => Err("continuous needs a rate, such as `continuous 62.5`".to_owned()),
            (When::Off | When::Event, Some(hz)) => {
                Err(format!("HZ = {hz}: only continuous has a rate; leave it out"))
            }
        }
    }
}
