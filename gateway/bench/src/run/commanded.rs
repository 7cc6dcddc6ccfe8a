//! Commands to a run from another process: checked, carried out, noted, and answered with the state of the bench.

use std::mem;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use protocol::skin::{Cell, Skin};
use vcan_setup::link::InterfaceKind;
use vcan_setup::netlink::Netlink;

use super::RunOptions;
use super::bench::{Bench, RunBus};
use super::commander::{CommandError, RemoteControl};
use super::measured::LoopTotals;
use crate::bus::served::ServedBus;
use crate::processes::{LaunchError, program_path};
use crate::progress::Progress;
use crate::remote::{BenchCommand, BenchState, BusStatus, DownLink, Phase, ProcessState};
use model::scenario::ProcessAction;

/// Maximum number of commands carried out in one round, so that stimuli are not delayed.
const MAX_COMMANDS_PER_ROUND: usize = 4;
/// Interval between two states sent to the other side.
const STATE_SEND_INTERVAL: Duration = Duration::from_millis(200);

impl Bench<'_> {
    /// Carries out received commands, and sends the state if the interval is over. If the other side has ended, ends
    /// its remote control, and without any remote control brings back the buses that commands have taken down.
    pub(super) fn handle_remote_commands(&mut self, measured: &LoopTotals, progress: &Progress) {
        let links = &self.bus_links;
        self.commanded.forget_working_buses(|bus| {
            let link = &links.get(bus)?.link;
            (!link.is_gone()).then(|| link.state.commands.load(Ordering::Relaxed))
        });
        for control in mem::take(&mut self.remotes) {
            let kept = self.handle_remote(control, measured, progress);
            self.remotes.extend(kept);
        }
        if self.remotes.is_empty() {
            let links = &self.bus_links;
            self.commanded.release_down_buses(|bus| commands_sent(links, bus));
        }
    }

    /// Carries out the commands of one remote control. Returns `None` if its other side has ended.
    fn handle_remote(
        &mut self,
        mut control: RemoteControl,
        measured: &LoopTotals,
        progress: &Progress,
    ) -> Option<RemoteControl> {
        if control.remote.lines.has_ended() {
            self.is_end_requested |= control.remote.ends_run;
            // At the end of the run the other side may end first.
            if !control.remote.ends_run && !self.signalled.load(Ordering::Relaxed) {
                progress.print_error(
                    "--view: the process that served the page has ended; the run continues without the page",
                );
            }
            return None;
        }
        for _ in 0..MAX_COMMANDS_PER_ROUND {
            let Some(command) = control.remote.lines.receive() else { break };
            let what = self.command_text(command);
            match self.execute_command(command) {
                Ok(()) => {
                    let note = format!("{}: {what}", control.remote.name);
                    progress.print_note(&note);
                    self.recorder.iter().for_each(|recorder| recorder.add_note(&note));
                    control.add_reply(true, what);
                }
                Err(why) => control.add_reply(false, format!("{what}: {why}")),
            }
        }
        let now = Instant::now();
        if now >= control.due {
            control.due = now + STATE_SEND_INTERVAL;
            let state = self.bench_state(&control, measured);
            control.remote.lines.send(&state);
        }
        Some(control)
    }

    /// Describes a command in words.
    fn command_text(&self, command: BenchCommand) -> String {
        let switched = |down: bool| if down { "down" } else { "up" };
        match command {
            BenchCommand::Process { action, bus, node } => {
                let (action, name) = (action.name(), self.bus_name(bus));
                match self.cell_process(bus, node).map(|process| process.nodes) {
                    Some((first, last)) if first != last => {
                        format!("{action} cells {first} to {last} on {name}")
                    }
                    Some(_) | None => format!("{action} cell {node} on {name}"),
                }
            }
            BenchCommand::Link { down, bus, nodes: [one, other] } => {
                format!(
                    "link {} between cell {one} and cell {other} on {}",
                    switched(down),
                    self.bus_name(bus)
                )
            }
            BenchCommand::Bus { down, bus } => format!("bus {} {}", self.bus_name(bus), switched(down)),
            BenchCommand::End => "end the run".to_owned(),
        }
    }

    fn execute_command(&mut self, command: BenchCommand) -> Result<(), CommandError> {
        match command {
            BenchCommand::Process { action, bus, node } => self.control_process(action, bus, node),
            BenchCommand::Link { down, bus, nodes } => self.switch_wire_links(down, bus, nodes),
            BenchCommand::Bus { down, bus } => {
                self.commanded.check_switch(down, bus)?;
                self.switch_bus(down, bus)?;
                self.commanded.note_bus_switched(down, bus, commands_sent(&self.bus_links, bus));
                Ok(())
            }
            BenchCommand::End => {
                self.is_end_requested = true;
                Ok(())
            }
        }
    }

    fn cell_process(&self, bus: usize, node: u8) -> Option<ProcessState> {
        self.processes.states().find(|process| process.runs_cell(bus, node))
    }

    fn control_process(&mut self, action: ProcessAction, bus: usize, node: u8) -> Result<(), CommandError> {
        find_cell(&self.options.skin, bus, node)?;
        let phase = self.cell_process(bus, node).ok_or(CommandError::NoProcess)?.phase;
        match (action, phase) {
            (ProcessAction::Restart, _)
            | (ProcessAction::Kill, Phase::Running | Phase::Stopped)
            | (ProcessAction::Stop, Phase::Running)
            | (ProcessAction::Continue, Phase::Stopped) => {}
            (_, phase) => return Err(CommandError::Phase(phase)),
        }
        self.processes.apply_action(bus, node, action)?;
        Ok(())
    }

    fn switch_wire_links(
        &mut self,
        down: bool,
        bus: usize,
        [one, other]: [u8; 2],
    ) -> Result<(), CommandError> {
        let skin = &self.options.skin;
        let (one, other) = (find_cell(skin, bus, one)?, find_cell(skin, bus, other)?);
        if !one.neighbors.contains(&Some(other.node)) {
            return Err(CommandError::NoWire);
        }
        let network = self.bus_links.get_mut(bus).and_then(|bus_link| bus_link.network.as_mut());
        let network = network.ok_or(CommandError::NoLinks)?;
        network.set_link_down(down, one.node, other.node);
        network.set_link_down(down, other.node, one.node);
        Ok(())
    }

    fn switch_bus(&mut self, down: bool, bus: usize) -> Result<(), CommandError> {
        let link = &self.bus_links.get(bus).ok_or(CommandError::NoBus)?.link;
        if link.kind.is_interface() {
            return switch_interface(&link.name, down);
        }
        let name = link.kind.served_name(&link.name);
        let served = self.served.iter_mut().find(|served| served.bus_name() == name);
        let served = served.ok_or(CommandError::NotServed)?;
        if down {
            served.stop();
        } else {
            *served = start_bus_server(self.options, &name)?;
        }
        Ok(())
    }

    fn bench_state(&self, control: &RemoteControl, measured: &LoopTotals) -> BenchState {
        let networks = self.bus_links.iter().enumerate();
        let networks = networks.filter_map(|(bus, bus_link)| Some((bus, bus_link.network.as_ref()?)));
        let links_down = networks.flat_map(|(bus, network)| {
            let pairs = network.links_down().into_iter();
            pairs.map(move |[one, other]| DownLink { bus, nodes: [one.get(), other.get()] })
        });
        let buses = self.bus_links.iter().enumerate().map(|(bus, bus_link)| BusStatus {
            down: self.commanded.is_loss_expected(bus),
            links: bus_link.network.is_some(),
        });
        BenchState {
            processes: self.processes.states().collect(),
            links_down: links_down.collect(),
            buses: buses.collect(),
            lateness: measured.lateness,
            halted: measured.halts.present_halt_reason().map(str::to_owned),
            answers: control.answers.clone(),
        }
    }
}

/// Returns the number of commands that this run has sent on a bus.
fn commands_sent(links: &[RunBus], bus: usize) -> u64 {
    links.get(bus).map_or(0, |bus_link| bus_link.link.state.commands.load(Ordering::Relaxed))
}

/// Starts a server for an embedded bus.
pub(super) fn start_bus_server(options: &RunOptions, bus: &str) -> Result<ServedBus, LaunchError> {
    let program = program_path("vcan-setup")?;
    let described = options.skin.buses.iter().find(|described| described.name == bus);
    let time = described.and_then(|described| options.bus_time.served_time(described));
    ServedBus::start(&program, bus, options.directory.as_deref(), time)
}

/// Finds a cell of the skin.
fn find_cell(skin: &Skin, bus: usize, node: u8) -> Result<&Cell, CommandError> {
    if bus >= skin.buses.len() {
        return Err(CommandError::NoBus);
    }
    skin.cells.iter().find(|cell| cell.bus == bus && cell.node.get() == node).ok_or(CommandError::NoCell)
}

/// Brings an interface of the kernel down, or up again.
fn switch_interface(name: &str, down: bool) -> Result<(), CommandError> {
    let state = if down { "down" } else { "up" };
    let failed = |source| CommandError::Interface { name: name.to_owned(), state, source };
    let mut netlink = Netlink::open().map_err(failed)?;
    let interfaces = netlink.interfaces().map_err(failed)?;
    let interface = interfaces.into_iter().find(|interface| interface.name == name);
    let interface = interface.ok_or(CommandError::NoInterface)?;
    match interface.kind {
        InterfaceKind::Vcan | InterfaceKind::Vxcan(_) => {
            netlink.set_interface_up(interface.index, !down).map_err(failed)
        }
        InterfaceKind::Hardware(_) | InterfaceKind::Other(_) => Err(CommandError::NotVirtual),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_virtual_interfaces_are_taken_down() {
        assert!(matches!(switch_interface("lo", true), Err(CommandError::NotVirtual)));
        assert!(matches!(switch_interface("no-such-one", true), Err(CommandError::NoInterface)));
    }

    #[test]
    fn cells_are_those_of_the_skin() {
        let skin = Skin::parse("skin.toml", model::testing::ONE_CELL_SKIN_TOML).unwrap();
        assert_eq!(find_cell(&skin, 0, 1).unwrap().node.get(), 1);
        assert!(matches!(find_cell(&skin, 0, 200), Err(CommandError::NoCell)));
        assert!(matches!(find_cell(&skin, usize::MAX, 1), Err(CommandError::NoBus)));
    }
}
