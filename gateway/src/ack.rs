//! `skinbus ack`.

use std::path::PathBuf;

use bench::listen;
use clap::Args;
use protocol::bus::{Bus, BusError, Choice, Options};
use protocol::can::Format;
use protocol::message::Message;
use protocol::skin::Skin;
use protocol::usage::Failure;

use super::arguments::{BusKinds, FORMATS, one_of};
use super::input::neither;
use super::output;

/// Leave the halted state: send resume to a bus, or to all buses of a skin
///
/// Cells that were halted answer again from the next joints on. An argument that is the name of a file is a
/// skin, whose buses have their formats from it; else it is a bus.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  skinbus ack vcan0\n  skinbus ack gateway/examples/ur5-253.toml")]
pub(crate) struct Ack {
    /// A bus, or a skin's description
    #[arg(value_name = "BUS|SKIN")]
    whom: PathBuf,
    /// The frame format of packets on the bus; for a skin its own
    #[arg(long, value_parser = one_of(FORMATS), default_value = "fd")]
    format: Format,
    #[command(flatten)]
    kinds: BusKinds,
}

impl Ack {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let name = self.whom.display().to_string();
        let is_skin = self.whom.is_file();
        let target: Vec<_> = if is_skin {
            let skin = Skin::read(&self.whom).map_err(Failure::usage)?;
            skin.buses.into_iter().map(|bus| (bus.name, bus.format)).collect()
        } else {
            vec![(name.clone(), self.format)]
        };
        let kinds = self.kinds.of(target.iter().map(|(bus, _)| bus.as_str()))?;
        // All are opened before anything is sent.
        let mut buses = Vec::new();
        for (bus, format) in &target {
            buses.push(open(bus, kinds.of(bus), *format).map_err(|error| match is_skin {
                true => Failure::usage(error),
                false => neither(&name, &error),
            })?);
        }
        buses.iter().zip(&target).try_for_each(|(bus, (_, format))| send(bus, &Message::Resume, *format))
    }
}

/// Opens a bus to send on it.
pub(crate) fn open(name: &str, kind: Choice, format: Format) -> Result<Bus, BusError> {
    listen::open(name, kind, Some(format), Options { filters: Vec::new(), ..Options::default() })
}

/// Sends one packet, and prints on which kind of bus.
pub(crate) fn send(bus: &Bus, message: &Message, format: Format) -> Result<(), Failure> {
    listen::send(bus, message, format).map_err(Failure::run)?;
    output::note(format_args!("sent on {} ({})", bus.name(), bus.kind()));
    Ok(())
}
