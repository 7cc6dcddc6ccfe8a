//! `skinbus explain`.

mod show;
mod torque;

use std::path::PathBuf;

use analysis::explain::{CellExplanation, RequestedJoints, TorqueExplanation, explain, read_to_joints};
use clap::Args;
use protocol::id::CellId;
use protocol::packet::Epoch;
use protocol::skin::{CellName, Skin};
use protocol::usage::{Failure, print_text};
use serde::Serialize;
use trace::capture::Reader;

use super::arguments::{find_cell, parse_time_ns};
use super::input::{is_file, is_path, no_frame_failure, note_skin_difference, skin_of_recording};
use super::output;
use super::print::to_pretty_json;

/// Explain how the torques of one epoch came about, or compute those of a given force
///
/// Reads a capture up to the joints of that epoch. Shows each cell's contact state, the force that it computes, the
/// Jacobian, their product in double precision, the nearest step of 2^-12 Nm, and the word that the cell sent; then the
/// totals beside the central computation. Lists information that the capture does not contain.
///
/// With --force or --batch, computes the torques of a force on a cell instead, for a skin or the skin in a recording:
/// the central ones in double precision from the numbers of the skin's file, and the cell's with the code of a cell,
/// from the words of its parameters and of the joints' positions. Positions of prismatic joints must be within their
/// limits; angles within one turn each way, or within wider limits.
#[derive(Args, Debug)]
#[command(after_help = "ROWS.csv has a line for each row, positions with spaces between them:
  cell,force_n,q
  vcan0:12,2.5,0 -1.2 1.0 -1.4 -1.57 0

Examples:
  skinbus explain run.log --skin gateway/examples/ur5-253.toml --epoch 77
  skinbus explain run.mcap --epoch 77 --cell 12
  skinbus explain run.mcap run-*.mcap --epoch 77 --at 700
  skinbus explain run.mcap --epoch 77 --at 20 --joint 2 --json
  skinbus explain skin.toml --cell 12 --force 2.5 --joints \"0 -1.2 1.0 -1.4 -1.57 0\"
  skinbus explain skin.toml --batch rows.csv --json > torques.jsonl")]
pub(crate) struct ExplainCommand {
    /// A candump log or an MCAP recording (all parts of a split one, in any order); - for standard input. With --force
    /// or --batch: a skin file or a recording
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Explain the torques for the joint broadcast whose number modulo 256 is this epoch
    #[arg(long, value_name = "E", required_unless_present_any = ["force", "batch"])]
    epoch: Option<u8>,
    /// Take the first joint broadcast of the epoch at or after this time: seconds since the start of the run, or since
    /// the first frame of a log
    #[arg(long, value_name = "S", value_parser = parse_time_ns, default_value = "0", conflicts_with_all = ["force", "batch"])]
    at: u64,
    /// Take the Kth joint broadcast of the epoch from --at on; epochs repeat every 256 broadcasts
    #[arg(long, value_name = "K", default_value_t = 1, conflicts_with_all = ["force", "batch"], value_parser = clap::value_parser!(u32).range(1..))]
    occurrence: u32,
    /// Show every step of the computation of one cell
    #[arg(long, value_name = "[BUS:]NODE")]
    cell: Option<CellName>,
    /// Show the torques of all cells, but only at joint J (1 is the first)
    #[arg(long, value_name = "J", conflicts_with_all = ["force", "batch"], value_parser = clap::value_parser!(u8).range(1..=32))]
    joint: Option<u8>,
    #[command(flatten)]
    given: torque::TorqueOptions,
    /// Skin file [default: the skin in the recording]
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Print one JSON object; with --batch, one per row
    #[arg(long, short)]
    json: bool,
}

/// An explanation with its source, as JSON.
#[derive(Serialize)]
struct ExplainOutput<'a> {
    source: String,
    epoch: u8,
    #[serde(flatten)]
    explanation: &'a TorqueExplanation,
}

impl ExplainCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let Some(epoch) = self.epoch else {
            return self.given.print_torques(&self.files, self.cell.as_ref(), self.json);
        };
        if let Some(bus) = self.files.iter().find(|file| !is_file(file) && !is_path(file)) {
            let bus = bus.display();
            return Err(Failure::usage_error(format!(
                "there is no file {bus}; to explain a live bus, record it first: `skinbus dump {bus} | cut -f1 > run.log`"
            )));
        }
        let skin = match &self.skin {
            Some(path) => Skin::read(path).map_err(Failure::usage_error)?,
            None => skin_of_recording(&self.files)?,
        };
        self.check_cell_and_joint(&skin)?;
        let mut reader = Reader::open_all(&self.files).map_err(Failure::usage_error)?;
        let name = reader.name().to_owned();
        let requested =
            RequestedJoints { epoch: Epoch(epoch), from_ns: self.at, occurrence: self.occurrence };
        let found = read_to_joints(&mut reader, &skin, requested).map_err(Failure::run_error)?;
        for (count, what) in [
            (found.dropped, "frames are missing before this broadcast, so contact states may be outdated"),
            (found.unreadable, "lines before this broadcast could not be read"),
        ] {
            if count > 0 {
                output::print_note(format_args!("{name}: {count} {what}"));
            }
        }
        if let Some(why) = &reader.extras().unfinished {
            output::print_note(format_args!("{name}: {why}"));
        }
        if found.is_empty {
            return Err(no_frame_failure(&reader));
        }
        let moments = found.moments.map_err(|error| Failure::run_error(format!("{name}: {error}")))?;
        // An error above, which may be due to a different skin, is returned without this note.
        if let Some(path) = &self.skin {
            note_skin_difference(&self.files, path, &skin);
        }
        let mut explanation = explain(&skin, &moments);
        if let Some(target) = &self.cell {
            let is_named = |cell: &CellExplanation| {
                CellId::new(cell.node.into()).is_ok_and(|node| target.matches_cell(&cell.bus, node))
            };
            explanation.cells.retain(is_named);
        }
        if let Some(joint) = self.joint {
            for cell in &mut explanation.cells {
                cell.rows.retain(|row| row.joint == joint);
            }
            explanation.total.retain(|total| total.joint == joint);
        }
        if self.json {
            let whole = ExplainOutput { source: name, epoch, explanation: &explanation };
            return print_text(&to_pretty_json(&whole)?);
        }
        let what = match (self.cell.is_some(), self.joint) {
            (true, _) => show::ExplainDetail::Cells,
            (false, Some(_)) => show::ExplainDetail::Joint,
            (false, None) => show::ExplainDetail::All,
        };
        print_text(&show::format_explanation(
            &name,
            epoch,
            (found.zero_ns, found.counts_from_run),
            &explanation,
            what,
        ))
    }

    /// Checks that the skin has the cell and the joint.
    fn check_cell_and_joint(&self, skin: &Skin) -> Result<(), Failure> {
        let joints = skin.robot.joints.len();
        if let Some(joint) = self.joint.filter(|joint| usize::from(*joint) > joints) {
            return Err(Failure::usage_error(format!(
                "--joint {joint}: {} has joints 1 to {joints}",
                skin.robot.name
            )));
        }
        self.cell.as_ref().map_or(Ok(()), |cell| find_cell(skin, cell, "--cell").map(|_| ()))
    }
}
