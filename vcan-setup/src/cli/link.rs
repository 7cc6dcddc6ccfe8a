//! `vcan-setup link`.

use std::os::unix::net::UnixStream;
use std::path::PathBuf;

use clap::Args;
use protocol::bus::Choice;
use protocol::usage::{Failure, print};
use signal_hook::consts::{SIGINT, SIGTERM};
use vcan_setup::hosts::link::{Link as Linked, Settings};
use vcan_setup::hosts::report::{Host, Report};

use super::{bus_name, json};

/// Join a bus here with those of the same name on other hosts, until SIGINT or SIGTERM
///
/// Carries every frame over Zenoh (TCP or TLS), or counts it as lost with where and why. Nothing waits for a link: what
/// it cannot carry is dropped, and counted. Nobody is looked for in the network: say where the others are with --connect,
/// where they find this host with --listen, or both in a file of Zenoh's. A connection that was lost is made again.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vcan-setup link vcan0 --listen tcp/192.168.1.7:7447      on the host of the robot
  vcan-setup link vcan0 --connect tcp/192.168.1.7:7447     on the host of the cells
  vcan-setup link vcan0 --config tls.json5")]
pub(crate) struct Link {
    /// The bus
    #[arg(value_parser = bus_name)]
    bus: String,
    /// A configuration of Zenoh: certificates, access control, endpoints
    #[arg(long, value_name = "FILE.json5")]
    config: Option<PathBuf>,
    /// Connect to this host, as often as there are hosts: tcp/HOST:PORT or tls/HOST:PORT
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Wait for other hosts here
    #[arg(long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// This host's name among the others; else the machine's
    #[arg(long, value_name = "NAME")]
    host: Option<String>,
    /// socketcan or embedded; else SocketCAN if there is an interface of this name, else the embedded bus
    #[arg(long, value_name = "KIND", default_value_t = Choice::Auto)]
    bus_kind: Choice,
    /// Print what has become of the frames as JSON
    #[arg(long)]
    json: bool,
}

impl Link {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let (stop, stopped) = UnixStream::pair().map_err(no_signals)?;
        for signal in [SIGINT, SIGTERM] {
            let stop = stop.try_clone().map_err(no_signals)?;
            signal_hook::low_level::pipe::register(signal, stop).map_err(no_signals)?;
        }
        let machine = || rustix::system::uname().nodename().to_string_lossy().into_owned();
        let host = self.host.unwrap_or_else(machine);
        let settings = Settings {
            bus: self.bus.clone(),
            choice: self.bus_kind,
            directory: None,
            host: host.clone(),
            config: self.config,
            connect: self.connect,
            listen: self.listen,
        };
        let link = Linked::open(settings)
            .map_err(|error| if error.is_usage() { Failure::usage(error) } else { Failure::run(error) })?;
        let ready = format!("{} ({}) is linked as '{host}'", self.bus, link.kind());
        if self.json {
            say(&ready)
        } else {
            print(&format!("{ready}\n"))?
        }
        let report =
            link.run(stopped, |event| say(&format!("{}: {event}", self.bus))).map_err(Failure::run)?;
        print(&if self.json { json(&report)? } else { text(&report) })
    }
}

fn text(report: &Report) -> String {
    let Report { sent, hosts, returned, .. } = report;
    let mut text = format!(
        "from here: {} frames taken, {} sent in {} messages, {} dropped, {} missed\n",
        sent.taken, sent.sent, sent.messages, sent.dropped, sent.missed
    );
    for (host, Host { heard, .. }) in hosts {
        text += &format!(
            "from '{host}': {} frames taken, {} sent to the bus; lost {} on the way, {} there, {} here; {} from before\n",
            heard.taken,
            heard.sent,
            heard.lost,
            heard.dropped_there + heard.missed_there,
            heard.dropped_here + heard.refused,
            heard.before,
        );
    }
    if *returned > 0 {
        text += &format!(
            "{returned} frames of other hosts came back from the bus here, and were not sent again\n"
        );
    }
    text
}

fn no_signals(error: std::io::Error) -> Failure {
    Failure::run(format!("cannot catch signals: {error}"))
}

fn say(text: &str) {
    protocol::usage::say(&format!("vcan-setup: {text}"));
}
