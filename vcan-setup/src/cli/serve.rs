//! The command `vcan-setup serve`.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;

use anyhow::Context;
use bus_model::{BitErrors, TransmitQueue};
use clap::Args;
use protocol::usage::Failure;
use protocol::wire_time::BitRates;
use rustix::process::{Resource, Rlimit, Signal, getrlimit, setrlimit};
use signal_hook::consts::{SIGINT, SIGTERM};
use vcan_setup::embedded::{BusRecord, BusTotals, Server, TimedBusOptions};

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
    /// Name of the bus, at most 15 bytes, as for a network interface
    #[arg(value_parser = parse_bus_name)]
    name: String,
    /// Also stop when standard input ends or the parent process dies
    #[arg(long)]
    until_eof: bool,
    /// Let frames take time, as on a real bus with these bit rates: 1M/5M, or 500k for classic CAN. Frames are
    /// arbitrated by identifier, and delivered at their ends; docs/reference/embedded-bus.md explains the model
    #[arg(long, value_name = "RATES")]
    rates: Option<BitRates>,
    /// Transmit queue of each program: fifo or priority (lowest identifier first), and its depth in frames
    #[arg(long, value_name = "ORDER:DEPTH", default_value = "priority:32", requires = "rates")]
    queue: TransmitQueue,
    /// Share of bits that arrive damaged, 0 to 0.01. Each causes an error frame and a retransmission
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, requires = "rates")]
    bit_errors: f64,
    /// Random seed for the damaged bits
    #[arg(long, value_name = "N", default_value_t = 1, requires = "bit_errors")]
    seed: u64,
    /// Let frames that only a bench sends take time, too: stimuli, sync and report with their answers, simulated wires
    #[arg(long, requires = "rates")]
    bench_traffic: bool,
    /// Write a line for each queued and each sent frame to this new file
    #[arg(long, value_name = "FILE", requires = "rates")]
    record: Option<PathBuf>,
}

impl ServeBusOptions {
    pub(crate) fn run(self) -> Result<(), Failure> {
        if let Err(error) = BitErrors::new(self.bit_errors, self.seed) {
            return Err(Failure::usage_error(format!("--bit-errors: {error}")));
        }
        serve(&self).map_err(|error| Failure::run_error(format_with_causes(&error)))
    }

    /// Returns the properties of the timed bus; `None` if frames take no time.
    fn timed_bus(&self) -> anyhow::Result<Option<TimedBusOptions>> {
        let Some(rates) = self.rates else { return Ok(None) };
        let create = |path: &PathBuf| {
            BusRecord::create(path).with_context(|| format!("cannot create {}", path.display()))
        };
        Ok(Some(TimedBusOptions {
            rates,
            queue: self.queue,
            bit_error_rate: self.bit_errors,
            seed: self.seed,
            counts_bench_traffic: self.bench_traffic,
            record: self.record.as_ref().map(create).transpose()?,
        }))
    }
}

/// Formats an error with its causes. A cause whose text is already contained in the error is left out.
fn format_with_causes(error: &anyhow::Error) -> String {
    error.chain().skip(1).fold(error.to_string(), |text, cause| match cause.to_string() {
        cause if text.contains(&cause) => text,
        cause => format!("{text}: {cause}"),
    })
}

fn serve(options: &ServeBusOptions) -> anyhow::Result<()> {
    let ServeBusOptions { name, until_eof, .. } = options;
    let timed = options.timed_bus()?;
    let (stop, stopped) =
        UnixStream::pair().context("cannot create the socket pair that stops the server")?;
    for signal in [SIGINT, SIGTERM] {
        let stop = stop.try_clone().context("cannot create the socket pair that stops the server")?;
        signal_hook::low_level::pipe::register(signal, stop).context("cannot catch signals")?;
    }
    if *until_eof {
        // The signal is sent when the thread ends that started this process, because the system regards it as the
        // parent.
        rustix::process::set_parent_process_death_signal(Some(Signal::TERM))
            .context("cannot watch the parent process")?;
        let follow = move || {
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            let _ = (&stop).write_all(b"end");
        };
        std::thread::Builder::new()
            .spawn(follow)
            .context("cannot start a thread that reads standard input")?;
    }
    // The kernel delivers frames at once, but a server process may wait behind hundreds of cells for processor time. If
    // this process may not raise its priority, the bus is only slower.
    let _ = rustix::process::setpriority_process(None, HIGHEST_PRIORITY);
    // A timed bus has to wake up at the ends of frames, though other processes run.
    if timed.is_none() {
        protocol::bus::set_batch_scheduling();
    }
    raise_file_limit();
    let mut server = Server::bind(name)?;
    if let Some(timed) = timed {
        server = server.with_time(timed)?;
    }
    writeln!(std::io::stdout(), "serving {name} at {}", server.path().display())
        .and_then(|()| std::io::stdout().flush())
        .context("cannot write to standard output")?;
    let totals = server.run(stopped)?;
    let BusTotals { garbage, refused, turned_away, failed, failure, .. } = totals;
    // Only the server can report these frames, because a client gets no error for an invalid datagram.
    if garbage > 0 || refused > 0 {
        print_to_stderr(&format!(
            "{name}: ignored {garbage} invalid datagrams and refused {refused} clients: check the client \
             programs against docs/reference/embedded-bus.md"
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
