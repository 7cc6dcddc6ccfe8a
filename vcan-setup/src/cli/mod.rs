//! The commands of `vcan-setup`, which parse options and print results; the library does the work. An error is one
//! line. Exit codes are 0 (done), 1 (failed, or not possible on this machine) and 2 (wrong use or configuration).

mod doctor;
mod serve;
mod slcan;
mod status;
mod up;

use std::ffi::{OsStr, OsString};
use std::io;
use std::path::Path;
use std::process::ExitCode;

use clap::error::ErrorKind;
use clap::{Parser, Subcommand};
use protocol::bus::{BusError, check_name};
use protocol::skin::Skin;
use protocol::usage::{Failure, exit_code, flush_printed, one_line_error, shell_quoted_os};
use serde::Serialize;
use vcan_setup::hosts::options::LinkOptions;
use vcan_setup::hosts::program;
use vcan_setup::link::Interface;
use vcan_setup::netlink::Netlink;
use vcan_setup::plan::InterfaceTarget;

/// Set up CAN buses: make vcan interfaces, check what a bench still needs, serve embedded buses
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Examples:
  vcan-setup doctor skin.toml      what is missing, and the command that fixes it
  sudo vcan-setup up vcan0         a bus in the kernel
  vcan-setup status                the CAN interfaces of this machine
  sudo vcan-setup down vcan0
  vcan-setup serve vcan0           a bus where the kernel has no CAN
  vcan-setup slcan vcan0 /dev/ttyACM0 --cell 12    a cell behind a serial adapter
  vcan-setup link vcan0 --connect tcp/10.0.0.7:7447    the same bus on another host"
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Up(up::UpOptions),
    Down(up::DownOptions),
    Status(status::StatusOptions),
    Doctor(doctor::DoctorOptions),
    Serve(serve::ServeBusOptions),
    Slcan(slcan::SlcanOptions),
    Link(LinkOptions),
}

impl Command {
    fn run(self) -> Result<(), Failure> {
        match self {
            Self::Up(command) => command.run(),
            Self::Down(command) => command.run(),
            Self::Status(command) => command.run(),
            Self::Doctor(command) => command.run(),
            Self::Serve(command) => command.run(),
            Self::Slcan(command) => command.run(),
            // The first two arguments are the names of this program and of the command.
            Self::Link(_) => Err(Failure::run_error(program::exec_link_program(std::env::args_os().skip(2)))),
        }
    }
}

/// Parses the command line and runs the command.
pub(crate) fn main() -> ExitCode {
    let done = match Arguments::try_parse() {
        Ok(arguments) => arguments.command.run(),
        // The user requested help or the version; clap prints them.
        Err(queried) if !queried.use_stderr() => flush_printed(queried.print()),
        Err(wrong) if wrong.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => wrong.exit(),
        Err(wrong) => Err(Failure::usage_error(one_line_error(&wrong.render().to_string()))),
    };
    exit_code("vcan-setup", done)
}

/// Formats the output of `--json`.
fn to_json(report: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string_pretty(report).map(|text| text + "\n").map_err(Failure::run_error)
}

/// Parses the name of a bus.
fn parse_bus_name(word: &str) -> Result<String, BusError> {
    check_name(word).map(|()| word.to_owned())
}

/// A positional argument: the path of a skin, which ends in `.toml` or contains a `/`, or the name of a bus.
enum BusArgument {
    File(Box<Skin>),
    Name(String),
}

fn parse_argument(word: &OsStr) -> Result<BusArgument, Failure> {
    let bytes = word.as_encoded_bytes();
    if bytes.ends_with(b".toml") || bytes.contains(&b'/') {
        let skin = Skin::read(Path::new(word)).map_err(Failure::usage_error)?;
        return Ok(BusArgument::File(Box::new(skin)));
    }
    let name = word.to_str().ok_or_else(|| {
        Failure::usage_error(format!("{} is not a bus name: it is not UTF-8", shell_quoted_os(word)))
    })?;
    parse_bus_name(name).map(BusArgument::Name).map_err(Failure::usage_error)
}

/// Returns the buses that positional arguments name, directly or by a skin.
fn buses_from_arguments<T>(
    words: &[OsString],
    of_skin: impl Fn(&OsStr, &Skin) -> Vec<T>,
    named: impl Fn(&str) -> T,
) -> Result<Vec<T>, Failure> {
    let mut all = Vec::new();
    for given in words {
        match parse_argument(given)? {
            BusArgument::File(skin) => all.extend(of_skin(given, &skin)),
            BusArgument::Name(name) => all.push(named(&name)),
        }
    }
    Ok(all)
}

/// Returns the interfaces that positional arguments name, directly or by a skin.
fn targets_from_arguments(words: &[OsString]) -> Result<Vec<InterfaceTarget>, Failure> {
    buses_from_arguments(words, InterfaceTarget::from_skin, InterfaceTarget::named)
}

/// Returns the CAN interfaces of this machine, and the netlink socket that listed them.
fn query_interfaces() -> Result<(Netlink, Vec<Interface>), Failure> {
    let mut netlink = Netlink::open().map_err(query_error)?;
    let present = netlink.interfaces().map_err(query_error)?;
    Ok((netlink, present))
}

fn query_error(error: io::Error) -> Failure {
    Failure::run_error(format!("cannot read the kernel's list of network interfaces: {error}"))
}
