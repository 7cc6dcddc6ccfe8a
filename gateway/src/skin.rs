//! `skinbus skin`: generate, import, show, urdf and dbc.

mod covering;
mod dbc;
mod import;
mod show;
mod urdf;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use model::generate::{ReplyMode as Answers, SkinRequest, generate};
use protocol::can::Format;
use protocol::usage::{Failure, print_text};

use super::arguments::{FORMATS, OptionValue, one_of_values};
use super::output::OverwriteOption;
pub(crate) use show::still_page;

const REPLIES: &[OptionValue<Answers>] = &[
    ("torque", "Each cell sends its own torques to the gateway", Answers::Torque),
    ("sum", "Cells add torques along a tree of wires; only its roots send sums to the gateway", Answers::Sum),
];

/// Create and draw skins, and convert them to URDF and DBC
#[derive(Args, Debug)]
pub(crate) struct SkinCommand {
    #[command(subcommand)]
    command: SkinSubcommand,
}

#[derive(Debug, Subcommand)]
enum SkinSubcommand {
    Generate(GenerateCommand),
    Import(import::ImportCommand),
    Dbc(dbc::DbcCommand),
    Show(show::ShowCommand),
    Urdf(urdf::UrdfCommand),
}

/// Write a skin file: hexagonal cells on the arm of a UR5
///
/// The text depends only on the options. Its first line is the command that generates it.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus skin generate -o skin.toml
  skinbus skin generate --cells 508 --buses 2 --format classic > skin.toml")]
struct GenerateCommand {
    /// Number of cells, 1 to 254 per bus
    #[arg(long, default_value_t = 253)]
    cells: usize,
    /// Number of buses; the cells of a bus lie side by side on the arm
    #[arg(long, default_value_t = 1)]
    buses: usize,
    /// Rate of joint broadcasts in Hz; must divide the 500 Hz of the control loop
    #[arg(long, default_value_t = 62.5)]
    broadcast_hz: f64,
    /// Reply of the cells to joint broadcasts
    #[arg(long, value_parser = one_of_values(REPLIES), default_value = "torque")]
    reply: Answers,
    /// Frame format of the cells' packets
    #[arg(long, value_parser = one_of_values(FORMATS), default_value = "fd")]
    format: Format,
    /// Output file; after an error, no incomplete file is left [default: standard output]
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl SkinCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        match self.command {
            SkinSubcommand::Generate(command) => command.run(),
            SkinSubcommand::Import(command) => command.run(),
            SkinSubcommand::Dbc(command) => command.run(),
            SkinSubcommand::Show(command) => command.run(),
            SkinSubcommand::Urdf(command) => command.run(),
        }
    }
}

impl GenerateCommand {
    fn run(self) -> Result<(), Failure> {
        let Self { cells, buses, broadcast_hz, reply, format, output, overwrite } = self;
        let target = SkinRequest { cells, buses, broadcast_hz, reply, format, ..SkinRequest::default() };
        let text = generate(&target).map_err(Failure::usage_error)?;
        match output {
            Some(path) => overwrite.write("-o", &path, &text),
            None => print_text(&text),
        }
    }
}
