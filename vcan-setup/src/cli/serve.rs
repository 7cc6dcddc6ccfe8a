//! The command `vcan-setup serve`.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;

use anyhow::Context;
use clap::Args;
use protocol::usage::Failure;
use rustix::process::{Resource, Rlimit, Signal, getrlimit, setrlimit};
use signal_hook::consts::{SIGINT, SIGTERM};
use vcan_setup::embedded::{BusTotals, Server};

use super::parse_bus_name;

/// The niceness of the server: the highest priority.
const HIGHEST_PRIORITY: i32 = -20;

/// Serve an embedded bus, for machines whose kernel has no SocketCAN, until SIGINT or SIGTERM
///
/// Prints one line, "serving NAME at PATH", when clients can connect. The bus is private to the user; its
/// socket is in $SKINBUS_DIR, else $XDG_RUNTIME_DIR/skinbus, else /tmp/skinbus-UID.
#[derive(Args, Debug)]
#[command(
    after_help = "Examples:\n  vcan-setup serve vcan0\n  sleep 10 | vcan-setup serve vcan0 --until-eof"
)]
pub(crate) struct ServeBusOptions {
    /// Name of the bus, like that of an interface: at most 15 bytes
    #[arg(value_parser = parse_bus_name)]
    name: String,
    /// Also stop when standard input ends or the parent process dies
    #[arg(long)]
    until_eof: bool,
}

impl ServeBusOptions {
    pub(crate) fn run(self) -> Result<(), Failure> {
        serve(&self.name, self.until_eof).map_err(|error| Failure::run_error(format_with_causes(&error)))
    }
}

/// Formats an error with its causes. A cause whose text is already contained in the error is left out.
fn format_with_causes(error: &anyhow::Error) -> String {
    error.chain().skip(1).fold(error.to_string(), |text, cause| match cause.to_string() {
        cause if text.contains(&cause) => text,
        cause => format!("{text}: {cause}"),
    })
}

fn serve(name: &str, until_eof: bool) -> anyhow::Result<()> {
    let (stop, stopped) =
        UnixStream::pair().context("cannot create the socket pair that stops the server")?;
    for signal in [SIGINT, SIGTERM] {
        let stop = stop.try_clone().context("cannot create the socket pair that stops the server")?;
        signal_hook::low_level::pipe::register(signal, stop).context("cannot catch signals")?;
    }
    if until_eof {
        // The signal is sent when the thread ends that started this process, because the system regards it as the
        // parent.
        rustix::process::set_parent_process_death_signal(Some(Signal::TERM))
            .context("cannot watch the parent process")?;
        let follow = move || {
            let _ = std::io::copy(&mut std::io::stdin().lock().by_ref(), &mut std::io::sink());
            let _ = (&stop).write_all(b"end");
        };
        std::thread::Builder::new()
            .spawn(follow)
            .context("cannot start a thread that reads standard input")?;
    }
    // The kernel delivers frames at once, but a server process may wait behind hundreds of cells for processor time. If
    // this process may not raise its priority, the bus is only slower.
    let _ = rustix::process::setpriority_process(None, HIGHEST_PRIORITY);
    protocol::bus::set_batch_scheduling();
    raise_file_limit();
    let server = Server::bind(name)?;
    writeln!(std::io::stdout(), "serving {name} at {}", server.path().display())
        .and_then(|()| std::io::stdout().flush())
        .context("cannot write to standard output")?;
    let BusTotals { garbage, refused, turned_away, failed, failure, .. } = server.run(stopped)?;
    // Only the server can report these frames, because a client gets no error for an invalid datagram.
    if garbage > 0 || refused > 0 {
        print_to_stderr(&format!(
            "{name}: ignored {garbage} datagrams that were neither frames nor filters, and refused {refused} clients: \
             check the client programs against docs/reference/embedded-bus.md"
        ));
    }
    if turned_away > 0 {
        let limit =
            getrlimit(Resource::Nofile).current.map_or_else(String::new, |limit| format!(" of {limit}"));
        print_to_stderr(&format!(
            "{name}: rejected {turned_away} clients, because no file descriptor{limit} or memory was left: \
             end other clients, or raise `ulimit -Hn`"
        ));
    }
    if let Some(failure) = failure {
        print_to_stderr(&format!(
            "{name}: disconnected {failed} clients whose sockets failed; the last error was: {failure}"
        ));
    }
    Ok(())
}

/// Raises the limit of open files to the maximum that the system allows, because each client needs one.
fn raise_file_limit() {
    let Rlimit { maximum, .. } = getrlimit(Resource::Nofile);
    // With a lower limit the server accepts fewer clients.
    let _ = setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum });
}

/// Prints a line to standard error. Ignores a failure, because it could not be reported.
fn print_to_stderr(text: &str) {
    let _ = writeln!(std::io::stderr(), "vcan-setup: {text}");
}
