//! `skinbus explain`.

mod show;

use std::path::PathBuf;

use analysis::explain::{Explanation, Requested, explain, find};
use clap::Args;
use protocol::packet::Epoch;
use protocol::skin::Skin;
use protocol::usage::{Failure, print};
use serde::Serialize;
use trace::capture::Reader;

use super::arguments::{Named, cell, nanos};
use super::input::{no_frame, remark_another, skin_of};
use super::output;
use super::print::json;

/// Explain the torque of one epoch
///
/// Reads a capture up to the joints of that epoch and shows each cell's contact state, the force that it computes from
/// it, the Jacobian, their product in double precision, the nearest step of 2^-12 Nm, and the word that the cell sent;
/// and what all of them add up to, beside the central computation. What the capture does not contain is listed.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus explain run.log --skin gateway/examples/ur5-253.toml --epoch 77
  skinbus explain run.mcap --epoch 77 --cell 12
  skinbus explain run.mcap run-*.mcap --epoch 77 --at 700
  skinbus explain run.mcap --epoch 77 --at 20 --joint 2 --json")]
pub(crate) struct Explain {
    /// A candump log or an MCAP recording, or all parts of a split one in any order; - for standard input
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// The number of the joints, modulo 256
    #[arg(long, value_name = "N")]
    epoch: u8,
    /// Only joints from so many seconds after the first frame on
    #[arg(long, value_name = "S", value_parser = nanos, default_value = "0")]
    at: u64,
    /// Which joints of this epoch, when there are several
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    occurrence: u32,
    /// One cell in every step: its node id, or BUS:NODE
    #[arg(long, value_name = "CELL", value_parser = cell)]
    cell: Option<Named>,
    /// One joint, cell by cell
    #[arg(long, value_name = "J", value_parser = clap::value_parser!(u8).range(1..=32))]
    joint: Option<u8>,
    /// The skin's description; else the one in the recording
    #[arg(long, value_name = "FILE")]
    skin: Option<PathBuf>,
    /// One JSON object
    #[arg(long)]
    json: bool,
}

/// What is printed as JSON.
#[derive(Serialize)]
struct Whole<'a> {
    source: String,
    epoch: u8,
    #[serde(flatten)]
    explanation: &'a Explanation,
}

impl Explain {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let skin = match &self.skin {
            Some(path) => Skin::read(path).map_err(Failure::usage)?,
            None => skin_of(&self.files)?,
        };
        self.check(&skin)?;
        let mut reader = Reader::open_all(&self.files).map_err(Failure::usage)?;
        let name = reader.name().to_owned();
        let requested = Requested { epoch: Epoch(self.epoch), from_ns: self.at, occurrence: self.occurrence };
        let found = find(&mut reader, &skin, requested).map_err(Failure::run)?;
        for (count, what) in [
            (found.dropped, "frames are missing before this point; contact states may be out of date"),
            (found.unreadable, "lines before this point could not be read"),
        ] {
            if count > 0 {
                output::note(format_args!("{name}: {count} {what}"));
            }
        }
        if let Some(why) = &reader.extras().unfinished {
            output::note(format_args!("{name}: {why}"));
        }
        if found.is_empty {
            return Err(no_frame(&reader));
        }
        let moments = found.moments.map_err(|error| Failure::run(format!("{name}: {error}")))?;
        // Where another skin is an error, that says all.
        if let Some(path) = &self.skin {
            remark_another(&self.files, path, &skin);
        }
        let mut explanation = explain(&skin, &moments);
        if let Some(target) = &self.cell {
            let named = |bus: &str, node: u8| {
                node == target.node.get() && target.bus.as_ref().is_none_or(|target| target == bus)
            };
            explanation.cells.retain(|cell| named(&cell.bus, cell.node));
        }
        if let Some(joint) = self.joint {
            for cell in &mut explanation.cells {
                cell.rows.retain(|row| row.joint == joint);
            }
            explanation.total.retain(|total| total.joint == joint);
        }
        if self.json {
            let whole = Whole { source: name, epoch: self.epoch, explanation: &explanation };
            return print(&json(&whole)?);
        }
        let what = match (self.cell.is_some(), self.joint) {
            (true, _) => show::What::Cells,
            (false, Some(_)) => show::What::Joint,
            (false, None) => show::What::All,
        };
        print(&show::text(&name, self.epoch, found.first_ns, &explanation, what))
    }

    /// The cell and the joint must be the skin's.
    fn check(&self, skin: &Skin) -> Result<(), Failure> {
        let joints = skin.robot.joints.len();
        if let Some(joint) = self.joint.filter(|joint| usize::from(*joint) > joints) {
            return Err(Failure::usage(format!(
                "--joint {joint}: {} has joints 1 to {joints}",
                skin.robot.name
            )));
        }
        self.cell.as_ref().map_or(Ok(()), |cell| cell.find(skin, "--cell").map(|_| ()))
    }
}
