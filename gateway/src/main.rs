//! `skinbus`: the bench's command line. A module a command, each a thin layer over the crates below; errors are one line, exit codes are 0 (done),
//! 1 (failed, or different), 2 (wrong use or configuration) and 3 (the robot was halted at the end).

#![allow(
    rustdoc::broken_intra_doc_links,
    reason = "help is written for a terminal: [events] is a table of a skin"
)]

mod ack;
mod arguments;
mod buses;
mod calibrate;
mod cells;
mod columns;
mod commission;
mod conformance;
mod convert;
mod dbc;
mod dump;
mod experiment;
mod explain;
mod fit;
mod frame;
mod input;
mod output;
mod print;
mod recover;
mod replay;
mod report;
mod robot_file;
mod run;
mod scenario;
mod sensing;
mod shadow;
mod skin;
mod surface;
mod torque;
mod view;
mod visuals;

use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, Parser, Subcommand};
use protocol::usage::{Failure, end, one_line};

/// Bridges a robot skin's bus to a control loop.
#[derive(Debug, Parser)]
#[command(
    name = "skinbus",
    version,
    after_help = "Embedded buses lie in $SKINBUS_DIR, else $XDG_RUNTIME_DIR/skinbus, else /tmp/skinbus-UID.\n\nExample:\n  skinbus demo"
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(run::Demo),
    Run(run::Run),
    Recover(recover::Recover),
    Dump(dump::Dump),
    Convert(convert::Convert),
    Replay(replay::Replay),
    Report(report::Report),
    Frame(frame::Frame),
    Commission(commission::Commission),
    Calibrate(calibrate::Calibrate),
    Conformance(conformance::Conformance),
    Cells(cells::Cells),
    Ack(ack::Ack),
    Sensing(sensing::Sensing),
    Skin(skin::Skin),
    Scenario(scenario::Scenario),
    Torque(torque::Torque),
    View(view::View),
    Dbc(dbc::Dbc),
    Explain(explain::Explain),
    Shadow(shadow::ShadowCommand),
    Fit(fit::Fit),
    Experiment(experiment::Experiment),
}

impl Command {
    fn run(self) -> Result<(), Failure> {
        match self {
            Self::Demo(command) => command.run(),
            Self::Run(command) => command.run(),
            Self::Recover(command) => command.run(),
            Self::Dump(command) => command.run(),
            Self::Convert(command) => command.run(),
            Self::Replay(command) => command.run(),
            Self::Report(command) => command.run(),
            Self::Frame(command) => command.run(),
            Self::Commission(command) => command.run(),
            Self::Calibrate(command) => command.run(),
            Self::Conformance(command) => command.run(),
            Self::Cells(command) => command.run(),
            Self::Ack(command) => command.run(),
            Self::Sensing(command) => command.run(),
            Self::Skin(command) => command.run(),
            Self::Scenario(command) => command.run(),
            Self::Torque(command) => command.run(),
            Self::View(command) => command.run(),
            Self::Dbc(command) => command.run(),
            Self::Explain(command) => command.run(),
            Self::Shadow(command) => command.run(),
            Self::Fit(command) => command.run(),
            Self::Experiment(command) => command.run(),
        }
    }
}

fn main() -> ExitCode {
    let done = match Arguments::try_parse() {
        Ok(arguments) => arguments.command.run(),
        // Requested help and version are printed as they are.
        Err(requested) if !requested.use_stderr() => requested.exit(),
        Err(wrong) if wrong.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => wrong.exit(),
        Err(wrong) => Err(Failure::usage(refusal(&wrong))),
    };
    end("skinbus", done)
}

/// What clap says, in one line; where its guess would mislead, what there is instead.
fn refusal(wrong: &clap::Error) -> String {
    let said = one_line(&wrong.render().to_string());
    let text = |kind| match wrong.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    let first = std::env::args_os().nth(1).unwrap_or_default();
    if let Some(name) = text(ContextKind::InvalidSubcommand).filter(|name| first == *name) {
        let arguments = Arguments::command();
        let names = print::list(arguments.get_subcommands().map(clap::Command::get_name));
        return format!("there is no command {name}; there are {names}");
    }
    match text(ContextKind::InvalidArg) {
        Some(file) if first == "run" && file.ends_with(".toml") => {
            format!("{file} comes after the skin: a scenario is given by --scenario {file}")
        }
        _ => said,
    }
}
