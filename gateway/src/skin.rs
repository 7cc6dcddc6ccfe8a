//! `skinbus skin generate`, `skinbus skin import`, `skinbus skin check`, `skinbus skin show` and `skinbus skin urdf`.

mod covering;
mod import;
mod show;
mod urdf;

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;

use clap::{Args, Subcommand};
use model::generate::{Reply as Answers, Robot, Target, generate};
use protocol::can::Format;
use protocol::fixed::TorqueFormat;
use protocol::packet::crc16;
use protocol::skin::{Cell, ControllerKind, Reply, Skin as Description};
use protocol::usage::{Failure, print, shown};

use super::arguments::{FORMATS, Word, bus_names, one_of};
use super::output::Force;
use super::print::{count, list, or, words};
use super::robot_file::{RobotOfSkin, urdf_of};
pub(crate) use show::drawing;

const ROBOTS: &[Word<Robot>] = &[("ur5", "Universal Robots UR5", Robot::Ur5)];
const REPLIES: &[Word<Answers>] =
    &[("torque", "Each cell its own torque", Answers::Torque), ("sum", "Sums along the tree", Answers::Sum)];

/// Make, check and draw the descriptions of skins
#[derive(Args, Debug)]
pub(crate) struct Skin {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Generate(Generate),
    Import(import::Import),
    Check(Check),
    Show(show::Show),
    Urdf(urdf::Urdf),
}

/// Describe a skin of hexagonal cells on a robot's arm
///
/// The same options give the same text; its first line is the command that generates it.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus skin generate -o skin.toml
  skinbus skin generate --cells 508 --buses 2 --format classic > skin.toml")]
struct Generate {
    /// The robot that wears the skin
    #[arg(long, value_parser = one_of(ROBOTS), default_value = "ur5")]
    robot: Robot,
    /// How many cells, 1 to 254 a bus
    #[arg(long, default_value_t = 253)]
    cells: usize,
    /// How many buses; cells of one bus lie together
    #[arg(long, default_value_t = 1)]
    buses: usize,
    /// Joint broadcasts in a second; must divide the 500 Hz of the control loop
    #[arg(long, default_value_t = 62.5)]
    broadcast_hz: f64,
    /// What the cells answer with
    #[arg(long, value_parser = one_of(REPLIES), default_value = "torque")]
    reply: Answers,
    /// The frame format of their packets
    #[arg(long, value_parser = one_of(FORMATS), default_value = "fd")]
    format: Format,
    /// The file to write, whole or not at all; else standard output
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    force: Force,
}

/// Check a skin's description, and summarise it in a few lines
///
/// The URDF that it names is read too. Exit code 2, and one line with the line, the key, the value and what is allowed,
/// when something is wrong.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus skin check gateway/examples/ur5-253.toml
  skinbus skin check skin.toml --node 12")]
struct Check {
    /// The skin's description
    file: PathBuf,
    /// Also list the cells, one a line: where each sits in the frame of its joint, whom its ports lead to, and the
    /// configuration hash that its heartbeats carry
    #[arg(long)]
    cells: bool,
    /// List the cells with this node id alone
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=254), conflicts_with = "cells")]
    node: Option<u8>,
}

impl Skin {
    pub(crate) fn run(self) -> Result<(), Failure> {
        match self.command {
            Command::Generate(command) => command.run(),
            Command::Import(command) => command.run(),
            Command::Check(command) => command.run(),
            Command::Show(command) => command.run(),
            Command::Urdf(command) => command.run(),
        }
    }
}

impl Generate {
    fn run(self) -> Result<(), Failure> {
        let Self { robot, cells, buses, broadcast_hz, reply, format, output, force } = self;
        let target = Target { robot, cells, buses, broadcast_hz, reply, format };
        let text = generate(&target).map_err(Failure::usage)?;
        match output {
            Some(path) => force.write("-o", &path, &text),
            None => print(&text),
        }
    }
}

impl Check {
    fn run(self) -> Result<(), Failure> {
        let skin = Description::read(&self.file).map_err(Failure::usage)?;
        // As a run that records does.
        if let Some(urdf) = &skin.robot.urdf {
            RobotOfSkin::read(&skin, Some(&urdf_of(&self.file, urdf)))?;
        }
        let Some(node) = self.node else {
            return print(&if self.cells { describe(&skin) + &cells(&skin, None) } else { describe(&skin) });
        };
        match cells(&skin, Some(node)) {
            lines if lines.is_empty() => {
                let (file, buses) = (self.file.display(), list(bus_names(&skin)));
                Err(Failure::usage(format!(
                    "--node {node}: {file} has no such cell on {buses}; --cells lists all"
                )))
            }
            lines => print(&lines),
        }
    }
}

fn describe(skin: &Description) -> String {
    let Description { name, robot, timing, events: _, buses, controller, safety: _, cells } = skin;
    let controller = match &controller.kind {
        ControllerKind::Kinesthetic { .. } => "kinesthetic controller".to_owned(),
        ControllerKind::External { socket, .. } => format!("external controller at {socket}"),
    };
    let every = cells.first().map(|cell| format!(" (every {} us)", skin.parameters(cell).period_us));
    let (name, robot_name) = (shown(name), shown(&robot.name));
    let mut text = format!(
        "{name}: {}, {}\nrobot: {}, {}\ntiming: control loop {} Hz, joints {} Hz{}, {controller}\n",
        count(cells.len(), "cell"),
        count(buses.len(), "bus"),
        robot_name,
        count(robot.joints.len(), "joint"),
        timing.control_hz,
        timing.broadcast_hz(),
        or(every, ""),
    );
    for chain in
        robot.chains.iter().filter(|chain| robot.chains.len() > 1 || chain.rows.len() > chain.joints.len())
    {
        let names =
            words(chain.joints.iter().filter_map(|joint| robot.joints.get(*joint)).map(|joint| &joint.name));
        let (joints, rows) = (count(chain.joints.len(), "joint"), count(chain.rows.len(), "row"));
        text += &format!("chain {}: {joints} in {rows}: {}\n", shown(&chain.name), shown(&names));
    }
    for (index, bus) in buses.iter().enumerate() {
        let format = bus.format.name();
        let reply = match bus.reply {
            Reply::Torque => "torque".to_owned(),
            Reply::Sum { slot_us, carry: true } => format!("sum, slots of {slot_us} us"),
            Reply::Sum { slot_us, carry: false } => format!("sum without carry, slots of {slot_us} us"),
        };
        let mut by_joint = BTreeMap::<_, usize>::new();
        for cell in skin.cells_of(index) {
            *by_joint.entry(cell.joint).or_default() += 1;
        }
        let cells = count(by_joint.values().sum::<usize>(), "cell");
        let parts = list(by_joint.iter().map(|(joint, cells)| format!("{cells} on joint {joint}")));
        let roots: Vec<_> = skin.cells_of(index).filter(|cell| cell.root).map(|cell| cell.node).collect();
        let roots = match roots.as_slice() {
            [] => "no root".to_owned(),
            [root] => format!("root {root}"),
            roots => format!("roots {}", words(roots)),
        };
        let rates = bus.bitrate.map(|nominal| match bus.data_bitrate {
            Some(data) => format!(", {nominal} and {data} bit/s"),
            None => format!(", {nominal} bit/s"),
        });
        let rates = or(rates, "");
        let chain = if robot.chains.len() > 1 {
            format!(", chain {}", skin.chain(index).name)
        } else {
            String::new()
        };
        let torques = match bus.torque_format {
            TorqueFormat::Q3_12 => String::new(),
            format @ (TorqueFormat::Q5_10 | TorqueFormat::Q7_8) => format!(", torques in {}", format.name()),
        };
        text += &format!(
            "bus {} ({format}{rates}{chain}, {reply}{torques}): {cells}: {parts}; {roots}\n",
            bus.name
        );
    }
    for [first, second] in at_one_place(skin) {
        let name = |cell: &Cell| format!("{} on {}", cell.node, bus_name(skin, cell));
        text += &format!("remark: cells {} and {} sit at one place\n", name(first), name(second));
    }
    let images: Vec<u8> = cells.iter().flat_map(|cell| skin.parameters(cell).image()).collect();
    let hash = crc16(&images);
    text + &format!("hash: {hash:04X} over the parameters of all cells; --cells lists each cell's\n")
}

/// Cells that sit where a cell before them sits.
fn at_one_place(skin: &Description) -> Vec<[&Cell; 2]> {
    let mut known = HashMap::new();
    let place = |cell: &Cell| {
        (
            skin.buses.get(cell.bus).map(|bus| bus.chain),
            cell.row,
            cell.position.map(|metres| (metres + 0.0).to_bits()),
        )
    };
    let pair = |cell| match known.entry(place(cell)) {
        Entry::Occupied(first) => Some([*first.get(), cell]),
        Entry::Vacant(free) => {
            free.insert(cell);
            None
        }
    };
    skin.cells.iter().filter_map(pair).collect()
}

fn bus_name<'a>(skin: &'a Description, cell: &Cell) -> &'a str {
    skin.buses.get(cell.bus).map_or("", |bus| bus.name.as_str())
}

/// One line for each cell, or for those with one node id.
fn cells(skin: &Description, node: Option<u8>) -> String {
    let line = |cell: &Cell| {
        let on_bus = bus_name(skin, cell);
        let Cell { node, serial, joint, row, position, normal, neighbors, root, .. } = cell;
        let (position, ports) = (words(position), words(neighbors.map(|port| or(port, "-"))));
        // What comes of a quaternion has more digits than anybody measured.
        let normal = words(normal.map(|part| (part * 1e4).round() / 1e4 + 0.0));
        let root = if *root { " root" } else { "" };
        let row = Some(*row).filter(|row| skin.chain(cell.bus).row_of(*joint) != Some(*row));
        let row = or(row.map(|row| format!(" row {row}")), "");
        let hash = skin.parameters(cell).hash();
        format!(
            "{on_bus} {node} joint {joint}{row} at {position} m normal {normal} ports {ports}{root} serial {serial} hash \
             {hash:04X}\n"
        )
    };
    skin.cells.iter().filter(|cell| node.is_none_or(|node| cell.node.get() == node)).map(line).collect()
}
