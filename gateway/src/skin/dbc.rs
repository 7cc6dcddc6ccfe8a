//! `skinbus skin dbc`.

use std::path::PathBuf;

use analysis::dbc::dbc_text;
use clap::Args;
use protocol::can::Format;
use protocol::usage::{Failure, print_text};

use crate::arguments::bus_names;
use crate::input::read_skin_or_recording;
use crate::output::{OverwriteOption, check_distinct_files};
use crate::print::comma_separated;

/// Write a DBC file for a bus of a skin, for cantools, SavvyCAN and others
///
/// Each identifier of the bus becomes a message: the commands, and all packets from and to each cell of the skin. Each
/// field becomes a signal with its scale, unit and range; byte 13 multiplexes pages and parameters. Identifiers repeat
/// from bus to bus, so there is one file per bus. For a recording, it describes the recorded bus.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus skin dbc gateway/examples/ur5-253.toml -o skin.dbc
  skinbus skin dbc skin.toml --bus can1 > can1.dbc
  skinbus skin dbc run.mcap -o run.dbc
  candump -L vcan0 | python3 -m cantools decode -s skin.dbc")]
pub(super) struct DbcCommand {
    /// Skin file (TOML), or the recording of a run, which contains a skin
    #[arg(value_name = "SKIN|MCAP")]
    file: PathBuf,
    /// Name of the bus to describe, if the skin has several
    #[arg(long, value_name = "NAME")]
    bus: Option<String>,
    /// With a classic bus: describe whole packets, for a program that first joins the frames of each packet
    #[arg(long)]
    joined: bool,
    /// Output file; after an error, no incomplete file is left [default: standard output]
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl DbcCommand {
    pub(super) fn run(self) -> Result<(), Failure> {
        let file = self.file.display();
        check_distinct_files([("-o", self.output.as_deref())], [self.file.as_path()])?;
        let skin = read_skin_or_recording(&self.file)?;
        let names = || comma_separated(bus_names(&skin));
        let bus = match (&self.bus, skin.buses.as_slice()) {
            (Some(name), _) => skin.bus_index(name).ok_or_else(|| {
                Failure::usage_error(format!("{file} has no bus {name:?}; its buses are {}", names()))
            })?,
            (None, [_]) => 0,
            (None, buses) => {
                let many = buses.len();
                return Err(Failure::usage_error(format!(
                    "{file} has {many} buses, but a DBC file describes one: add --bus with one of {}",
                    names()
                )));
            }
        };
        let description = skin.buses.get(bus).expect("just found");
        match (description.format, self.joined) {
            (Format::Classic, false) => {
                return Err(Failure::usage_error(format!(
                    "bus {} is classic: a packet consists of several frames with one identifier, which a DBC \
                     cannot tell apart: add --joined to describe whole packets, for a program that joins \
                     their frames first",
                    description.name
                )));
            }
            (Format::Fd, true) => {
                return Err(Failure::usage_error(format!(
                    "--joined is for classic buses; on {} a packet is one FD frame",
                    description.name
                )));
            }
            (Format::Fd, false) | (Format::Classic, true) => {}
        }
        let text = dbc_text(&skin, bus);
        match self.output {
            Some(path) => self.overwrite.write("-o", &path, &text),
            None => print_text(&text),
        }
    }
}
