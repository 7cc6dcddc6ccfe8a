//! `skinbus frame sensing`.

use bench::sensing::switch;
use clap::Args;
use model::decode::parameter::Words;
use protocol::bus::Bus;
use protocol::can::Format;
use protocol::message::{Message, Request};
use protocol::parameters::{Parameter, Sensing};
use protocol::skin::sensing::continuous;
use protocol::usage::{Failure, print};

use super::addressee::{addressee, only_cell};
use crate::arguments::{Word, one_of};
use model::decode::pick::Party;

/// Set when cells send their sensors: never, at a rate, or on changes
///
/// With --bus or --skin, takes effect at once, waits until all cells have confirmed it, and lists those that have not.
/// A gateway that runs on the bus overrides it: it switches a restarted cell to its last mode. Parameter 8, [events] in
/// a skin, sets which changes count: `skinbus frame configure --write events`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus frame sensing event --bus vcan0
  skinbus frame sensing continuous 62.5 --cell 12 --bus vcan0
  skinbus frame sensing off --skin skin.toml")]
pub(super) struct Switch {
    /// When cells send their sensors
    #[arg(value_parser = one_of(MODES))]
    mode: When,
    /// Rate in continuous mode: frames per second of each cell
    #[arg(value_name = "HZ", allow_negative_numbers = true)]
    hz: Option<f64>,
    /// The cell, or everyone
    #[arg(long, value_name = "[BUS:]NODE", value_parser = addressee, default_value = "everyone")]
    pub(super) cell: Party,
}

/// Mode of the sensor frames.
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

impl Switch {
    pub(super) fn message(&self) -> Result<Message, String> {
        let request = Request::Write { number: Parameter::Sensing.number(), words: self.sensing()?.words() };
        Ok(Message::Configure { to: self.cell.node, tag: 0, request })
    }

    /// Switches the cells on a bus, and waits until all have confirmed.
    pub(super) fn send(&self, bus: Bus, format: Format) -> Result<(), Failure> {
        let mode = self.sensing().map_err(Failure::usage)?;
        let on = format!("{} ({})", bus.name(), bus.kind());
        let confirmed = switch(bus, format, only_cell(&self.cell), mode).map_err(Failure::run)?;
        print(&format!("{confirmed} on {on}: {}\n", Words(Parameter::Sensing.number(), mode.words())))
    }

    fn sensing(&self) -> Result<Sensing, String> {
        match (self.mode, self.hz) {
            (When::Off, None) => Ok(Sensing::Off),
            (When::Event, None) => Ok(Sensing::Event),
            (When::Continuous, Some(hz)) => continuous(hz).map_err(|why| format!("HZ = {hz}: {why}")),
            (When::Continuous, None) => Err("continuous needs a rate, such as `continuous 62.5`".to_owned()),
            (When::Off | When::Event, Some(hz)) => {
                Err(format!("HZ = {hz}: only continuous has a rate; leave it out"))
            }
        }
    }
}
