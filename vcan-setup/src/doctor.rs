//! What a bench would meet on this machine, judged.
//!
//! ```text
//!   skin or names --+
//!                   +--> look --> Facts --> judge --> findings: ok, note, fault, each with what mends it
//!   this machine ---+   (asks)            (decides)
//! ```

use std::collections::BTreeSet;
use std::path::PathBuf;

use protocol::bus::{BusKind, Choice};
use protocol::can::Format;
use protocol::id::CellId;

use crate::kernel::{Kernel, Module};
use crate::link::{FD_MTU, Hardware, Interface, Kind, State};
use crate::plan::{SkinBus, Wanted, agrees, set_rates, wanted_rates};

/// What one frame takes in a receive buffer, as the kernel counts it.
const FRAME: usize = 1_024;
/// How many times an answer of every cell should fit into a receive buffer.
const TIMES: usize = 4;

/// All that the judgement rests on.
#[derive(Clone, Debug)]
pub struct Facts {
    /// Which kind of bus is wanted.
    pub choice: Choice,
    /// Whether the cells are there already, as `gateway run --no-spawn` has it.
    pub no_spawn: bool,
    /// How this program is called so that `sudo` finds it.
    pub program: String,
    /// The kernel.
    pub kernel: Kernel,
    /// Who asks.
    pub user: User,
    /// Bytes of a receive buffer that the kernel grants to whom asks as the gateway does.
    pub receive_buffer: Option<usize>,
    /// Frames that may wait in the kernel until they are handed on; `None` when it does not say.
    pub backlog: Option<usize>,
    /// The program of the cells.
    pub cell_node: Program,
    /// Where the embedded buses of this user are, or why none can be used.
    pub embedded: Result<PathBuf, String>,
    /// The buses that were asked about.
    pub buses: Vec<Bus>,
    /// The CAN interfaces that there are.
    pub present: Vec<Interface>,
}

/// Who asks.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct User {
    /// Whether it is root.
    pub root: bool,
    /// Whether it may make interfaces (`CAP_NET_ADMIN`).
    pub admin: bool,
}

/// A program that a bench needs.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Program {
    /// Where it should be.
    pub path: PathBuf,
    /// Whether it is there.
    pub there: bool,
}

/// A bus that was asked about.
#[derive(Clone, Debug)]
pub struct Bus {
    /// What is wanted of it.
    pub wanted: Wanted,
    /// Its cells; `None` when no skin says.
    pub cells: Option<BTreeSet<CellId>>,
    /// Whether its cells are to answer with sums.
    pub sums: bool,
    /// The interface of its name.
    pub interface: Option<Interface>,
    /// What was heard on it; `None` when it was not opened, or why it could not be.
    pub heard: Result<Option<Heard>, String>,
}

/// What was heard on a bus.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Heard {
    /// Whether another gateway sends on it.
    pub gateway: bool,
    /// Which cells do.
    pub cells: BTreeSet<CellId>,
}

/// How much a finding matters.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum Level {
    /// As it should be.
    Ok,
    /// A bench runs, and somebody should know this.
    Note,
    /// No bench runs, or none whose figures mean anything.
    Fault,
}

impl Level {
    /// The level's name, as it is printed.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Note => "note",
            Self::Fault => "fault",
        }
    }
}

/// One thing that was found.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Finding {
    /// How much it matters.
    pub level: Level,
    /// What it is.
    pub text: String,
    /// What mends it: one command each, any of them does.
    pub remedies: Vec<String>,
}

impl Finding {
    fn ok(text: impl Into<String>) -> Self {
        Self { level: Level::Ok, text: text.into(), remedies: Vec::new() }
    }

    fn note(text: impl Into<String>, remedies: impl IntoIterator<Item = String>) -> Self {
        Self { level: Level::Note, text: text.into(), remedies: remedies.into_iter().collect() }
    }

    fn fault(text: impl Into<String>, remedies: impl IntoIterator<Item = String>) -> Self {
        Self { level: Level::Fault, text: text.into(), remedies: remedies.into_iter().collect() }
    }
}

/// Whether a bench would run: nothing that was found is a fault.
#[must_use]
pub fn would_run(findings: &[Finding]) -> bool {
    findings.iter().all(|finding| finding.level != Level::Fault)
}

/// Judges the facts, the most basic ones first.
#[must_use]
pub fn judge(facts: &Facts) -> Vec<Finding> {
    let mut findings = vec![facts.kind()];
    match facts.bus_kind() {
        BusKind::SocketCan if facts.kernel.has_can => {
            findings.extend(facts.making());
            findings.extend(facts.buses.iter().flat_map(|bus| facts.interface(bus)));
            findings.extend(facts.any_interface());
            findings.extend(facts.receive_buffer());
            findings.extend(facts.backlog());
        }
        // Without CAN in the kernel nothing more can be said of interfaces.
        BusKind::SocketCan => {}
        BusKind::Embedded => {
            findings.push(facts.embedded());
            findings.extend(facts.buses.iter().flat_map(|bus| facts.traffic(bus, "the embedded bus")));
        }
    }
    findings.extend(facts.skin());
    findings.extend(facts.cell_node());
    findings
}

impl Facts {
    /// The kind of bus that a bench would use.
    #[must_use]
    pub const fn bus_kind(&self) -> BusKind {
        match self.choice {
            Choice::Only(kind) => kind,
            Choice::Auto if self.kernel.has_can => BusKind::SocketCan,
            Choice::Auto => BusKind::Embedded,
        }
    }

    /// A command of this program, as root.
    fn own(&self, command: &str) -> String {
        self.sudo(&format!("{} {command}", self.program))
    }

    fn sudo(&self, command: &str) -> String {
        if self.user.admin || self.user.root { command.to_owned() } else { format!("sudo {command}") }
    }

    /// What `vcan-setup up` is told to mean a bus: its skin, or its name.
    fn up(&self, wanted: &Wanted) -> String {
        let what = wanted.skin.as_ref().map_or(&wanted.name, |skin| &skin.file);
        self.own(&format!("up {what}"))
    }

    fn kind(&self) -> Finding {
        let Kernel { release, has_can, can_raw, .. } = &self.kernel;
        let remedies = || self.kernel.remedies(*can_raw);
        match (self.choice, has_can) {
            (Choice::Only(BusKind::Embedded), _) => {
                Finding::ok("the embedded bus was chosen, which needs nothing of the kernel")
            }
            (Choice::Auto | Choice::Only(BusKind::SocketCan), true) => {
                Finding::ok(format!("the kernel ({release}) has CAN"))
            }
            (Choice::Auto, false) => Finding::note(
                format!(
                    "the kernel ({release}) has no CAN, so the bench runs on the embedded bus: no candump, no \
                     real cell; for a kernel with CAN:"
                ),
                remedies(),
            ),
            (Choice::Only(BusKind::SocketCan), false) => Finding::fault(
                format!("the kernel ({release}) has no CAN, and --bus-kind socketcan needs it"),
                remedies()
                    .into_iter()
                    .chain(["# leave out --bus-kind socketcan: the bench then runs on the embedded bus"
                        .to_owned()]),
            ),
        }
    }

    /// Whether interfaces that are missing can be made.
    fn making(&self) -> Vec<Finding> {
        let missing = |bus: &&Bus| bus.interface.is_none() && !bus.wanted.is_hardware();
        let mut findings = Vec::new();
        if self.buses.iter().find(missing).is_none() && !(self.buses.is_empty() && self.present.is_empty()) {
            return findings;
        }
        match self.kernel.vcan {
            Module::There => {}
            Module::Unknown => findings.push(Finding::note(
                "whether the kernel has vcan is not to be seen; should it have none:",
                self.kernel.remedies(Module::Unknown),
            )),
            Module::Loadable => findings.push(Finding::note(
                "the kernel's module vcan is not loaded; making an interface loads it",
                [self.sudo("modprobe vcan")],
            )),
            Module::Missing => findings.push(Finding::fault(
                format!("the kernel ({}) has CAN and no vcan", self.kernel.release),
                self.kernel.remedies(Module::Missing),
            )),
        }
        match self.user {
            User { admin: true, .. } => {}
            User { root: false, .. } => {
                findings.push(Finding::note("this user may not make interfaces, hence the sudo below", []));
            }
            User { root: true, .. } => findings.push(Finding::fault(
                "root may not make interfaces here: it has no CAP_NET_ADMIN, as in most containers",
                ["docker run --cap-add NET_ADMIN ...  # or make the interface outside, in this network"
                    .to_owned()],
            )),
        }
        findings
    }

    /// Without buses that were asked about: whether there is any that could be used.
    fn any_interface(&self) -> Option<Finding> {
        if !self.buses.is_empty() {
            return None;
        }
        let up = self.present.iter().filter(|interface| interface.up);
        Some(match up.max_by_key(|interface| interface.mtu >= FD_MTU) {
            Some(Interface { name, mtu, .. }) => {
                Finding::ok(format!("{name} is up and carries {}", carries(*mtu)))
            }
            None => Finding::fault("no CAN interface is up", [self.own("up vcan0")]),
        })
    }

    fn interface(&self, bus: &Bus) -> Vec<Finding> {
        let name = &bus.wanted.name;
        let Some(interface) = &bus.interface else {
            return vec![if bus.wanted.is_hardware() {
                Finding::fault(
                    format!(
                        "there is no interface {name}, and the skin gives it a bitrate, so it is hardware"
                    ),
                    [
                        "# plug it in and load its driver; `vcan-setup status` shows when it is there"
                            .to_owned(),
                        format!("{}  # once bitrate is taken out of the skin: a vcan", self.up(&bus.wanted)),
                    ],
                )
            } else {
                Finding::fault(format!("there is no interface {name}"), [self.up(&bus.wanted)])
            }];
        };
        let mut findings = match &interface.kind {
            Kind::Other(what) => {
                return vec![Finding::fault(
                    format!("{name} is {what}, which carries no CAN"),
                    ["# name another bus".to_owned()],
                )];
            }
            Kind::Vcan | Kind::Vxcan(_) => self.virtual_faults(bus, interface),
            Kind::Hardware(hardware) => self.hardware_faults(bus, interface, hardware),
        };
        if would_run(&findings) {
            let what = interface.what();
            findings.insert(
                0,
                Finding::ok(format!("{name} is {what}, up, and carries {}", carries(interface.mtu))),
            );
            findings.extend(self.traffic(bus, name));
        }
        findings
    }

    fn virtual_faults(&self, bus: &Bus, interface: &Interface) -> Vec<Finding> {
        let Interface { name, mtu, ours, up, .. } = interface;
        let mend = |command: String| {
            let command = if self.user.admin { command } else { format!("sudo sh -c '{command}'") };
            [if *ours { self.up(&bus.wanted) } else { command }]
        };
        if !bus.wanted.carried_by(*mtu) {
            return vec![Finding::fault(
                format!("{name} has MTU {mtu} and CAN FD needs {FD_MTU}"),
                mend(format!("ip link set {name} down && ip link set {name} mtu {FD_MTU} up")),
            )];
        }
        if !up {
            let fault = Finding::fault(format!("{name} is down"), mend(format!("ip link set {name} up")));
            return vec![fault];
        }
        Vec::new()
    }

    fn hardware_faults(&self, bus: &Bus, interface: &Interface, hardware: &Hardware) -> Vec<Finding> {
        let Interface { name, mtu, up, .. } = interface;
        let what = interface.what();
        let skin = bus.wanted.skin.as_ref();
        // What sets the bit rates, or would if they were known.
        let set = || match skin {
            Some(SkinBus { file, bitrate: Some(_), .. }) => self.own(&format!("up {file} --set-bit-rates")),
            Some(_) | None => {
                let rates = match bus.wanted.format {
                    Format::Fd => "bitrate 1000000 dbitrate 5000000 fd on",
                    Format::Classic => "bitrate 1000000",
                };
                self.sudo(&format!(
                    "sh -c 'ip link set {name} down; ip link set {name} up type can {rates}'  # or the rates of your bus"
                ))
            }
        };
        let mut findings = Vec::new();
        if let Some(skin) = skin.filter(|skin| !agrees(skin, hardware)) {
            let (has, wants) = (set_rates(hardware), wanted_rates(skin));
            let text = format!("{name} is {what} at {has}, and the skin says {wants}");
            findings.push(Finding::fault(text, [set()]));
        } else if !bus.wanted.carried_by(*mtu) {
            let text = format!("{name} is {what} with MTU {mtu}, and CAN FD needs {FD_MTU}");
            findings.push(Finding::fault(text, [set(), "format = \"classic\"  # in the skin".to_owned()]));
        } else if !up {
            findings.push(Finding::fault(format!("{name} is {what}, and down"), [set()]));
        }
        if hardware.listen_only {
            findings.push(Finding::fault(
                format!("{name} only listens: it can neither send nor acknowledge"),
                [self.sudo(&format!(
                    "sh -c 'ip link set {name} down; ip link set {name} up type can listen-only off'"
                ))],
            ));
        }
        match hardware.state.filter(|_| *up) {
            Some(State::BusOff) => findings.push(Finding::fault(
                format!("{name} is BUS-OFF: after too many errors it takes no part any more; wiring, termination or bit rates are wrong"),
                [self.sudo(&format!("ip link set {name} type can restart"))],
            )),
            Some(state @ (State::ErrorPassive | State::ErrorWarning)) => findings.push(Finding::note(
                format!("{name} is {}: it sees errors; is anybody else on the bus, terminated, at the same bit rates?", state.name()),
                [format!("ip -details -statistics link show {name}")],
            )),
            Some(State::ErrorActive | State::Stopped | State::Sleeping) | None => {}
        }
        if would_run(&findings) && skin.is_some_and(|skin| skin.bitrate.is_some()) {
            findings.push(Finding::ok(format!("{name} is at {}, as the skin says", set_rates(hardware))));
        } else if would_run(&findings) && skin.is_none() {
            findings.push(Finding::ok(format!("{name} is at {}", set_rates(hardware))));
        } else if would_run(&findings) {
            findings.push(Finding::note(
                format!("{name} is at {}; the skin does not say whether that is right", set_rates(hardware)),
                ["bitrate = ...  # under its [[bus]] in the skin".to_owned()],
            ));
        }
        findings
    }

    /// Who is on a bus already.
    fn traffic(&self, bus: &Bus, on: &str) -> Vec<Finding> {
        let name = &bus.wanted.name;
        let heard = match &bus.heard {
            Ok(Some(heard)) => heard,
            Ok(None) => return Vec::new(),
            Err(why) => return vec![Finding::fault(why.clone(), [])],
        };
        let mut findings = Vec::new();
        let on = if on == name { String::new() } else { format!("{on} ") };
        if heard.gateway {
            findings.push(Finding::fault(
                format!("another gateway sends joints on {on}{name}"),
                ["pgrep -a gateway  # and stop it, or take another bus".to_owned()],
            ));
        }
        let count = heard.cells.len();
        match (self.no_spawn, count) {
            (false, 0) | (true, 1..) => {}
            (false, _) => findings.push(Finding::fault(
                format!("cells are on {on}{name} already: {}", nodes(&heard.cells)),
                ["gateway run ... --no-spawn  # and doctor ... --no-spawn, to use them; or stop them"
                    .to_owned()],
            )),
            (true, 0) => findings.push(Finding::fault(
                format!("no cell is heard on {on}{name}, and with --no-spawn they have to be there"),
                [format!(
                    "cell-node --bus {name} --nodes 1-... --skin SKIN.toml &  # or leave out --no-spawn"
                )],
            )),
        }
        if self.no_spawn && count > 0 {
            let absent: BTreeSet<_> =
                bus.cells.iter().flat_map(|cells| cells.difference(&heard.cells)).copied().collect();
            findings.push(if absent.is_empty() {
                Finding::ok(format!("{count} cells are on {on}{name}"))
            } else {
                Finding::note(
                    format!(
                        "{count} cells are on {on}{name}; of the skin's these were not heard: {}",
                        nodes(&absent)
                    ),
                    [],
                )
            });
        }
        findings
    }

    /// Whether a burst of answers fits into a socket.
    fn receive_buffer(&self) -> Option<Finding> {
        let granted = self.receive_buffer?;
        let most = self.buses.iter().map(|bus| match &bus.cells {
            Some(cells) => cells.len() * frames_of(&bus.wanted),
            None => usize::from(CellId::MAX.get()),
        });
        let frames = most.max().unwrap_or_else(|| usize::from(CellId::MAX.get()));
        let (once, needed) = (frames * FRAME, TIMES * frames * FRAME);
        let (has, wants) = (granted >> 10, needed >> 10);
        let remedy = || [self.sudo(&format!("sysctl -w net.core.rmem_max={needed}"))];
        Some(if granted >= needed {
            Finding::ok(format!(
                "receive buffers of {has} KiB hold all answers, {frames} frames, {TIMES} times over"
            ))
        } else if granted >= once {
            Finding::note(
                format!(
                    "receive buffers are limited to {has} KiB; to hold all answers, {frames} frames, {TIMES} times over takes {wants} KiB, and a gateway that is held up loses some"
                ),
                remedy(),
            )
        } else {
            Finding::fault(
                format!(
                    "receive buffers are limited to {has} KiB and do not hold all answers, {frames} frames, even once; {wants} KiB are right"
                ),
                remedy(),
            )
        })
    }

    /// Whether one answer of every cell fits into the kernel's queue between sender and receiver.
    fn backlog(&self) -> Option<Finding> {
        let frames: usize = self
            .buses
            .iter()
            .map(|bus| bus.cells.as_ref().map_or(0, BTreeSet::len) * frames_of(&bus.wanted))
            .sum();
        if frames == 0 {
            return None;
        }
        let Some(backlog) = self.backlog else {
            return Some(Finding::note(
                "the kernel's backlog cannot be seen from this network namespace",
                ["sysctl net.core.netdev_max_backlog  # in the first one".to_owned()],
            ));
        };
        Some(if backlog >= frames {
            Finding::ok(format!(
                "the kernel's backlog of {backlog} holds an answer of all cells, {frames} frames"
            ))
        } else {
            Finding::fault(
                format!(
                    "the kernel's backlog of {backlog} does not hold an answer of all cells, {frames} frames: some would be lost without a word"
                ),
                [self.sudo(&format!("sysctl -w net.core.netdev_max_backlog={}", 2 * frames))],
            )
        })
    }

    fn embedded(&self) -> Finding {
        match &self.embedded {
            Ok(directory) => Finding::ok(format!("embedded buses can be served in {}", directory.display())),
            Err(why) => Finding::fault(why.clone(), []),
        }
    }

    /// What the skin says and the gateway cannot do.
    fn skin(&self) -> Vec<Finding> {
        let sums = self.buses.iter().filter(|bus| bus.sums).map(|bus| &bus.wanted.name);
        let fault = |name| {
            Finding::fault(
                format!("bus {name} has reply = \"sum\", which this version cannot run"),
                ["reply = \"torque\"  # in the skin".to_owned()],
            )
        };
        sums.map(fault).collect()
    }

    fn cell_node(&self) -> Option<Finding> {
        let Program { path, there } = &self.cell_node;
        match (self.no_spawn, there) {
            (true, _) => None,
            (false, true) => Some(Finding::ok("cell-node is beside vcan-setup")),
            (false, false) => Some(Finding::fault(
                format!("cell-node is not at {}: the gateway starts it from beside itself", path.display()),
                ["cargo build --release  # in the project's folder; or name it with gateway run --cell-node"
                    .to_owned()],
            )),
        }
    }
}

/// What an interface of this MTU carries.
const fn carries(mtu: u32) -> &'static str {
    if mtu >= FD_MTU { "CAN FD" } else { "classic CAN" }
}

/// Frames that a packet takes.
const fn frames_of(wanted: &Wanted) -> usize {
    match wanted.format {
        Format::Fd => 1,
        Format::Classic => 2,
    }
}

/// Some nodes, for people: `1, 2, 5`.
fn nodes(cells: &BTreeSet<CellId>) -> String {
    let first: Vec<_> = cells.iter().take(12).map(ToString::to_string).collect();
    let more = if cells.len() > first.len() {
        format!(" and {} more", cells.len() - first.len())
    } else {
        String::new()
    };
    first.join(", ") + &more
}

#[cfg(test)]
mod tests;
