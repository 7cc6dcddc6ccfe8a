//! `gateway ack`.

use std::path::PathBuf;

use clap::Args;
use model::generate::Format;
use protocol::bus::{Bus, BusError, Choice, Kinds, OneKind, Options};
use protocol::can;
use protocol::message::Message;
use protocol::skin::Skin;
use protocol::usage::Failure;

use super::output;

/// Leave the halted state: send resume to a bus, or to all buses of a skin
///
/// Cells that were halted answer again from the next joints on. An argument that is the name of a file is a
/// skin, whose buses have their formats from it; else it is a bus.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  gateway ack vcan0\n  gateway ack gateway/examples/ur5-253.toml")]
pub(crate) struct Ack {
    /// A bus, or a skin's description
    #[arg(value_name = "BUS|SKIN")]
    whom: PathBuf,
    /// What a packet travels in on the bus; a skin says it itself
    #[arg(long, value_enum, default_value = "fd")]
    format: Format,
    /// socketcan or embedded; else SocketCAN where the kernel has CAN, the embedded bus where not; for one bus of a
    /// skin BUS=KIND, as often as there are buses
    #[arg(long, value_name = "[BUS=]KIND")]
    bus_kind: Vec<OneKind>,
}

impl Ack {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let name = self.whom.display();
        let is_skin = self.whom.is_file();
        let wanted: Vec<_> = if is_skin {
            let skin = Skin::read(&self.whom).map_err(Failure::usage)?;
            skin.buses.into_iter().map(|bus| (bus.name, bus.format)).collect()
        } else {
            vec![(name.to_string(), wire(self.format))]
        };
        let kinds = Kinds::of_words(&self.bus_kind, Choice::Auto)
            .and_then(|kinds| kinds.only(wanted.iter().map(|(bus, _): &(String, _)| bus.as_str())))
            .map_err(Failure::usage)?;
        // All are opened before anybody is told.
        let mut buses = Vec::new();
        for (bus, format) in &wanted {
            buses.push(open(bus, kinds.of(bus), *format).map_err(|error| match is_skin {
                true => Failure::usage(error),
                false => Failure::usage(format!("there is no file {name}, and as a bus: {error}")),
            })?);
        }
        for (bus, (_, format)) in buses.iter().zip(&wanted) {
            send(bus, &Message::Resume, *format)?;
        }
        Ok(())
    }
}

/// The format as the wire knows it.
pub(crate) const fn wire(format: Format) -> can::Format {
    match format {
        Format::Fd => can::Format::Fd,
        Format::Classic => can::Format::Classic,
    }
}

/// Opens a bus to send on it.
pub(crate) fn open(name: &str, kind: Choice, format: can::Format) -> Result<Bus, BusError> {
    let options = Options { filters: Vec::new(), fd: format == can::Format::Fd, ..Options::default() };
    Bus::open(name, kind, &options)
}

/// Sends one packet, and says on which kind of bus.
pub(crate) fn send(bus: &Bus, message: &Message, format: can::Format) -> Result<(), Failure> {
    let frames: Vec<_> = message.encode().frames(format).collect();
    bus.send(&frames).map_err(|error| Failure::run(error.cause))?;
    output::note(format_args!("sent on {} ({})", bus.name(), bus.kind()));
    Ok(())
}
