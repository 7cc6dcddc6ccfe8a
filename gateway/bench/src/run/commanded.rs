//! Commands to a run from another process: checked, carried out, noted, and answered with the state of the bench.

use std::collections::BTreeMap;
use std::io;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use protocol::bus::BusKind;
use protocol::skin::{Cell, Skin};
use thiserror::Error;
use vcan_setup::link::Kind;
use vcan_setup::netlink::Netlink;

use super::Options;
use super::bench::{Bench, BusLink};
use super::launch::{LaunchError, program};
use super::measured::Measured;
use super::progress::Progress;
use super::served::ServedBus;
use crate::remote::{Answer, BusState, Command, Lines, LinkDown, Phase, ProcessState, State};
use model::scenario::ProcessAction;

/// Commands that are carried out at once, so that stimuli are not late.
const AT_ONCE: usize = 4;
/// From one state to the next.
const EVERY: Duration = Duration::from_millis(200);
/// Answers that are kept.
const ANSWERS: usize = 8;

/// Who commands a run, and what it was answered.
#[derive(Debug)]
pub(super) struct Remote {
    lines: Lines,
    answers: Vec<Answer>,
    /// How many answers there were.
    count: u64,
    due: Instant,
}

/// Buses that commands have taken down. They outlive the remote, since only a bus itself shows that it works again.
#[derive(Debug, Default)]
pub(super) struct SwitchedBuses(BTreeMap<usize, Switched>);

/// A bus that a command has taken down.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Switched {
    /// It stays down.
    Down,
    /// It was taken up, or is left to come back, when it had taken so many of this run's commands.
    Up { commands: u64 },
}

impl SwitchedBuses {
    /// Whether a bus is to stay down.
    pub(super) fn is_down(&self, bus: usize) -> bool {
        self.0.get(&bus) == Some(&Switched::Down)
    }

    /// Whether the loss of a bus is due to a command, and no reason to end: it is down, or has not worked since it was
    /// taken up.
    pub(super) fn is_expected(&self, bus: usize) -> bool {
        self.0.contains_key(&bus)
    }

    /// Checks that a command may take a bus down, or up.
    ///
    /// # Errors
    /// When it is so already, or about to be.
    fn check(&self, down: bool, bus: usize) -> Result<(), Refused> {
        match (down, self.0.get(&bus)) {
            (true, Some(Switched::Down)) => Err(Refused::Already("up")),
            (false, Some(Switched::Up { .. })) => Err(Refused::ComesUp),
            (false, None) => Err(Refused::Already("down")),
            (true, Some(Switched::Up { .. }) | None) | (false, Some(Switched::Down)) => Ok(()),
        }
    }

    /// Takes in that a bus was switched, when it had taken so many commands.
    fn switched(&mut self, down: bool, bus: usize, commands: u64) {
        self.0.insert(bus, if down { Switched::Down } else { Switched::Up { commands } });
    }

    /// Leaves the buses that are down to come back, since nobody will take them up; `commands` is how many each has taken.
    fn release(&mut self, commands: impl Fn(usize) -> u64) {
        for (bus, switched) in self.0.iter_mut().filter(|(_, switched)| **switched == Switched::Down) {
            *switched = Switched::Up { commands: commands(*bus) };
        }
    }

    /// Forgets the buses that have come up: which are there, and have taken a command since. Until its receiver has noticed
    /// that a bus was away, and has opened it again, it takes none.
    fn settle(&mut self, taken: impl Fn(usize) -> Option<u64>) {
        self.0.retain(|bus, switched| match switched {
            Switched::Down => true,
            Switched::Up { commands } => taken(*bus).is_none_or(|taken| taken <= *commands),
        });
    }
}

/// Why a command is not carried out.
#[derive(Debug, Error)]
enum Refused {
    #[error("the skin has no such bus")]
    NoBus,
    #[error("the skin has no such cell")]
    NoCell,
    #[error("this run has started no process of it")]
    NoProcess,
    #[error("its process is {}", match .0 { Phase::Running => "running", Phase::Stopped => "stopped", Phase::Ended => "ended: restart starts it again" })]
    Phase(Phase),
    #[error("the skin has no wire between them")]
    NoWire,
    #[error("cells of this bus answer with their own torques: no link carries anything")]
    NoLinks,
    #[error("it is not {0} by a command")]
    Already(&'static str),
    #[error("it was taken up, and does not work yet")]
    ComesUp,
    #[error("another program serves it: end that one")]
    NotServed,
    #[error("it is no virtual interface: only vcan, vxcan and embedded buses are taken down here")]
    NotVirtual,
    #[error("there is no such interface")]
    NoInterface,
    #[error(
        "{source}; a run that may not do it needs CAP_NET_ADMIN, or `sudo ip link set {name} {state}` does it"
    )]
    Interface { name: String, state: &'static str, source: io::Error },
    #[error(transparent)]
    Launch(#[from] LaunchError),
}

impl Remote {
    pub(super) fn new(lines: Lines) -> Self {
        Self { lines, answers: Vec::new(), count: 0, due: Instant::now() }
    }

    fn answer(&mut self, done: bool, text: String) {
        self.count += 1;
        if self.answers.len() >= ANSWERS {
            self.answers.remove(0);
        }
        self.answers.push(Answer { number: self.count, done, text });
        self.due = Instant::now();
    }
}

impl Bench<'_> {
    /// Carries out the commands that have come, and sends the state when it is time. With its other side a remote ends, and
    /// buses that it has taken down come back.
    pub(super) fn obey(&mut self, measured: &Measured, progress: &Progress) {
        let links = &self.bus_links;
        self.commanded.settle(|bus| {
            let link = &links.get(bus)?.link;
            (!link.is_gone()).then(|| link.state.commands.load(Ordering::Relaxed))
        });
        let Some(mut remote) = self.remote.take() else { return };
        if remote.lines.has_ended() {
            self.commanded.release(|bus| commands(links, bus));
            // At the end of the run it may end first.
            if !self.signalled.load(Ordering::Relaxed) {
                progress.error(
                    "--view: the process that served the page has ended; the run goes on without a page",
                );
            }
            return;
        }
        for _ in 0..AT_ONCE {
            let Some(command) = remote.lines.receive() else { break };
            let what = self.words(command);
            match self.carry_out(command) {
                Ok(()) => {
                    let note = format!("view: {what}");
                    progress.note(&note);
                    self.recorder.iter().for_each(|recorder| recorder.note(&note));
                    remote.answer(true, what);
                }
                Err(why) => remote.answer(false, format!("{what}: {why}")),
            }
        }
        let now = Instant::now();
        if now >= remote.due {
            remote.due = now + EVERY;
            let state = self.state(&remote, measured);
            remote.lines.send(&state);
        }
        self.remote = Some(remote);
    }

    /// A command as text.
    fn words(&self, command: Command) -> String {
        let switched = |down: bool| if down { "down" } else { "up" };
        match command {
            Command::Process { action, bus, node } => {
                let (action, name) = (action.name(), self.name(bus));
                match self.process(bus, node).map(|process| process.nodes) {
                    Some((first, last)) if first != last => {
                        format!("{action} cells {first} to {last} on {name}")
                    }
                    Some(_) | None => format!("{action} cell {node} on {name}"),
                }
            }
            Command::Link { down, bus, nodes: [one, other] } => {
                format!("link {} between cell {one} and cell {other} on {}", switched(down), self.name(bus))
            }
            Command::Bus { down, bus } => format!("bus {} {}", self.name(bus), switched(down)),
        }
    }

    fn carry_out(&mut self, command: Command) -> Result<(), Refused> {
        match command {
            Command::Process { action, bus, node } => self.act(action, bus, node),
            Command::Link { down, bus, nodes } => self.command_link(down, bus, nodes),
            Command::Bus { down, bus } => {
                self.commanded.check(down, bus)?;
                self.switch_bus(down, bus)?;
                self.commanded.switched(down, bus, commands(&self.bus_links, bus));
                Ok(())
            }
        }
    }

    /// The process of a cell.
    fn process(&self, bus: usize, node: u8) -> Option<ProcessState> {
        self.processes.states().find(|process| process.runs(bus, node))
    }

    fn act(&mut self, action: ProcessAction, bus: usize, node: u8) -> Result<(), Refused> {
        cell(&self.options.skin, bus, node)?;
        let phase = self.process(bus, node).ok_or(Refused::NoProcess)?.phase;
        match (action, phase) {
            (ProcessAction::Restart, _)
            | (ProcessAction::Kill, Phase::Running | Phase::Stopped)
            | (ProcessAction::Stop, Phase::Running)
            | (ProcessAction::Continue, Phase::Stopped) => {}
            (_, phase) => return Err(Refused::Phase(phase)),
        }
        self.processes.act(bus, node, action)?;
        Ok(())
    }

    fn command_link(&mut self, down: bool, bus: usize, [one, other]: [u8; 2]) -> Result<(), Refused> {
        let skin = &self.options.skin;
        let (one, other) = (cell(skin, bus, one)?, cell(skin, bus, other)?);
        if !one.neighbors.contains(&Some(other.node)) {
            return Err(Refused::NoWire);
        }
        let network = self.bus_links.get_mut(bus).and_then(|bus_link| bus_link.network.as_mut());
        let network = network.ok_or(Refused::NoLinks)?;
        network.set_link_down(down, one.node, other.node);
        network.set_link_down(down, other.node, one.node);
        Ok(())
    }

    fn switch_bus(&mut self, down: bool, bus: usize) -> Result<(), Refused> {
        let link = &self.bus_links.get(bus).ok_or(Refused::NoBus)?.link;
        match link.kind {
            BusKind::Embedded => {
                let served = self.served.iter_mut().find(|served| served.bus() == link.name);
                let served = served.ok_or(Refused::NotServed)?;
                if down {
                    served.end();
                } else {
                    *served = serve(self.options, &link.name)?;
                }
                Ok(())
            }
            BusKind::SocketCan => switch_interface(&link.name, down),
        }
    }

    fn state(&self, remote: &Remote, measured: &Measured) -> State {
        let networks = self.bus_links.iter().enumerate();
        let networks = networks.filter_map(|(bus, bus_link)| Some((bus, bus_link.network.as_ref()?)));
        let links_down = networks.flat_map(|(bus, network)| {
            let pairs = network.links_down().into_iter();
            pairs.map(move |[one, other]| LinkDown { bus, nodes: [one.get(), other.get()] })
        });
        let buses = self.bus_links.iter().enumerate().map(|(bus, bus_link)| BusState {
            down: self.commanded.is_expected(bus),
            links: bus_link.network.is_some(),
        });
        State {
            processes: self.processes.states().collect(),
            links_down: links_down.collect(),
            buses: buses.collect(),
            lateness: measured.lateness,
            halted: measured.halts.why().map(str::to_owned),
            answers: remote.answers.clone(),
        }
    }
}

/// How many commands a bus has taken.
fn commands(links: &[BusLink], bus: usize) -> u64 {
    links.get(bus).map_or(0, |bus_link| bus_link.link.state.commands.load(Ordering::Relaxed))
}

/// Serves an embedded bus.
pub(super) fn serve(options: &Options, bus: &str) -> Result<ServedBus, LaunchError> {
    let program = program("vcan-setup")?;
    ServedBus::start(&program, bus, options.directory.as_deref())
}

/// A cell of the skin.
fn cell(skin: &Skin, bus: usize, node: u8) -> Result<&Cell, Refused> {
    if bus >= skin.buses.len() {
        return Err(Refused::NoBus);
    }
    skin.cells.iter().find(|cell| cell.bus == bus && cell.node.get() == node).ok_or(Refused::NoCell)
}

/// Brings an interface of the kernel down, or up again.
fn switch_interface(name: &str, down: bool) -> Result<(), Refused> {
    let state = if down { "down" } else { "up" };
    let failed = |source| Refused::Interface { name: name.to_owned(), state, source };
    let mut netlink = Netlink::open().map_err(failed)?;
    let interfaces = netlink.interfaces().map_err(failed)?;
    let interface = interfaces.into_iter().find(|interface| interface.name == name);
    let interface = interface.ok_or(Refused::NoInterface)?;
    match interface.kind {
        Kind::Vcan | Kind::Vxcan(_) => netlink.set_up(interface.index, !down).map_err(failed),
        Kind::Hardware(_) | Kind::Other(_) => Err(Refused::NotVirtual),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_virtual_interfaces_are_taken_down() {
        assert!(matches!(switch_interface("lo", true), Err(Refused::NotVirtual)));
        assert!(matches!(switch_interface("no-such-one", true), Err(Refused::NoInterface)));
    }

    #[test]
    fn a_refusal_says_why_in_one_line() {
        let source = io::Error::from_raw_os_error(1);
        let refused = Refused::Interface { name: "vcan0".to_owned(), state: "down", source };
        let why = "Operation not permitted (os error 1); a run that may not do it needs CAP_NET_ADMIN, or `sudo ip \
                   link set vcan0 down` does it";
        assert_eq!(refused.to_string(), why);
    }

    #[test]
    fn a_bus_that_was_taken_up_is_expected_until_it_has_worked() {
        let mut buses = SwitchedBuses::default();
        assert!(matches!(buses.check(false, 0), Err(Refused::Already("down"))));
        buses.check(true, 0).unwrap();
        buses.switched(true, 0, 100);
        assert!(matches!(buses.check(true, 0), Err(Refused::Already("up"))));
        buses.settle(|_| Some(105));
        assert!(buses.is_down(0) && buses.is_expected(0), "what works there is of before");
        // Down and up at once: the receiver has not noticed anything yet.
        buses.check(false, 0).unwrap();
        buses.switched(false, 0, 105);
        buses.settle(|_| Some(105));
        assert!(!buses.is_down(0) && buses.is_expected(0));
        assert!(matches!(buses.check(false, 0), Err(Refused::ComesUp)));
        buses.settle(|_| None);
        assert!(buses.is_expected(0), "the receiver has noticed it");
        // Again, before it has worked.
        buses.check(true, 0).unwrap();
        buses.switched(true, 0, 105);
        buses.switched(false, 0, 105);
        buses.settle(|_| Some(105));
        assert!(buses.is_expected(0) && !buses.is_expected(1));
        buses.settle(|_| Some(106));
        assert!(!buses.is_expected(0), "it works: its next loss is one");
    }

    #[test]
    fn buses_that_a_remote_had_down_come_back_without_it() {
        let mut buses = SwitchedBuses::default();
        buses.switched(true, 0, 7);
        buses.switched(false, 1, 7);
        buses.release(|_| 9);
        assert!(!buses.is_down(0) && buses.is_expected(0) && buses.is_expected(1));
        buses.settle(|_| Some(9));
        assert!(buses.is_expected(0) && !buses.is_expected(1));
        buses.settle(|_| Some(10));
        assert!(!buses.is_expected(0));
    }

    #[test]
    fn cells_are_those_of_the_skin() {
        let skin = Skin::parse("skin.toml", model::testing::SKIN).unwrap();
        assert_eq!(cell(&skin, 0, 1).unwrap().node.get(), 1);
        assert!(matches!(cell(&skin, 0, 200), Err(Refused::NoCell)));
        assert!(matches!(cell(&skin, usize::MAX, 1), Err(Refused::NoBus)));
    }
}
