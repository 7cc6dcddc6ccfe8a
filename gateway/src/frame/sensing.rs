//! `skinbus frame sensing`.

use bench::sensing::switch_sensing;
use clap::Args;
use model::decode::parameter::ParameterWords;
use protocol::bus::Bus;
use protocol::can::Format;
use protocol::message::{Message, Request};
use protocol::parameters::{Parameter, Sensing};
use protocol::skin::sensing::continuous_sensing;
use protocol::usage::{Failure, print_text};

use super::addressee::{addressee, single_cell};
use crate::arguments::{OptionValue, one_of_values};
use model::decode::pick::NodeSelector;

/// Make cells send their sensor values never, at a rate, or on changes
///
/// With --bus or --skin, takes effect at once, waits until all cells have confirmed it, and lists those that have not.
/// A gateway that runs on the bus overrides it, because it switches a restarted cell back to the cell's last mode.
/// Parameter 8, [events] in a skin, sets which changes count: `skinbus frame configure --write events`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus frame sensing event --bus vcan0
  skinbus frame sensing continuous 62.5 --cell 12 --bus vcan0
  skinbus frame sensing off --skin skin.toml")]
pub(super) struct SensingCommand {
    /// When cells send their sensor values
    #[arg(value_parser = one_of_values(MODES))]
    mode: SensingMode,
    /// Rate in continuous mode: sensor frames per second of each cell
    #[arg(value_name = "HZ", allow_negative_numbers = true)]
    hz: Option<f64>,
    /// Cell that receives the packet; `everyone` for all cells
    #[arg(long, value_name = "[BUS:]NODE", value_parser = addressee, default_value = "everyone")]
    pub(super) cell: NodeSelector,
}

/// Mode of the sensor frames.
#[derive(Clone, Copy, Debug)]
enum SensingMode {
    Off,
    Continuous,
    Event,
}

const MODES: &[OptionValue<SensingMode>] = &[
    ("off", "Send sensor values only when a report command asks for them", SensingMode::Off),
    ("continuous", "Send sensor values at a fixed rate", SensingMode::Continuous),
    ("event", "Send sensor values when they change, and with each heartbeat", SensingMode::Event),
];

impl SensingCommand {
    pub(super) fn message(&self) -> Result<Message, String> {
        let request = Request::Write { number: Parameter::Sensing.number(), words: self.sensing()?.words() };
        Ok(Message::Configure { to: self.cell.node, tag: 0, request })
    }

    /// Switches the cells on a bus, and waits until all have confirmed.
    pub(super) fn send(&self, bus: Bus, format: Format) -> Result<(), Failure> {
        let mode = self.sensing().map_err(Failure::usage_error)?;
        let on = format!("{} ({})", bus.name(), bus.kind());
        let confirmed =
            switch_sensing(bus, format, single_cell(&self.cell), mode).map_err(Failure::run_error)?;
        print_text(&format!(
            "{confirmed} on {on}: {}\n",
            ParameterWords(Parameter::Sensing.number(), mode.words())
        ))
    }

    fn sensing(&self) -> Result<Sensing, String> {
        match (self.mode, self.hz) {
            (SensingMode::Off, None) => Ok(Sensing::Off),
            (SensingMode::Event, None) => Ok(Sensing::Event),
            (SensingMode::Continuous, Some(hz)) => {
                continuous_sensing(hz).map_err(|why| format!("HZ = {hz}: {why}"))
            }
            (SensingMode::Continuous, None) => {
                Err("continuous needs a rate, such as `continuous 62.5`".to_owned())
            }
            (SensingMode::Off | SensingMode::Event, Some(hz)) => {
                Err(format!("HZ = {hz}: only the mode continuous has a rate: leave it out"))
            }
        }
    }
}
