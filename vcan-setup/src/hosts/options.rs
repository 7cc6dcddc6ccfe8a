//! The command line of `vcan-setup link`, which runs the program `vcan-link`. Both programs parse it.

use std::path::PathBuf;

use clap::Args;
use protocol::bus::{BusError, BusKind, KindChoice, check_name};

/// Link a bus of this host to the buses of the same name on other hosts, until SIGINT or SIGTERM
///
/// Carries every frame over Zenoh (TCP or TLS), or counts where and why it was lost. The bus never waits for a link:
/// frames that it cannot carry are dropped, and counted. Hosts are not discovered: give the addresses of other hosts
/// with --connect, the address of this host with --listen, or both in a configuration file of Zenoh. A lost connection
/// is established again.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vcan-setup link vcan0 --listen tcp/192.168.1.7:7447      on the host of the robot
  vcan-setup link vcan0 --connect tcp/192.168.1.7:7447     on the host of the cells
  vcan-setup link vcan0 --config tls.json5

The command runs the program vcan-link, beside vcan-setup or on PATH. To install it, run in the project's folder:
  cargo install --locked --path vcan-setup/link")]
pub struct LinkOptions {
    /// Name of the bus
    #[arg(value_parser = parse_bus_name)]
    pub bus: String,
    /// Configuration file of Zenoh, with certificates, access control and endpoints
    #[arg(long, value_name = "FILE.json5")]
    pub config: Option<PathBuf>,
    /// Connect to the link on another host: tcp/HOST:PORT or tls/HOST:PORT; repeat the option for further hosts
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Accept connections from other hosts at this address of this host: tcp/HOST:PORT or tls/HOST:PORT
    #[arg(long, value_name = "ENDPOINT")]
    pub listen: Vec<String>,
    /// Name under which other hosts see this host [default: the name of the machine]
    #[arg(long, value_name = "NAME")]
    pub host: Option<String>,
    /// The requested kind of the bus.
    #[arg(long, value_name = "KIND", default_value_t = KindChoice::Auto, help = BusKind::help())]
    pub bus_kind: KindChoice,
    /// At the end, print the counts of all frames as JSON
    #[arg(long)]
    pub json: bool,
}

/// Parses the name of a bus.
fn parse_bus_name(word: &str) -> Result<String, BusError> {
    check_name(word).map(|()| word.to_owned())
}
