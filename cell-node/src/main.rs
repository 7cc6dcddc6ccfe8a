//! A process that runs one or several skin cells.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, bail, ensure};
use cell_node::flash::{FlashContent, FlashState};
use cell_node::identity::Identity;
use cell_node::io::{BusPort, FlashFile, HostedCells, PortLinkIds, Sockets, StopReason};
use clap::Parser;
use protocol::bus::{BusKind, KindChoice};
use protocol::id::CellId;
use protocol::last_words::{CellRange, ExitReason};
use protocol::sine::SineMethod;
use protocol::skin::{BusWires, Skin, SkinReply};
use protocol::usage::{exit_code, flush_printed};
use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal};

/// Run one or several tactile skin cells, which receive joint positions and answer with joint torques
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Sockets of embedded buses are in $SKINBUS_DIR, else $XDG_RUNTIME_DIR/skinbus, else /tmp/skinbus-UID.

Examples:
  cell-node --bus vcan0 --node 12 --skin gateway/examples/ur5-253.toml
  cell-node --bus vcan0 --nodes 1-64 --skin gateway/examples/ur5-253.toml --flash /tmp/flash
  cell-node --bus vcan0 --node 12 --skin skin.toml --fresh --flash /tmp/flash"
)]
struct Arguments {
    /// Name of the bus, which must be one of the buses in the skin file
    #[arg(long, value_name = "NAME")]
    bus: String,
    /// Node id of the cell on the bus, 1 to 254
    #[arg(long, value_name = "N", required_unless_present = "nodes")]
    node: Option<u8>,
    /// Run the cells with these node ids, first to last, in one process over one socket
    #[arg(long, value_name = "A-B", conflicts_with = "node", value_parser = parse_range)]
    nodes: Option<(u8, u8)>,
    /// Skin file; a cell with empty flash gets its parameters from it
    #[arg(long, value_name = "FILE")]
    skin: PathBuf,
    /// Keep the parameters of cells in files in this directory; without it, they are lost when the process ends
    #[arg(long, value_name = "DIR")]
    flash: Option<PathBuf>,
    /// Start new cells: without parameters and, on a bus with sums, without node ids, which the network assigns;
    /// `skinbus commission` writes the parameters. Cells with a file in --flash start with what it contains
    #[arg(long)]
    fresh: bool,
    /// Wait for the bus at the start, and reopen it when it is lost, instead of exiting
    #[arg(long)]
    reconnect: bool,
    #[arg(long, value_name = "KIND", default_value_t = KindChoice::Auto, help = BusKind::help())]
    bus_kind: KindChoice,
    /// Sine approximation for the torques: eighths; or seventh-order, to replay recordings of earlier builds with all
    /// bits equal
    #[arg(long, value_name = "NAME", default_value_t)]
    sine: SineMethod,
    /// Exit when the parent process with this id ends
    #[arg(long, value_name = "PID")]
    with_parent: Option<i32>,
}

fn parse_range(text: &str) -> Result<(u8, u8), String> {
    let node_ids =
        text.split_once('-').and_then(|(first, last)| Some((first.parse().ok()?, last.parse().ok()?)));
    node_ids
        .filter(|&(first, last)| 1 <= first && first <= last && last <= CellId::MAX.get())
        .ok_or_else(|| "use two node ids from 1 to 254, the smaller one first, such as 1-64".to_owned())
}

impl Arguments {
    /// Returns the first and the last node id that the process runs; `None` if the network assigns it.
    fn node_range(&self) -> Option<(u8, u8)> {
        self.node.map(|node| (node, node)).or(self.nodes)
    }

    /// Reports the reason for the end of this process: as a line of [`LastWords`] if another program started
    /// it.
    fn report_exit_reason(&self, why: impl core::fmt::Display) {
        match self.node_range().filter(|_| self.with_parent.is_some()) {
            Some((first, last)) => {
                eprint_line(ExitReason {
                    cells: CellRange(first, last),
                    bus: self.bus.clone(),
                    why: why.to_string(),
                });
            }
            None => eprint_line(why),
        }
    }
}

/// Writes a line to standard error in one write, because hundreds of cell processes may share it.
fn eprint_line(text: impl core::fmt::Display) {
    protocol::usage::eprint_line(&format!("cell-node: {text}"));
}

fn main() -> ExitCode {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        // Help and version were requested and are printed unchanged.
        Err(requested) if !requested.use_stderr() => {
            return exit_code("cell-node", flush_printed(requested.print()));
        }
        Err(wrong) => {
            eprint_line(protocol::usage::one_line_error(&wrong.render().to_string()));
            return ExitCode::from(2);
        }
    };
    // Hundreds of cells wake up at once; each waits for its turn.
    protocol::bus::set_batch_scheduling();
    match prepare_cells(&arguments) {
        Ok((mut cells, sockets, line)) => {
            let Err(stopped) = cells.run(sockets, &line);
            // The program that started hundreds of cells reports once that their bus is gone.
            let is_gone = matches!(&stopped, StopReason::Bus(error) if error.is_closed());
            if arguments.with_parent.is_none() || !is_gone {
                arguments.report_exit_reason(stopped);
            }
            ExitCode::from(1)
        }
        Err(error) => {
            arguments.report_exit_reason(format_args!("{error:#}"));
            ExitCode::from(2)
        }
    }
}

fn prepare_cells(arguments: &Arguments) -> Result<(HostedCells, Sockets, BusPort)> {
    if let Some(parent) = arguments.with_parent {
        // A stopped process would not receive SIGTERM before it is continued.
        set_parent_process_death_signal(Some(Signal::KILL))?;
        // The parent may have ended before that call.
        ensure!(
            getppid() == Pid::from_raw(parent),
            "--with-parent: process {parent} is not the parent of this process"
        );
    }
    if let Some(flash) = arguments.flash.as_deref().filter(|flash| !flash.is_dir()) {
        bail!("--flash {}: this directory does not exist; create it first", flash.display());
    }
    let skin = Skin::read_for_bus(&arguments.skin, &arguments.bus)?;
    let bus_index = skin.bus_index(&arguments.bus).with_context(|| {
        let names = skin.buses.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>().join(", ");
        format!(
            "the skin file {1} has no bus {0}; its buses are {names}",
            arguments.bus,
            arguments.skin.display()
        )
    })?;
    let bus = skin.buses.get(bus_index).context("the bus that was found")?;
    let wires = match bus.reply {
        SkinReply::Torque => None,
        SkinReply::Sum { .. } => Some(skin.wires(bus_index)),
    };
    let (first, last) = arguments.node_range().context("--node or --nodes is needed")?;
    let mut cells = HostedCells::new(bus.format, arguments.sine);
    for number in first..=last {
        start_cell(&mut cells, arguments, &skin, bus_index, wires.as_ref(), CellId::new(number.into())?)?;
    }
    let line = BusPort {
        name: arguments.bus.clone(),
        choice: arguments.bus_kind,
        wires: wires.is_some(),
        reconnect: arguments.reconnect,
    };
    let sockets = match cells.open_sockets(&line) {
        Err(StopReason::Bus(error)) if line.reconnect && error.may_open_later() => {
            // The program that started hundreds of cells reports it.
            if arguments.with_parent.is_none() {
                eprint_line(format_args!("{error}; waiting for the bus"));
            }
            cells.reopen_sockets(&line)?
        }
        opened => opened?,
    };
    Ok((cells, sockets, line))
}

/// Starts a cell with the contents of its flash, which is first initialised from the skin.
fn start_cell(
    cells: &mut HostedCells,
    arguments: &Arguments,
    skin: &Skin,
    bus_index: usize,
    wires: Option<&BusWires>,
    cell: CellId,
) -> Result<()> {
    let described =
        skin.cells_on_bus(bus_index).find(|described| described.node == cell).with_context(|| {
            format!(
                "the skin file {1} has no cell {cell} on bus {0}",
                arguments.bus,
                arguments.skin.display()
            )
        })?;
    // A cell without wires is never assigned a node id.
    let is_nameless = arguments.fresh && wires.is_some();
    let mut identity = Identity { cell: (!is_nameless).then_some(cell), serial: described.serial };
    let mut file = FlashFile::new(arguments.flash.as_deref(), &arguments.bus, identity);
    let flash = match file.load().with_context(|| file.name())? {
        Ok(FlashContent { parameters: None, .. }) if !arguments.fresh => {
            let parameters = skin.parameters(described);
            let kept = FlashContent { number: Some(cell), parameters: Some(parameters) };
            file.store(&kept).with_context(|| file.name())?;
            FlashState::Valid(parameters)
        }
        Ok(FlashContent { number, parameters }) => {
            identity.cell = identity.cell.or(number);
            parameters.map_or(FlashState::Empty, FlashState::Valid)
        }
        Err(damage) => {
            let name = file.name();
            eprint_line(format_args!(
                "{name} is not used: {damage}; commission the cell again, or delete the file"
            ));
            FlashState::Damaged
        }
    };
    let link_ids = wires.map_or_else(PortLinkIds::default, |wires| wires.link_ids_of(cell));
    cells.add_cell(identity, &flash, file, link_ids);
    Ok(())
}
