//! Assesses the CAN interfaces of a machine, and suggests commands to fix them.

use protocol::bus::KindChoice;
use protocol::can::Format;

use super::{BusFacts, Finding, MachineFacts, User, would_bench_run};
use crate::kernel::ModuleState;
use crate::link::{CanHardware, ControllerState, FD_MTU, Interface, InterfaceKind};
use crate::plan::set_fd_mtu_command;

impl MachineFacts {
    /// Reports whether interfaces that are missing can be created on this machine.
    pub(super) fn check_creation(&self) -> Vec<Finding> {
        let missing = |bus: &&BusFacts| bus.interface.is_none() && bus.target.hardware().is_none();
        let mut findings = Vec::new();
        if self.buses.iter().find(missing).is_none() && !(self.buses.is_empty() && self.present.is_empty()) {
            return findings;
        }
        let hints = self.kernel.setup_hints(self.kernel.vcan);
        findings.extend(match self.kernel.vcan {
            ModuleState::Available => None,
            ModuleState::Unknown => {
                let text = "it is unknown whether the kernel supports vcan; if it does not:";
                Some(Finding::note(text).with_hints(hints))
            }
            ModuleState::Loadable => {
                let text = "the kernel module vcan is not loaded; making an interface loads it";
                Some(Finding::note(text).with_hint(self.with_sudo("modprobe vcan")))
            }
            ModuleState::Missing => {
                let text = format!("the kernel ({}) supports CAN, but not vcan", self.kernel.release);
                Some(Finding::fault(text).with_hints(hints))
            }
        });
        findings.extend(match self.user {
            User { admin: true, .. } => None,
            User { root: false, .. } => {
                Some(Finding::note("this user may not make interfaces, so the commands below use sudo"))
            }
            User { root: true, .. } => Some(
                Finding::fault(
                    "root may not make interfaces here: it has no CAP_NET_ADMIN, as in most containers",
                )
                .with_hint(
                    "docker run --cap-add NET_ADMIN ...  # or make the interface outside, in the container's \
                     network namespace",
                ),
            ),
        });
        findings
    }

    /// Reports whether any usable CAN interface exists. Does nothing if buses are named.
    pub(super) fn check_any_interface(&self) -> Option<Finding> {
        if !self.buses.is_empty() {
            return None;
        }
        let up = self.present.iter().filter(|interface| interface.up);
        Some(match up.max_by_key(|interface| interface.mtu >= FD_MTU) {
            Some(Interface { name, mtu, .. }) => {
                Finding::ok(format!("{name} is up and carries {}", carried_format(*mtu)))
            }
            None => Finding::fault("no CAN interface is up").with_hint(self.vcan_setup_command("up vcan0")),
        })
    }

    /// Reports what a bench does without the interface, if the user accepts either kind of bus.
    pub(super) fn check_absent_interface(&self, bus: &BusFacts) -> Option<Finding> {
        if self.choice != KindChoice::Auto || !self.kernel.has_can {
            return None;
        }
        let (name, up) = (&bus.target.name, self.up_command(&bus.target));
        let is_served = !matches!(bus.traffic, Ok(None));
        Some(match (self.no_spawn, is_served) {
            (false, _) => Finding::note(format!(
                "there is no interface {name}, so a run that starts its cells uses an embedded bus; for \
                 SocketCAN:"
            ))
            .with_hint(up),
            (true, true) => Finding::ok(format!(
                "there is no interface {name}, but a running program serves an embedded bus of this name"
            )),
            (true, false) => Finding::fault(format!(
                "there is no interface {name}, and no running program serves an embedded bus of this name"
            ))
            .with_hint(up)
            .with_hint(format!("{} serve {name} &", self.program)),
        })
    }

    pub(super) fn check_interface(&self, bus: &BusFacts) -> Vec<Finding> {
        let name = &bus.target.name;
        let Some(interface) = &bus.interface else {
            if let Some(finding) = self.check_absent_interface(bus) {
                let mut findings = vec![finding];
                findings.extend(self.check_traffic(bus, "the embedded bus"));
                return findings;
            }
            let (text, up) = (format!("there is no interface {name}"), self.up_command(&bus.target));
            return vec![if bus.target.hardware().is_some() {
                Finding::fault(text + ", and the skin gives it a bitrate, so it is hardware")
                    .with_hint("# plug it in and load its driver; `vcan-setup status` shows when it is there")
                    .with_hint(up + "  # makes a vcan, after you have removed bitrate from the skin")
            } else {
                Finding::fault(text).with_hint(up)
            }];
        };
        let mut findings = match &interface.kind {
            InterfaceKind::Other(what) => {
                let text = format!("{name} is {what}, which does not carry CAN");
                return vec![Finding::fault(text).with_hint("# use another bus")];
            }
            InterfaceKind::Vcan | InterfaceKind::Vxcan(_) => self.virtual_faults(bus, interface),
            InterfaceKind::Hardware(hardware) => self.hardware_faults(bus, interface, hardware),
        };
        if would_bench_run(&findings) {
            let what = interface.description();
            let text = format!("{name} is {what}, up, and carries {}", carried_format(interface.mtu));
            findings.insert(0, Finding::ok(text));
            if interface.is_virtual() && bus.target.hardware().is_some() {
                let command = if interface.ours {
                    self.vcan_setup_command("down")
                } else {
                    self.with_sudo("ip link del")
                };
                let text = format!(
                    "{name} is {what}, which has no bit rate, but the skin specifies one, as for hardware"
                );
                let hint = format!("{command} {name}  # if this name belongs to hardware");
                findings.push(Finding::note(text).with_hint(hint));
            }
            findings.extend(self.check_traffic(bus, name));
        }
        findings
    }

    fn virtual_faults(&self, bus: &BusFacts, interface: &Interface) -> Vec<Finding> {
        let Interface { name, mtu, ours, up, .. } = interface;
        let repair = |command: String| {
            let command = if self.user.admin { command } else { format!("sudo sh -c '{command}'") };
            if *ours { self.up_command(&bus.target) } else { command }
        };
        if !bus.target.fits_mtu(*mtu) {
            let text = format!("{name} has MTU {mtu}, but CAN FD needs {FD_MTU}");
            return vec![Finding::fault(text).with_hint(repair(set_fd_mtu_command("ip", name)))];
        }
        if !up {
            let hint = repair(format!("ip link set {name} up"));
            return vec![Finding::fault(format!("{name} is down")).with_hint(hint)];
        }
        Vec::new()
    }

    fn hardware_faults(&self, bus: &BusFacts, interface: &Interface, hardware: &CanHardware) -> Vec<Finding> {
        let Interface { name, mtu, up, .. } = interface;
        let what = interface.description();
        let skin = bus.target.skin.as_ref();
        // The command that sets the bit rates can be given only if the skin has them.
        let set = || match bus.target.hardware() {
            Some(skin) => self.vcan_setup_command(&format!("up {} --set-bit-rates", skin.file)),
            None => {
                let rates = match bus.target.format {
                    Format::Fd => "bitrate 1000000 dbitrate 5000000 fd on",
                    Format::Classic => "bitrate 1000000",
                };
                self.with_sudo(&format!(
                    "sh -c 'ip link set {name} down; ip link set {name} up type can {rates}'  # with the bit \
                     rates of your bus"
                ))
            }
        };
        let mut findings = Vec::new();
        let has = hardware.bit_rates();
        if let Some(skin) = skin.filter(|skin| !has.matches(skin.rates)) {
            let text = format!("{name} is {what} with {has}, but the skin requires {}", skin.rates);
            findings.push(Finding::fault(text).with_hint(set()));
        } else if !bus.target.fits_mtu(*mtu) {
            let text = format!("{name} is {what} with MTU {mtu}, and CAN FD needs {FD_MTU}");
            let classic = "format = \"classic\"  # in the skin";
            findings.push(Finding::fault(text).with_hint(set()).with_hint(classic));
        } else if !up {
            findings.push(Finding::fault(format!("{name} is {what}, but down")).with_hint(set()));
        }
        if bus.sums {
            let text = format!(
                "{name} is {what}, but cells that answer with sums simulate their wires with frames that must \
                 not be sent there"
            );
            let hint = "reply = \"torque\"  # in the skin; or name a vcan or the embedded bus";
            findings.push(Finding::fault(text).with_hint(hint));
        }
        if hardware.listen_only {
            let off = "type can listen-only off";
            let hint =
                self.with_sudo(&format!("sh -c 'ip link set {name} down; ip link set {name} up {off}'"));
            let text = format!("{name} is in listen-only mode: it can neither send nor acknowledge frames");
            findings.push(Finding::fault(text).with_hint(hint));
        }
        findings.extend(match hardware.state.filter(|_| *up) {
            Some(ControllerState::BusOff) => Some(
                Finding::fault(format!(
                    "{name} is BUS-OFF: it left the bus after too many errors; correct the wiring, the \
                     termination or the bit rates"
                ))
                .with_hint(self.with_sudo(&format!("ip link set {name} type can restart"))),
            ),
            Some(state @ (ControllerState::ErrorPassive | ControllerState::ErrorWarning)) => Some(
                Finding::note(format!(
                    "{name} is {}: it detects errors; check that another node is on the bus, terminated, at \
                     the same bit rates",
                    state.name()
                ))
                .with_hint(format!("ip -details -statistics link show {name}")),
            ),
            Some(ControllerState::ErrorActive | ControllerState::Stopped | ControllerState::Sleeping)
            | None => None,
        });
        if would_bench_run(&findings) {
            findings.push(match skin {
                Some(skin) if skin.rates.bitrate.is_some() => {
                    Finding::ok(format!("{name} runs at {has}, as the skin requires"))
                }
                Some(_) => Finding::note(format!(
                    "{name} runs at {has}; the skin specifies no bit rate to compare it with"
                ))
                .with_hint("bitrate = ...  # under its [[bus]] in the skin"),
                None => Finding::ok(format!("{name} runs at {has}")),
            });
        }
        findings
    }
}

/// Returns the name of the CAN format that an interface of this MTU carries.
const fn carried_format(mtu: u32) -> &'static str {
    if mtu >= FD_MTU { "CAN FD" } else { "classic CAN" }
}
