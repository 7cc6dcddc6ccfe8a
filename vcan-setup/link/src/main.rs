//! The program `vcan-link`, which joins a bus with those of the same name on other hosts. `vcan-setup link` runs it.

mod event;
mod link;
mod log;
mod session;
mod watchers;

use std::io;
use std::os::unix::net::UnixStream;
use std::process::ExitCode;

use clap::Parser;
use clap::error::ErrorKind;
use protocol::usage::{Failure, exit_code, flush_printed, one_line_error, print_text};
use signal_hook::consts::{SIGINT, SIGTERM};
use vcan_setup::hosts::options::LinkOptions;
use vcan_setup::hosts::program;
use vcan_setup::hosts::report::{HostReport, LinkReport};

use link::HostLink;
use session::LinkSettings;

#[derive(Debug, Parser)]
#[command(name = "vcan-link", bin_name = "vcan-setup link", version)]
struct Arguments {
    #[command(flatten)]
    options: LinkOptions,
}

fn main() -> ExitCode {
    let done =
        program::check_caller().map_err(Failure::run_error).and_then(|()| match Arguments::try_parse() {
            Ok(arguments) => run(arguments.options),
            // The user requested help or the version; clap prints them.
            Err(queried) if !queried.use_stderr() => flush_printed(queried.print()),
            Err(wrong) if wrong.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => wrong.exit(),
            Err(wrong) => Err(Failure::usage_error(one_line_error(&wrong.render().to_string()))),
        });
    exit_code("vcan-setup", done)
}

fn run(options: LinkOptions) -> Result<(), Failure> {
    let (stop, stopped) = UnixStream::pair().map_err(no_signals)?;
    for signal in [SIGINT, SIGTERM] {
        let stop = stop.try_clone().map_err(no_signals)?;
        signal_hook::low_level::pipe::register(signal, stop).map_err(no_signals)?;
    }
    let machine = || rustix::system::uname().nodename().to_string_lossy().into_owned();
    let host = options.host.unwrap_or_else(machine);
    let settings = LinkSettings {
        bus: options.bus.clone(),
        choice: options.bus_kind,
        directory: None,
        host: host.clone(),
        config: options.config,
        connect: options.connect,
        listen: options.listen,
    };
    let link = HostLink::open(settings).map_err(|error| {
        if error.is_usage() { Failure::usage_error(error) } else { Failure::run_error(error) }
    })?;
    let ready = format!("{} ({}) is linked under the name '{host}'", options.bus, link.kind());
    if options.json {
        print_to_stderr(&ready)
    } else {
        print_text(&format!("{ready}\n"))?
    }
    let report = link
        .run(stopped, |event| print_to_stderr(&format!("{}: {event}", options.bus)))
        .map_err(Failure::run_error)?;
    print_text(&if options.json { json(&report)? } else { text(&report) })
}

fn json(report: &LinkReport) -> Result<String, Failure> {
    serde_json::to_string_pretty(report).map(|text| text + "\n").map_err(Failure::run_error)
}

fn text(report: &LinkReport) -> String {
    let LinkReport { sent, hosts, returned, .. } = report;
    let mut text = format!(
        "from this host: {} frames read, {} sent in {} messages, {} dropped by the link, {} lost before the \
         link read them\n",
        sent.taken, sent.sent, sent.messages, sent.dropped, sent.missed
    );
    for (host, HostReport { heard, .. }) in hosts {
        text += &format!(
            "from '{host}': {} frames received, {} sent to the bus; lost: {} on the network, {} on that \
             host, {} on this host; {} sent before this link started\n",
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
            "{returned} frames from other hosts came back over the bus of this host, and the link dropped \
             them\n"
        );
    }
    text
}

fn no_signals(error: io::Error) -> Failure {
    Failure::run_error(format!("cannot catch signals: {error}"))
}

fn print_to_stderr(text: &str) {
    protocol::usage::eprint_line(&format!("vcan-setup: {text}"));
}
