//! `gateway skin generate` and `gateway skin check`.

use std::collections::BTreeMap;
use std::fmt::{self, Write};
use std::path::PathBuf;

use clap::{Args, Subcommand};
use model::generate::{self, Wanted};
use protocol::can::Format;
use protocol::packet::crc16;
use protocol::skin::{ControllerKind, Reply, Skin as Description};
use protocol::usage::{Failure, print};

use super::output::Force;

/// Make and check the descriptions of skins
#[derive(Args, Debug)]
pub(crate) struct Skin {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Generate(Generate),
    Check(Check),
}

/// Describe a skin of hexagonal cells on a robot's arm
///
/// The same wish makes the same text; its first line is the command that makes it anew.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  gateway skin generate -o skin.toml
  gateway skin generate --cells 508 --buses 2 --format classic > skin.toml")]
struct Generate {
    #[command(flatten)]
    wanted: Wanted,
    /// The file to write, whole or not at all; else standard output
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    force: Force,
}

/// Check a skin's description, and say in a few lines what it describes
///
/// Exit code 2, and one line with the line, the key, the value and what is allowed, when something is wrong.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  gateway skin check gateway/examples/ur5-253.toml
  gateway skin check skin.toml --cells | grep 'vcan0 12 '")]
struct Check {
    /// The skin's description
    file: PathBuf,
    /// Also list the cells, one a line, with the configuration hash that their heartbeats carry
    #[arg(long)]
    cells: bool,
}

impl Skin {
    pub(crate) fn run(self) -> Result<(), Failure> {
        match self.command {
            Command::Generate(command) => command.run(),
            Command::Check(command) => command.run(),
        }
    }
}

impl Generate {
    fn run(self) -> Result<(), Failure> {
        let text = generate::generate(&self.wanted).map_err(Failure::usage)?;
        match self.output {
            Some(path) => self.force.write("-o", &path, &text),
            None => print(&text),
        }
    }
}

impl Check {
    fn run(self) -> Result<(), Failure> {
        let skin = Description::read(&self.file).map_err(Failure::usage)?;
        let mut text = String::new();
        describe(&mut text, &skin).expect("a string takes whatever is written");
        if self.cells {
            list(&mut text, &skin).expect("a string takes whatever is written");
        }
        print(&text)
    }
}

fn describe(out: &mut String, skin: &Description) -> fmt::Result {
    let Description { name, robot, timing, events: _, buses, controller, safety: _, cells } = skin;
    let joints = robot.joints.len();
    writeln!(out, "{name}: {}, {}", count(cells.len(), "cell"), count(buses.len(), "bus"))?;
    writeln!(out, "robot: {}, {}", robot.name, count(joints, "joint"))?;
    let controller = match &controller.kind {
        ControllerKind::Kinesthetic { .. } => "kinesthetic controller".to_owned(),
        ControllerKind::External { socket } => format!("external controller at {socket}"),
    };
    write!(out, "timing: control loop {} Hz, joints {} Hz", timing.control_hz, timing.broadcast_hz())?;
    if let Some(cell) = cells.first() {
        write!(out, " (every {} us)", skin.parameters(cell).period_us)?;
    }
    writeln!(out, ", {controller}")?;
    for (index, bus) in buses.iter().enumerate() {
        let format = match bus.format {
            Format::Fd => "fd",
            Format::Classic => "classic",
        };
        let reply = match bus.reply {
            Reply::Torque => "torque".to_owned(),
            Reply::Sum { slot_us, carry: true } => format!("sum, slots of {slot_us} us"),
            Reply::Sum { slot_us, carry: false } => format!("sum without carry, slots of {slot_us} us"),
        };
        write!(out, "bus {} ({format}, {reply}): ", bus.name)?;
        let mut by_joint = BTreeMap::new();
        for cell in skin.cells_of(index) {
            *by_joint.entry(cell.joint).or_insert(0) += 1;
        }
        let parts: Vec<_> =
            by_joint.iter().map(|(joint, cells)| format!("{cells} on joint {joint}")).collect();
        write!(out, "{}: {}; ", count(by_joint.values().sum(), "cell"), parts.join(", "))?;
        let roots: Vec<_> =
            skin.cells_of(index).filter(|cell| cell.root).map(|cell| cell.node.to_string()).collect();
        match roots.as_slice() {
            [] => writeln!(out, "no root")?,
            [root] => writeln!(out, "root {root}")?,
            roots => writeln!(out, "roots {}", roots.join(" "))?,
        }
    }
    let images: Vec<u8> = cells.iter().flat_map(|cell| skin.parameters(cell).image()).collect();
    writeln!(out, "hash: {:04X} over the parameters of all cells; --cells lists each cell's", crc16(&images))
}

fn list(out: &mut String, skin: &Description) -> fmt::Result {
    for cell in &skin.cells {
        let bus = skin.buses.get(cell.bus).map_or("", |bus| bus.name.as_str());
        let (node, joint, serial) = (cell.node, cell.joint, cell.serial);
        let hash = skin.parameters(cell).hash();
        writeln!(out, "{bus} {node} joint {joint} serial {serial} hash {hash:04X}")?;
    }
    Ok(())
}

fn count(count: usize, what: &str) -> String {
    let plural = match what {
        _ if count == 1 => "",
        "bus" => "es",
        _ => "s",
    };
    format!("{count} {what}{plural}")
}
