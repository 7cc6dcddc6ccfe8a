//! `skinbus skin import`.

use std::path::{Path, PathBuf};

use clap::Args;
use protocol::document;
use protocol::id::CellId;
use protocol::usage::{Failure, print_text};
use robots::{CellOnLink, ImportError, JointKind, SkinImport as Described, UrdfChain};

use super::super::columns::{Columns, CsvTable};
use super::super::output::{OverwriteOption, check_distinct_files, is_standard_output, print_note};
use super::super::print::{comma_separated, count_with_noun};
use super::super::robot_file::{read_urdf, relative_path};
use super::covering::{self, CoverArguments, CoverResult};

/// Write a skin file for your robot, from its URDF
///
/// A chain of joints leads from the root to each tip. Its joints become Denavit-Hartenberg rows. Computes and prints
/// the difference between these and the URDF's own kinematics: more than 1e-9 m or rad is an error. Chains may share
/// their first joints, as two arms share a torso. Cells sit at the places in CELLS.csv, or cover the links that --cover
/// names; otherwise each tip gets one cell as a start.
#[derive(Args, Debug)]
#[command(
    after_help = "CELLS.csv has a line for each cell: the link, its position and its outward normal in the link's frame, and where
if it is to be given, its bus and its node id:
  link,px,py,pz,nx,ny,nz,bus,node
  link5,0.05,0,-0.1,1,0,0,vcan0,1

Examples:
  skinbus skin import panda.urdf --tip hand --places cells.csv -o panda.toml
  skinbus skin import panda.urdf --tip hand --cover link5,link6 -o panda.toml
  skinbus skin import two-arms.urdf --tip left_hand --tip right_hand -o both.toml
  skinbus run panda.toml --duration 10"
)]
pub(super) struct ImportCommand {
    /// The robot's URDF; for a xacro file, the output of `xacrodoc FILE -o ROBOT.urdf`
    #[arg(value_name = "ROBOT.urdf")]
    urdf: PathBuf,
    /// Last link of a chain; repeat the option for further chains
    #[arg(long, value_name = "LINK", required = true)]
    tip: Vec<String>,
    /// First link of all chains [default: the robot's root]
    #[arg(long, value_name = "LINK")]
    root: Option<String>,
    /// CSV file with the positions of the cells
    #[arg(long, value_name = "CELLS.csv")]
    places: Option<PathBuf>,
    #[command(flatten)]
    covering: CoverArguments,
    /// Output file; after an error, no incomplete file is left [default: standard output]
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

/// Columns of the file of cells.
const COLUMNS: Columns =
    Columns { needed: &["link", "px", "py", "pz", "nx", "ny", "nz"], optional: &["bus", "node"] };

impl ImportCommand {
    pub(super) fn run(self) -> Result<(), Failure> {
        let read = [Some(self.urdf.as_path()), self.places.as_deref()].into_iter().flatten();
        check_distinct_files([("-o", self.output.as_deref())], read)?;
        let file = self.urdf.display().to_string();
        let (urdf, _) = read_urdf(&self.urdf).map_err(Failure::usage_error)?;
        let chain = |tip: &String| urdf.chain(self.root.as_deref(), tip).map_err(Failure::usage_error);
        let chains = self.tip.iter().map(chain).collect::<Result<Vec<_>, _>>()?;
        if let Some(twice) =
            self.tip.iter().enumerate().find(|(index, tip)| self.tip.iter().take(*index).any(|it| it == *tip))
        {
            return Err(Failure::usage_error(format!(
                "--tip {}: this tip is named twice: name it once",
                twice.1
            )));
        }
        let CoverResult { cells, figures } = match &self.places {
            Some(path) => CoverResult { cells: cells(path)?, figures: Vec::new() },
            None if self.covering.cover.is_empty() => CoverResult { cells: Vec::new(), figures: Vec::new() },
            None => self.covering.cover_links(&urdf, &self.urdf, &chains)?,
        };
        let command = self.creating_command();
        // A skin cannot name a URDF that was read from a pipe.
        let is_named = |path: &&Path| !is_standard_output(path) && self.urdf.is_file();
        let output = self.output.as_deref().filter(is_named);
        let path = output.and_then(|output| relative_path(output, &self.urdf));
        let import = Described {
            name: if urdf.name.is_empty() { "robot" } else { &urdf.name },
            command: &command,
            urdf: path.as_deref(),
            chains: &chains,
            cells: &cells,
        };
        let wrong = |error: ImportError| match &self.places {
            Some(path) if error.is_error_in_cells() => {
                Failure::usage_error(format!("{}: {error}", path.display()))
            }
            Some(_) | None => Failure::usage_error(format!("{file}: {error}")),
        };
        let skin = import.toml().map_err(wrong)?;
        match &self.output {
            Some(path) => self.overwrite.write("-o", path, &skin)?,
            None => print_text(&skin)?,
        }
        for chain in &chains {
            print_note(chain_text(chain));
            for joint in suspicious_limits(chain) {
                print_note(joint);
            }
        }
        for figures in &figures {
            print_note(covering::figures_text(figures));
        }
        Ok(())
    }

    /// Returns the command that creates the skin, with the names of files but without their directories.
    fn creating_command(&self) -> String {
        let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut command = format!("skinbus skin import {}", name(&self.urdf));
        for tip in &self.tip {
            command += &format!(" --tip {tip}");
        }
        if let Some(root) = &self.root {
            command += &format!(" --root {root}");
        }
        if let Some(places) = &self.places {
            command += &format!(" --places {}", name(places));
        }
        command += &self.covering.command_options();
        command.replace(['\n', '\r'], " ")
    }
}

/// Describes a chain in one line.
fn chain_text(chain: &UrdfChain) -> String {
    let (joints, rows) =
        (count_with_noun(chain.joints.len(), "joint"), count_with_noun(chain.rows.len(), "row"));
    let names = comma_separated(chain.joints.iter().map(|joint| &joint.name));
    format!(
        "{} to {}: {joints} ({names}) in {rows}; rows and URDF differ by at most {:.1e} m or rad",
        chain.root, chain.tip, chain.residual
    )
}

/// Limit in rad, in both directions, above which an angle is probably in degrees.
const MAX_PLAUSIBLE_RAD: f64 = 8.0 * core::f64::consts::PI;

/// Returns the joints whose limits are probably in degrees, one line each.
fn suspicious_limits(chain: &UrdfChain) -> impl Iterator<Item = String> {
    let turning = chain.joints.iter().filter(|joint| joint.kind == JointKind::Revolute);
    let wide = turning.filter(|joint| joint.limits.iter().any(|limit| limit.abs() > MAX_PLAUSIBLE_RAD));
    wide.map(|joint| {
        let [lower, upper] = joint.limits;
        format!(
            "joint {}: limits of {lower} to {upper} rad are more than four turns: if they are in degrees, convert them to rad",
            joint.name
        )
    })
}

fn read_text(path: &Path) -> Result<String, Failure> {
    document::read_text(path).map_err(Failure::usage_error)
}

/// Reads the cells from a CSV file.
fn cells(path: &Path) -> Result<Vec<CellOnLink>, Failure> {
    let file = path.display().to_string();
    let text = read_text(path)?;
    let mut table = CsvTable::new(&file, &text, COLUMNS)?;
    let mut cells = Vec::new();
    while let Some(row) = table.next_row()? {
        let vector =
            |[x, y, z]: [&str; 3]| Ok::<_, Failure>([row.number(x)?, row.number(y)?, row.number(z)?]);
        let node = match row.text("node") {
            "" => None,
            text => {
                let wrong = |_| row.value_error("node", "use 1 to 254, or leave it empty for a free node id");
                Some(text.parse::<CellId>().map_err(wrong)?.get())
            }
        };
        cells.push(CellOnLink {
            link: row.text("link").to_owned(),
            position: vector(["px", "py", "pz"])?,
            normal: vector(["nx", "ny", "nz"])?,
            bus: Some(row.text("bus").to_owned()).filter(|bus| !bus.is_empty()),
            node,
            line: row.line,
            ..CellOnLink::default()
        });
    }
    if cells.is_empty() {
        return Err(Failure::usage_error(format!(
            "{file}: it contains no cells: write a line for each, or leave --places out"
        )));
    }
    Ok(cells)
}
