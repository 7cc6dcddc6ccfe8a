//! The commands. Each is a thin layer over the library; errors are one line, exit codes are 0 (done),
//! 1 (it failed, or this machine does not allow it) and 2 (wrong use or configuration).

mod doctor;
mod print;
mod serve;
mod status;
mod up;

use std::io;
use std::path::Path;
use std::process::ExitCode;

use clap::error::ErrorKind;
use clap::{Parser, Subcommand};
use protocol::bus::{BusError, check_name};
use protocol::skin::Skin;
use vcan_setup::link::Interface;
use vcan_setup::netlink::Netlink;
use vcan_setup::plan::{Refusal, Wanted};

/// Gives you a bus: makes vcan interfaces, says what a bench still needs, serves embedded buses
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Examples:
  vcan-setup doctor skin.toml      what is missing, and the command that mends it
  sudo vcan-setup up vcan0         a bus in the kernel
  vcan-setup status                the CAN interfaces of this machine
  sudo vcan-setup down vcan0
  vcan-setup serve vcan0           a bus where the kernel has no CAN"
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Up(up::Up),
    Down(up::Down),
    Status(status::Status),
    Doctor(doctor::Doctor),
    Serve(serve::Serve),
}

/// An error for people, and the exit code that goes with it.
#[derive(Debug)]
pub(crate) struct Failure {
    text: String,
    code: u8,
}

impl Failure {
    /// Wrong use or configuration.
    pub(crate) fn usage(text: impl core::fmt::Display) -> Self {
        Self { text: text.to_string(), code: 2 }
    }

    /// Something failed, or is not possible here.
    pub(crate) fn run(text: impl core::fmt::Display) -> Self {
        Self { text: text.to_string(), code: 1 }
    }

    /// Exit code 1 after all has been said.
    pub(crate) const fn said() -> Self {
        Self { text: String::new(), code: 1 }
    }
}

impl From<Refusal> for Failure {
    fn from(refusal: Refusal) -> Self {
        if refusal.is_usage() { Self::usage(refusal) } else { Self::run(refusal) }
    }
}

/// Reads the command line and does it.
pub(crate) fn main() -> ExitCode {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        // Help and version, which are asked for, are printed as they are.
        Err(asked) if !asked.use_stderr() => asked.exit(),
        Err(wrong) if wrong.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => wrong.exit(),
        Err(wrong) => {
            eprintln!("vcan-setup: {}", protocol::usage::one_line(&wrong.render().to_string()));
            return ExitCode::from(2);
        }
    };
    let done = match arguments.command {
        Command::Up(command) => command.run(),
        Command::Down(command) => command.run(),
        Command::Status(command) => command.run(),
        Command::Doctor(command) => command.run(),
        Command::Serve(command) => command.run(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { text, code }) => {
            if !text.is_empty() {
                eprintln!("vcan-setup: {text}");
            }
            ExitCode::from(code)
        }
    }
}

/// A bus' name, as the command line gives it.
fn bus_name(word: &str) -> Result<String, BusError> {
    check_name(word).map(|()| word.to_owned())
}

/// What a word on the command line names: a skin's file ends in `.toml` or holds a `/`.
enum Word {
    File(Box<Skin>),
    Name(String),
}

fn word(word: &str) -> Result<Word, Failure> {
    if word.ends_with(".toml") || word.contains('/') {
        let skin = Skin::read(Path::new(word)).map_err(Failure::usage)?;
        return Ok(Word::File(Box::new(skin)));
    }
    bus_name(word).map(Word::Name).map_err(Failure::usage)
}

/// The interfaces that words on the command line name.
fn wanted(words: &[String]) -> Result<Vec<Wanted>, Failure> {
    let mut all = Vec::new();
    for given in words {
        match word(given)? {
            Word::File(skin) => all.extend(Wanted::of_skin(given, &skin)),
            Word::Name(name) => all.push(Wanted::named(&name)),
        }
    }
    Ok(all)
}

/// The interfaces that there are, and who told.
fn ask() -> Result<(Netlink, Vec<Interface>), Failure> {
    let mut netlink = Netlink::open().map_err(unreadable)?;
    let present = netlink.interfaces().map_err(unreadable)?;
    Ok((netlink, present))
}

fn unreadable(error: io::Error) -> Failure {
    Failure::run(format!("cannot ask the kernel for its interfaces: {error}"))
}
