//! Plans changes to interfaces before anything is changed: compares the interfaces that a user wants with those that
//! exist, and returns steps, or the reason why nothing is done.
//!
//! ```text
//!   target  --+
//!             +--> up, down --> steps, each of which can be printed as text and as an `ip` command
//!   present --+            \--> or the reason why nothing is done
//! ```
//!
//! A step makes an interface, or changes or removes one that this program has made. The only exception is
//! [`StepAction::SetRates`], which changes CAN hardware and is planned only if the user requests it.

use std::ffi::OsStr;

use protocol::can::Format;
use protocol::skin::Skin;
use protocol::usage::shell_quoted_os;

use crate::link::{CanHardware, FD_MTU, HardwareRates, Interface, InterfaceKind};
use crate::namespace::Namespace;

mod refusal;
mod step;

pub use refusal::PlanRefusal;
pub(crate) use step::set_fd_mtu_command;
pub use step::{Step, StepAction};

/// An interface that the user wants, by itself or as a bus of a skin.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct InterfaceTarget {
    /// The name.
    pub name: String,
    /// The format of the frames that it must carry.
    pub format: Format,
    /// The skin that contains the bus; `None` if the interface was named on the command line.
    pub skin: Option<SkinBus>,
}

/// The statements of a skin about a bus that may be hardware.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct SkinBus {
    /// The path of the skin, quoted for a shell.
    pub file: String,
    /// The bit rates of the bus, as far as the skin states them.
    pub rates: HardwareRates,
}

impl InterfaceTarget {
    /// Returns the target for an interface that was named on the command line. It must carry frames of both formats.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self { name: name.to_owned(), format: Format::Fd, skin: None }
    }

    /// Returns a target for each bus of a skin.
    #[must_use]
    pub fn from_skin(file: &OsStr, skin: &Skin) -> Vec<Self> {
        let target = |bus: &protocol::skin::SkinBus| Self {
            name: bus.name.clone(),
            format: bus.format,
            skin: Some(SkinBus {
                file: shell_quoted_os(file),
                rates: HardwareRates { bitrate: bus.bitrate, data_bitrate: bus.data_bitrate },
            }),
        };
        skin.buses.iter().map(target).collect()
    }

    /// Restricts a target without a skin to the frame format that the hardware of this name is set to.
    pub fn adopt_hardware_format(&mut self, present: &[Interface]) {
        let there = find_interface(present, &self.name).filter(|it| it.hardware().is_some());
        if self.skin.is_none() && there.is_some_and(|it| it.mtu < FD_MTU) {
            self.format = Format::Classic;
        }
    }

    /// Returns the skin if it states a bit rate for the bus: the bus is then hardware.
    #[must_use]
    pub fn hardware(&self) -> Option<&SkinBus> {
        self.skin.as_ref().filter(|skin| skin.rates.bitrate.is_some())
    }

    /// Returns a refusal if another skin states different bit rates for the same bus.
    fn rate_conflict(&self, others: &[Self]) -> Option<PlanRefusal> {
        let own = self.hardware()?;
        let mut skins = others.iter().filter(|other| other.name == self.name).filter_map(Self::hardware);
        let other = skins.find(|skin| skin.rates != own.rates)?;
        let says = |skin: &SkinBus| format!("{} requires {}", skin.file, skin.rates);
        Some(PlanRefusal::AtOdds { name: self.name.clone(), one: says(other), other: says(own) })
    }

    /// Returns true if an interface with this MTU (in bytes) can carry the frames of the target.
    #[must_use]
    pub const fn fits_mtu(&self, mtu: u32) -> bool {
        matches!(self.format, Format::Classic) || mtu >= FD_MTU
    }
}

/// A pair of virtual interfaces that the user wants.
#[derive(Clone, Copy, Debug)]
pub struct TargetPair<'a> {
    /// The name of the end in this network namespace.
    pub name: &'a str,
    /// The name of the other end.
    pub peer: &'a str,
    /// The namespace of the other end; `None` for this namespace.
    pub there: Option<&'a OtherNamespace>,
}

/// Another network namespace, with the interfaces in it.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct OtherNamespace {
    /// The namespace as named by the user.
    pub name: Namespace,
    /// The id by which this namespace knows the other one, if there is one.
    pub id: Option<i32>,
    /// The interfaces that exist in the namespace.
    pub present: Vec<Interface>,
}
/// The result of planning: steps to be executed, and interfaces that need none.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Plan {
    /// The steps, in the order of execution.
    pub steps: Vec<Step>,
    /// A line of text for each interface that needs no change.
    pub unchanged: Vec<String>,
}

fn find_interface<'a>(present: &'a [Interface], name: &str) -> Option<&'a Interface> {
    present.iter().find(|interface| interface.name == name)
}

/// Plans the steps after which every target interface exists, is up and carries the required frames.
///
/// # Errors
/// Returns [`PlanRefusal`] if an interface would have to be changed that this program has not made.
pub fn plan_up(
    target: &[InterfaceTarget],
    present: &[Interface],
    set_bit_rates: bool,
) -> Result<Plan, PlanRefusal> {
    let mut plan = Plan::default();
    if let Some(refusal) = target.iter().enumerate().find_map(|(at, it)| it.rate_conflict(target.get(..at)?))
    {
        return Err(refusal);
    }
    for target in target {
        if plan.has_step_for(&target.name) {
            continue;
        }
        let Some(interface) = find_interface(present, &target.name) else {
            if let Some(SkinBus { file, .. }) = target.hardware() {
                return Err(PlanRefusal::Absent { name: target.name.clone(), file: file.clone() });
            }
            plan.steps.push(Step { name: target.name.clone(), action: StepAction::MakeVcan });
            continue;
        };
        match (&interface.kind, &target.skin) {
            (InterfaceKind::Vcan | InterfaceKind::Vxcan(_), _) => plan.plan_virtual(target, interface)?,
            (InterfaceKind::Hardware(hardware), Some(skin)) => {
                plan.plan_hardware(target, skin, interface, hardware, set_bit_rates)?;
            }
            (InterfaceKind::Hardware(_), None) | (InterfaceKind::Other(_), _) => {
                return Err(PlanRefusal::not_virtual(interface));
            }
        }
    }
    Ok(plan)
}

/// Plans the steps after which both ends of a pair exist and are up.
///
/// # Errors
/// Returns [`PlanRefusal`] if an interface would have to be changed that this program has not made.
pub fn plan_pair_up(target: &TargetPair<'_>, present: &[Interface]) -> Result<Plan, PlanRefusal> {
    let TargetPair { name, peer, there } = *target;
    if there.is_none() && name == peer {
        return Err(PlanRefusal::OneName(name.to_owned()));
    }
    let present_there = there.map_or(present, |there| &there.present);
    let ends = (find_interface(present, name), find_interface(present_there, peer));
    let mut plan = Plan::default();
    let (here, other) = match ends {
        (None, None) => {
            let namespace = there.map(|there| there.name.clone());
            let action = StepAction::MakePair { peer: peer.to_owned(), namespace };
            plan.steps.push(Step { name: name.to_owned(), action });
            return Ok(plan);
        }
        (Some(here), Some(other)) if are_a_pair(here, other, there) => (here, other),
        (Some(in_the_way), _) => return Err(not_a_pair_refusal(in_the_way, peer, None)),
        (None, Some(in_the_way)) => return Err(not_a_pair_refusal(in_the_way, name, there)),
    };
    plan.plan_virtual(&InterfaceTarget::named(name), here)?;
    let Some(there) = there else {
        plan.plan_virtual(&InterfaceTarget::named(peer), other)?;
        return Ok(plan);
    };
    // In the other namespace, nothing is changed except that a missing pair is made.
    let ip = there.name.ip_command();
    let (what, command) = match (other.up, other.mtu >= FD_MTU) {
        (true, true) => return Ok(plan),
        (false, true) => ("is down".to_owned(), format!("{ip} link set {peer} up")),
        (_, false) => (
            format!("has MTU {}, which is too small for CAN FD", other.mtu),
            format!("sh -c '{}'", set_fd_mtu_command(&ip, peer)),
        ),
    };
    let end = format!("{peer} in {}, {what}", there.name);
    Err(PlanRefusal::OtherEnd { name: name.to_owned(), end, command })
}

fn are_a_pair(here: &Interface, other: &Interface, there: Option<&OtherNamespace>) -> bool {
    let Some(peer) = here.peer() else { return false };
    let same_place = match there {
        None => peer.namespace_id.is_none(),
        Some(there) => peer.namespace_id.is_some() && there.id == peer.namespace_id,
    };
    same_place && peer.index == other.index && matches!(other.kind, InterfaceKind::Vxcan(_))
}

fn not_a_pair_refusal(in_the_way: &Interface, peer: &str, there: Option<&OtherNamespace>) -> PlanRefusal {
    let Interface { name, .. } = in_the_way;
    if !in_the_way.is_virtual() {
        return PlanRefusal::not_virtual(in_the_way);
    }
    let hint = match (in_the_way.ours, there) {
        (true, None) => format!("`sudo vcan-setup down {name}` removes it, or choose another name"),
        (true, Some(there)) => {
            format!("`sudo {} link del {name}` removes it, or choose another name", there.name.ip_command())
        }
        (false, _) => "choose another name".to_owned(),
    };
    let at = there.map(|there| format!(" in {}", there.name)).unwrap_or_default();
    let what = format!("{}{at}", in_the_way.description());
    PlanRefusal::OtherPair { name: name.clone(), what, peer: peer.to_owned(), hint }
}

impl Plan {
    /// Returns true if the plan already has a step for the interface of this name.
    fn has_step_for(&self, name: &str) -> bool {
        self.steps.iter().any(|step| step.name == name)
    }

    /// Adds a line for an interface that needs no change, unless the plan already has it.
    fn add_unchanged(&mut self, line: String) {
        if !self.unchanged.contains(&line) {
            self.unchanged.push(line);
        }
    }

    /// Plans the steps by which an existing virtual interface fulfils its target, if this program has made it.
    fn plan_virtual(&mut self, target: &InterfaceTarget, interface: &Interface) -> Result<(), PlanRefusal> {
        let Interface { index, mtu, .. } = *interface;
        let name = interface.name.clone();
        let wide = target.fits_mtu(mtu);
        let action = match (wide, interface.up, interface.ours) {
            (true, true, ours) => {
                let whose = if ours { "" } else { ", made by another program" };
                self.add_unchanged(format!(
                    "{name} already exists and is suitable ({}{whose})",
                    interface.description()
                ));
                return Ok(());
            }
            (false, _, false) => return Err(PlanRefusal::Narrow { name, mtu }),
            (true, false, false) => return Err(PlanRefusal::Down(name)),
            (false, was_up, true) => StepAction::Widen { index, from: mtu, was_up },
            (true, false, true) => StepAction::BringUp { index },
        };
        self.steps.push(Step { name, action });
        Ok(())
    }

    /// Compares the bit rates of hardware with those of the skin. Plans to set them if the user requests it.
    fn plan_hardware(
        &mut self,
        target: &InterfaceTarget,
        skin: &SkinBus,
        interface: &Interface,
        hardware: &CanHardware,
        set: bool,
    ) -> Result<(), PlanRefusal> {
        let (name, file, what) = (interface.name.clone(), skin.file.clone(), interface.description());
        let (before, rates) = (hardware.bit_rates(), skin.rates);
        let agrees = before.matches(rates);
        let wide = target.fits_mtu(interface.mtu);
        if agrees && wide && interface.up {
            let checked = if rates.bitrate.is_some() { ", as the skin requires" } else { "" };
            self.add_unchanged(format!("{name} is {what}, runs at {before}{checked}, and stays unchanged"));
            return Ok(());
        }
        let needs_data = target.format == Format::Fd;
        let missing = match (rates.bitrate, rates.data_bitrate) {
            (None, _) => Some(("bitrate", 1_000_000)),
            (Some(_), None) if needs_data => Some(("data_bitrate", 5_000_000)),
            (Some(_), _) => None,
        };
        if set {
            if let Some((key, example)) = missing {
                return Err(PlanRefusal::NoRate { name, key, example, file });
            }
            let (index, was_up) = (interface.index, interface.up);
            self.steps.push(Step { name, action: StepAction::SetRates { index, rates, before, was_up } });
            return Ok(());
        }
        if !agrees {
            return Err(PlanRefusal::Rates { name, has: before, wants: rates, file });
        }
        if !wide {
            return Err(PlanRefusal::HardwareNarrow { name, what, mtu: interface.mtu, file });
        }
        match missing {
            // The hardware is down and has bit rates, but the skin states none, so this program does not set it up.
            Some(_) if before.bitrate.is_some() => Err(PlanRefusal::Down(name)),
            Some((key, example)) => Err(PlanRefusal::NoRate { name, key, example, file }),
            None => Err(PlanRefusal::HardwareDown { name, what, file }),
        }
    }
}

/// Plans the steps that remove the target interfaces, as far as this program has made them.
///
/// # Errors
/// Returns [`PlanRefusal`] if an interface that this program has not made was named on the command line. If it was
/// named by a skin, it is left as it is.
pub fn plan_down(target: &[InterfaceTarget], present: &[Interface]) -> Result<Plan, PlanRefusal> {
    let mut plan = Plan::default();
    for target in target {
        let name = target.name.clone();
        if plan.has_step_for(&name) {
            continue;
        }
        match (find_interface(present, &name), &target.skin) {
            (None, _) => plan.add_unchanged(format!("{name} does not exist")),
            (Some(interface), _) if interface.ours && interface.is_virtual() => {
                if !is_removed_with_peer(&plan, interface, present) {
                    plan.steps.push(Step { name, action: StepAction::Remove { index: interface.index } });
                }
            }
            (Some(interface), Some(_)) => {
                let what = interface.description();
                plan.add_unchanged(format!(
                    "{name} is {what} that vcan-setup did not make, so it stays unchanged"
                ));
            }
            (Some(interface), None) => {
                let hint = if interface.is_virtual() {
                    format!(": if it is yours, `sudo ip link del {name}` removes it")
                } else {
                    String::new()
                };
                return Err(PlanRefusal::NotOurs { name, what: interface.description(), hint });
            }
        }
    }
    Ok(plan)
}

/// Returns true if the plan already removes the other end of the interface's pair: the kernel then removes this end
/// too.
fn is_removed_with_peer(plan: &Plan, interface: &Interface, present: &[Interface]) -> bool {
    let peer = interface.peer().filter(|peer| peer.namespace_id.is_none());
    let peer = peer.and_then(|peer| present.iter().find(|other| other.index == peer.index));
    peer.is_some_and(|peer| plan.has_step_for(&peer.name))
}

#[cfg(test)]
mod tests;
