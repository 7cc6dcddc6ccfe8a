//! `vcan-setup`: gives you a bus.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::process::ExitCode;

use anyhow::Context;
use clap::{Parser, Subcommand};
use protocol::bus::{BusError, check_name};
use rustix::process::Signal;
use signal_hook::consts::{SIGINT, SIGTERM};
use vcan_setup::embedded::Server;

/// Gives you a bus.
#[derive(Debug, Parser)]
#[command(version, after_help = "Example:\n  vcan-setup serve vcan0")]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Serve an embedded bus, for machines whose kernel has no SocketCAN, until SIGINT or SIGTERM
    ///
    /// Prints one line, "serving NAME at PATH", when clients can connect. The bus is private to the user; its
    /// socket lies in $SKINBUS_DIR, else $XDG_RUNTIME_DIR/skinbus, else /tmp/skinbus-UID.
    #[command(
        after_help = "Examples:\n  vcan-setup serve vcan0\n  sleep 10 | vcan-setup serve vcan0 --until-eof"
    )]
    Serve {
        /// The bus's name, as an interface's: at most 15 bytes
        #[arg(value_parser = bus_name)]
        name: String,
        /// Also stop when standard input ends or the parent process dies
        #[arg(long)]
        until_eof: bool,
    },
}

fn main() -> ExitCode {
    let Arguments { command } = Arguments::parse();
    let done = match command {
        Command::Serve { name, until_eof } => serve(&name, until_eof),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("vcan-setup: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn bus_name(word: &str) -> Result<String, BusError> {
    check_name(word).map(|()| word.to_owned())
}

fn serve(name: &str, until_eof: bool) -> anyhow::Result<()> {
    let (stop, stopped) = UnixStream::pair().context("cannot make a handle to stop")?;
    for signal in [SIGINT, SIGTERM] {
        let stop = stop.try_clone().context("cannot make a handle to stop")?;
        signal_hook::low_level::pipe::register(signal, stop).context("cannot catch signals")?;
    }
    if until_eof {
        // The system counts the thread that started this process as its parent.
        rustix::process::set_parent_process_death_signal(Some(Signal::TERM))
            .context("cannot follow the parent process")?;
        std::thread::spawn(move || {
            let _ = std::io::copy(&mut std::io::stdin().lock().by_ref(), &mut std::io::sink());
            let _ = (&stop).write_all(b"end");
        });
    }
    let server = Server::bind(name)?;
    writeln!(std::io::stdout(), "serving {name} at {}", server.path().display())
        .and_then(|()| std::io::stdout().flush())
        .context("cannot write to standard output")?;
    server.run(stopped)?;
    Ok(())
}
