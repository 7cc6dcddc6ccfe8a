//! The commands. Each is a thin layer over the library; errors are one line, exit codes are 0 (done),
//! 1 (the run failed) and 2 (wrong use or configuration).

mod ack;
mod dump;
mod frame;
mod output;
mod print;
mod run;
mod skin;

use std::process::ExitCode;

use clap::error::ErrorKind;
use clap::{Parser, Subcommand};

/// Bridges a robot skin's bus to a control loop.
#[derive(Debug, Parser)]
#[command(version, after_help = "Example:\n  gateway demo")]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(run::Demo),
    Run(run::Run),
    Dump(dump::Dump),
    Frame(frame::Frame),
    Ack(ack::Ack),
    Skin(skin::Skin),
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

    /// Something failed.
    pub(crate) fn run(text: impl core::fmt::Display) -> Self {
        Self { text: text.to_string(), code: 1 }
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
            eprintln!("gateway: {}", protocol::usage::one_line(&wrong.render().to_string()));
            return ExitCode::from(2);
        }
    };
    let done = match arguments.command {
        Command::Demo(command) => command.run(),
        Command::Run(command) => command.run(),
        Command::Dump(command) => command.run(),
        Command::Frame(command) => command.run(),
        Command::Ack(command) => command.run(),
        Command::Skin(command) => command.run(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { text, code }) => {
            eprintln!("gateway: {text}");
            ExitCode::from(code)
        }
    }
}
