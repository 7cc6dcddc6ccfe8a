//! What is wrong with interfaces, and what mends it.

use protocol::can::Format;

use super::{Bus, Facts, Finding, User, would_run};
use crate::kernel::Module;
use crate::link::{FD_MTU, Hardware, Interface, Kind, State};
use crate::plan::widen;

impl Facts {
    /// Whether interfaces that are missing can be made.
    pub(super) fn making(&self) -> Vec<Finding> {
        let missing = |bus: &&Bus| bus.interface.is_none() && bus.wanted.hardware().is_none();
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
    pub(super) fn any_interface(&self) -> Option<Finding> {
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

    pub(super) fn interface(&self, bus: &Bus) -> Vec<Finding> {
        let name = &bus.wanted.name;
        let Some(interface) = &bus.interface else {
            return vec![if bus.wanted.hardware().is_some() {
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
            if interface.is_virtual() && bus.wanted.hardware().is_some() {
                let command = if interface.ours { self.own("down") } else { self.sudo("ip link del") };
                findings.push(Finding::note(
                    format!("{name} is {what} and has no bit rate; the skin gives it one, as hardware has"),
                    [format!("{command} {name}  # if hardware is to have this name")],
                ));
            }
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
                mend(widen("ip", name)),
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
        let set = || match bus.wanted.hardware() {
            Some(skin) => self.own(&format!("up {} --set-bit-rates", skin.file)),
            None => {
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
        let has = hardware.rates();
        if let Some(skin) = skin.filter(|skin| !has.meet(skin.rates)) {
            let text = format!("{name} is {what} at {has}, and the skin says {}", skin.rates);
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
        if would_run(&findings) {
            findings.push(match skin {
                Some(skin) if skin.rates.bitrate.is_some() => {
                    Finding::ok(format!("{name} is at {has}, as the skin says"))
                }
                Some(_) => Finding::note(
                    format!("{name} is at {has}; the skin does not say whether that is right"),
                    ["bitrate = ...  # under its [[bus]] in the skin".to_owned()],
                ),
                None => Finding::ok(format!("{name} is at {has}")),
            });
        }
        findings
    }
}

/// What an interface of this MTU carries.
const fn carries(mtu: u32) -> &'static str {
    if mtu >= FD_MTU { "CAN FD" } else { "classic CAN" }
}
