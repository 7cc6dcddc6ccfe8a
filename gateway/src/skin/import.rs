//! `gateway skin import`.

use std::path::{Path, PathBuf};

use clap::Args;
use protocol::document;
use protocol::usage::{Failure, print};
use robots::{CellOnLink, Chain, Import as Described, Urdf};
use serde::Deserialize;

use super::super::output::{Force, apart, note};
use super::super::print::{count, list};
use super::super::robot_file::path_from;
use super::covering::{self, Covered, Covering};

/// Describe a skin on a robot of one's own, from its URDF
///
/// A chain of joints leads from the root to each tip. Its joints become Denavit-Hartenberg rows, and how much these differ
/// from the URDF's own kinematics is computed and printed: more than 1e-9 m or rad is an error. Chains may share their first
/// joints, as two arms share a torso. Cells sit where CELLS.csv says, or cover the links that --cover names; else there is
/// one on each tip, to begin with.
#[derive(Args, Debug)]
#[command(
    after_help = "CELLS.csv has a line for each cell: the link, its position and its outward normal in the link's frame, and where
if it is to be given, its bus and its node id:
  link,px,py,pz,nx,ny,nz,bus,node
  link5,0.05,0,-0.1,1,0,0,vcan0,1

Examples:
  gateway skin import panda.urdf --tip hand --cells cells.csv -o panda.toml
  gateway skin import panda.urdf --tip hand --cover link5,link6 -o panda.toml
  gateway skin import two-arms.urdf --tip left_hand --tip right_hand -o both.toml
  gateway run panda.toml --duration 10"
)]
pub(super) struct Import {
    /// The robot's description; of a xacro file, what `xacro FILE` prints
    #[arg(value_name = "ROBOT.urdf")]
    urdf: PathBuf,
    /// The last link of a chain; several chains by several of them
    #[arg(long, value_name = "LINK", required = true)]
    tip: Vec<String>,
    /// The first link of all chains; else the robot's root
    #[arg(long, value_name = "LINK")]
    root: Option<String>,
    /// Where the cells sit
    #[arg(long, value_name = "CELLS.csv")]
    cells: Option<PathBuf>,
    #[command(flatten)]
    covering: Covering,
    /// The file to write, whole or not at all; else standard output
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    force: Force,
}

/// A line of the file of cells.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    link: String,
    px: f64,
    py: f64,
    pz: f64,
    nx: f64,
    ny: f64,
    nz: f64,
    #[serde(default)]
    bus: Option<String>,
    #[serde(default)]
    node: Option<u8>,
}

impl Import {
    pub(super) fn run(self) -> Result<(), Failure> {
        let read = [Some(self.urdf.as_path()), self.cells.as_deref()].into_iter().flatten();
        apart([("-o", self.output.as_deref())], read)?;
        let file = self.urdf.display().to_string();
        let urdf = Urdf::parse(&file, &text(&self.urdf)?).map_err(Failure::usage)?;
        let chain = |tip: &String| urdf.chain(self.root.as_deref(), tip).map_err(Failure::usage);
        let chains = self.tip.iter().map(chain).collect::<Result<Vec<_>, _>>()?;
        if let Some(twice) =
            self.tip.iter().enumerate().find(|(index, tip)| self.tip.iter().take(*index).any(|it| it == *tip))
        {
            return Err(Failure::usage(format!("--tip {}: this tip is named twice", twice.1)));
        }
        let Covered { cells, figures } = match &self.cells {
            Some(path) => Covered { cells: cells(path)?, figures: Vec::new() },
            None if self.covering.cover.is_empty() => Covered { cells: Vec::new(), figures: Vec::new() },
            None => self.covering.cells(&urdf, &self.urdf, &chains)?,
        };
        let command = self.command();
        let path = self.output.as_deref().and_then(|output| path_from(output, &self.urdf));
        let import = Described {
            name: if urdf.name.is_empty() { "robot" } else { &urdf.name },
            command: &command,
            urdf: path.as_deref(),
            chains: &chains,
            cells: &cells,
        };
        let wrong = |error: robots::ImportError| match &self.cells {
            Some(path) => Failure::usage(format!("{}: {error}", path.display())),
            None => Failure::usage(format!("{file}: {error}")),
        };
        let skin = import.toml().map_err(wrong)?;
        match &self.output {
            Some(path) => self.force.write("-o", path, &skin)?,
            None => print(&skin)?,
        }
        for chain in &chains {
            note(reported(chain));
        }
        for figures in &figures {
            note(covering::reported(figures));
        }
        Ok(())
    }

    /// What made the skin, with the files' names alone.
    fn command(&self) -> String {
        let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut command = format!("gateway skin import {}", name(&self.urdf));
        for tip in &self.tip {
            command += &format!(" --tip {tip}");
        }
        if let Some(root) = &self.root {
            command += &format!(" --root {root}");
        }
        if let Some(cells) = &self.cells {
            command += &format!(" --cells {}", name(cells));
        }
        command += &self.covering.words();
        command.replace(['\n', '\r'], " ")
    }
}

/// A chain in a line.
fn reported(chain: &Chain) -> String {
    let (joints, rows) = (count(chain.joints.len(), "joint"), count(chain.rows.len(), "row"));
    let names = list(chain.joints.iter().map(|joint| &joint.name));
    format!(
        "{} to {}: {joints} ({names}) in {rows}; rows and URDF differ by {:.1e} m or rad at most",
        chain.root, chain.tip, chain.residual
    )
}

fn text(path: &Path) -> Result<String, Failure> {
    document::text(path).map_err(Failure::usage)
}

/// The cells of a file.
fn cells(path: &Path) -> Result<Vec<CellOnLink>, Failure> {
    let file = path.display();
    let text = text(path)?;
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(text.as_bytes());
    let headers = reader.headers().map_err(|error| Failure::usage(format!("{file}: {error}")))?.clone();
    let mut cells = Vec::new();
    for record in reader.records() {
        let wrong = |error: csv::Error| {
            let line = error.position().map_or(0, csv::Position::line);
            #[expect(clippy::wildcard_enum_match_arm, reason = "the others are said as they are")]
            let what = match error.kind() {
                csv::ErrorKind::Deserialize { err, .. } => {
                    let column = err.field().and_then(|field| headers.get(usize::try_from(field).ok()?));
                    let column = column.map_or_else(String::new, |column| format!("{column}: "));
                    format!("{column}{}", err.kind())
                }
                csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
                    format!("{} where the first line has {expected_len}", count(*len, "value"))
                }
                _ => error.to_string(),
            };
            let columns = "the columns are link,px,py,pz,nx,ny,nz and, if given, bus,node";
            Failure::usage(format!("{file}: line {line}: {what}; {columns}"))
        };
        let record = record.map_err(wrong)?;
        let line = record.position().map_or(0, csv::Position::line);
        let Line { link, px, py, pz, nx, ny, nz, bus, node } =
            record.deserialize(Some(&headers)).map_err(wrong)?;
        let numbers = [px, py, pz, nx, ny, nz];
        if let Some(number) = numbers.iter().find(|number| !number.is_finite()) {
            return Err(Failure::usage(format!(
                "{file}: line {line}: {number} is no position: it must be finite"
            )));
        }
        let bus = bus.filter(|bus| !bus.is_empty());
        let line = usize::try_from(line).unwrap_or_default();
        cells.push(CellOnLink {
            link,
            position: [px, py, pz],
            normal: [nx, ny, nz],
            bus,
            node,
            line,
            ..CellOnLink::default()
        });
    }
    if cells.is_empty() {
        return Err(Failure::usage(format!(
            "{file}: there is no cell in it: write a line for each, or leave --cells out"
        )));
    }
    Ok(cells)
}
