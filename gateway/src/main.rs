//! `skinbus`: the bench's command line. One module per command, each a thin layer over the library crates. Errors are
//! one line; exit codes are 0 (done), 1 (failed or different), 2 (wrong use or configuration) and 3 (the robot was
//! halted at the end).

#![allow(
    rustdoc::broken_intra_doc_links,
    reason = "help is written for a terminal: [events] is a table of a skin"
)]

mod arguments;
mod buses;
mod calibrate;
mod cells;
mod check;
mod columns;
mod commission;
mod compare;
mod completions;
mod conformance;
mod convert;
mod dump;
mod experiment;
mod explain;
mod fit;
mod former;
mod frame;
mod groups;
mod input;
mod junit;
mod output;
mod print;
mod recover;
mod replay;
mod report;
mod robot_file;
mod run;
mod skin;
mod surface;
mod view;
mod visuals;

use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use protocol::usage::{Failure, exit_code, flush_printed, one_line_error};

/// A test bench for robot skin on CAN: runs cells and a control loop, records and replays their frames
#[derive(Debug, Parser)]
#[command(name = "skinbus", version, disable_help_subcommand = true)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(run::DemoCommand),
    Run(run::RunCommand),
    View(view::ViewCommand),
    Dump(dump::DumpCommand),
    Explain(explain::ExplainCommand),
    Report(report::ReportCommand),
    Cells(cells::CellsCommand),
    Compare(compare::CompareCommand),
    Convert(convert::ConvertCommand),
    Replay(replay::ReplayCommand),
    Recover(recover::RecoverCommand),
    Fit(fit::FitCommand),
    Commission(commission::CommissionCommand),
    Calibrate(calibrate::CalibrateCommand),
    Conformance(conformance::ConformanceCommand),
    Frame(frame::FrameCommand),
    Skin(skin::SkinCommand),
    Check(check::CheckCommand),
    Experiment(experiment::ExperimentCommand),
    Completions(completions::CompletionsCommand),
    Man(completions::ManCommand),
}

impl Command {
    fn run(self) -> Result<(), Failure> {
        match self {
            Self::Demo(command) => command.run(),
            Self::Run(command) => command.run(),
            Self::View(command) => command.run(),
            Self::Dump(command) => command.run(),
            Self::Explain(command) => command.run(),
            Self::Report(command) => command.run(),
            Self::Cells(command) => command.run(),
            Self::Compare(command) => command.run(),
            Self::Convert(command) => command.run(),
            Self::Replay(command) => command.run(),
            Self::Recover(command) => command.run(),
            Self::Fit(command) => command.run(),
            Self::Commission(command) => command.run(),
            Self::Calibrate(command) => command.run(),
            Self::Conformance(command) => command.run(),
            Self::Frame(command) => command.run(),
            Self::Skin(command) => command.run(),
            Self::Check(command) => command.run(),
            Self::Experiment(command) => command.run(),
            Self::Completions(command) => command.run(program()),
            Self::Man(command) => command.run(program()),
        }
    }
}

/// The command line with its commands in groups.
fn program() -> clap::Command {
    groups::group_commands(Arguments::command())
}

fn main() -> ExitCode {
    let parsed = program().try_get_matches().and_then(|matches| Arguments::from_arg_matches(&matches));
    let done = match parsed {
        Ok(arguments) => arguments.command.run(),
        // Print requested help and version unchanged.
        Err(requested) if !requested.use_stderr() => flush_printed(requested.print()),
        Err(wrong) if wrong.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => wrong.exit(),
        Err(wrong) => Err(Failure::usage_error(usage_error(&wrong))),
    };
    exit_code("skinbus", done)
}

/// Formats clap's error in one line. Replaces clap's suggestion where it would mislead.
fn usage_error(wrong: &clap::Error) -> String {
    let text = |kind| match wrong.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    let words: Vec<_> = std::env::args_os().skip(1).map(|word| word.to_string_lossy().into_owned()).collect();
    let first = words.first().map(String::as_str).unwrap_or_default();
    if let Some(name) = text(ContextKind::InvalidSubcommand) {
        if let Some(now) = former::former_command_hint(&words, name) {
            return now;
        }
        if first == name {
            return groups::unknown_command(&program(), name);
        }
    }
    match text(ContextKind::InvalidArg) {
        Some(file) if first == "run" && file.ends_with(".toml") => {
            format!("unexpected argument {file} after the skin: to use a scenario, write --scenario {file}")
        }
        Some(option) => former::former_option_hint(&words, option)
            .unwrap_or_else(|| one_line_error(&wrong.render().to_string())),
        None => one_line_error(&wrong.render().to_string()),
    }
}
