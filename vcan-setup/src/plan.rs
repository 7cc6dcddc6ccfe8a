//! What is to be done, before anything is done: target interfaces and present ones are turned into
//! steps, or into a refusal.
//!
//! ```text
//!   target  --+
//!             +--> up, down --> steps, each of which can be printed in words and as an `ip` command
//!   present --+            \--> or why nothing is done at all
//! ```
//!
//! A step makes an interface, or changes or removes one that this program has made. The one exception is
//! [`Action::SetRates`], which is planned only when it was requested, and only for CAN hardware.

use std::ffi::OsStr;

use protocol::can::Format;
use protocol::skin::Skin;
use protocol::usage::quoted_os;

use crate::link::{FD_MTU, Hardware, Interface, Kind, Rates};
use crate::namespace::Namespace;

mod refusal;
mod step;

pub use refusal::Refusal;
pub(crate) use step::widen;
pub use step::{Action, Step};

/// A requested interface.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Target {
    /// Its name.
    pub name: String,
    /// Which frames it has to carry.
    pub format: Format,
    /// The skin that it is a bus of; `None` when it was named on the command line.
    pub skin: Option<SkinBus>,
}

/// A skin's values for a bus that may be hardware.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct SkinBus {
    /// The skin's file, as a shell takes it.
    pub file: String,
    /// Its bit rates, those that the skin gives.
    pub rates: Rates,
}

impl Target {
    /// An interface that was named, for all frames.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self { name: name.to_owned(), format: Format::Fd, skin: None }
    }

    /// The buses of a skin.
    #[must_use]
    pub fn of_skin(file: &OsStr, skin: &Skin) -> Vec<Self> {
        let target = |bus: &protocol::skin::Bus| Self {
            name: bus.name.clone(),
            format: bus.format,
            skin: Some(SkinBus {
                file: quoted_os(file),
                rates: Rates { bitrate: bus.bitrate, data_bitrate: bus.data_bitrate },
            }),
        };
        skin.buses.iter().map(target).collect()
    }

    /// For hardware that was named without a skin, the format is the one that it carries.
    pub fn take_format_of_hardware(&mut self, present: &[Interface]) {
        let there = find(present, &self.name).filter(|it| it.hardware().is_some());
        if self.skin.is_none() && there.is_some_and(|it| it.mtu < FD_MTU) {
            self.format = Format::Classic;
        }
    }

    /// The skin that gives it a bit rate, so that it can only be hardware.
    #[must_use]
    pub fn hardware(&self) -> Option<&SkinBus> {
        self.skin.as_ref().filter(|skin| skin.rates.bitrate.is_some())
    }

    /// Why it cannot be had together with others, if it cannot: two skins give one bus two bit rates.
    fn at_odds(&self, others: &[Self]) -> Option<Refusal> {
        let own = self.hardware()?;
        let mut skins = others.iter().filter(|other| other.name == self.name).filter_map(Self::hardware);
        let other = skins.find(|skin| skin.rates != own.rates)?;
        let says = |skin: &SkinBus| format!("{} says {}", skin.file, skin.rates);
        Some(Refusal::AtOdds { name: self.name.clone(), one: says(other), other: says(own) })
    }

    /// Whether an interface's MTU carries the required frames.
    #[must_use]
    pub const fn carried_by(&self, mtu: u32) -> bool {
        matches!(self.format, Format::Classic) || mtu >= FD_MTU
    }
}

/// A requested pair, seen from its first end.
#[derive(Clone, Copy, Debug)]
pub struct TargetPair<'a> {
    /// The end in this network namespace.
    pub name: &'a str,
    /// The other end.
    pub peer: &'a str,
    /// Where the other end is to be; `None`: in this namespace too.
    pub there: Option<&'a There>,
}

/// Another network namespace.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct There {
    /// As it was named.
    pub name: Namespace,
    /// Its number in this one, if it has one.
    pub id: Option<i32>,
    /// Its interfaces.
    pub present: Vec<Interface>,
}
/// What is done, and what is not and why.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Plan {
    /// In this order.
    pub steps: Vec<Step>,
    /// One line on each interface that is left as it is.
    pub unchanged: Vec<String>,
}

fn find<'a>(present: &'a [Interface], name: &str) -> Option<&'a Interface> {
    present.iter().find(|interface| interface.name == name)
}

/// The steps after which every target interface is there, is up and carries the required frames.
///
/// # Errors
/// When that cannot be had without touching something that is not ours. Then nothing is to be done.
pub fn up(target: &[Target], present: &[Interface], set_bit_rates: bool) -> Result<Plan, Refusal> {
    let mut plan = Plan::default();
    if let Some(refusal) = target.iter().enumerate().find_map(|(at, it)| it.at_odds(target.get(..at)?)) {
        return Err(refusal);
    }
    for target in target {
        if plan.changes(&target.name) {
            continue;
        }
        let Some(interface) = find(present, &target.name) else {
            if let Some(SkinBus { file, .. }) = target.hardware() {
                return Err(Refusal::Absent { name: target.name.clone(), file: file.clone() });
            }
            plan.steps.push(Step { name: target.name.clone(), action: Action::MakeVcan });
            continue;
        };
        match (&interface.kind, &target.skin) {
            (Kind::Vcan | Kind::Vxcan(_), _) => plan.fit(target, interface)?,
            (Kind::Hardware(hardware), Some(skin)) => {
                plan.hardware(target, skin, interface, hardware, set_bit_rates)?;
            }
            (Kind::Hardware(_), None) | (Kind::Other(_), _) => return Err(Refusal::real(interface)),
        }
    }
    Ok(plan)
}

/// What has to be done so that both ends of a pair are there and up.
///
/// # Errors
/// When that cannot be had without touching something that is not ours. Then nothing is to be done.
pub fn up_pair(target: &TargetPair<'_>, present: &[Interface]) -> Result<Plan, Refusal> {
    let TargetPair { name, peer, there } = *target;
    if there.is_none() && name == peer {
        return Err(Refusal::OneName(name.to_owned()));
    }
    let present_there = there.map_or(present, |there| &there.present);
    let ends = (find(present, name), find(present_there, peer));
    let mut plan = Plan::default();
    let (here, other) = match ends {
        (None, None) => {
            let namespace = there.map(|there| there.name.clone());
            let action = Action::MakePair { peer: peer.to_owned(), namespace };
            plan.steps.push(Step { name: name.to_owned(), action });
            return Ok(plan);
        }
        (Some(here), Some(other)) if are_a_pair(here, other, there) => (here, other),
        (Some(in_the_way), _) => return Err(not_a_pair(in_the_way, peer, None)),
        (None, Some(in_the_way)) => return Err(not_a_pair(in_the_way, name, there)),
    };
    plan.fit(&Target::named(name), here)?;
    let Some(there) = there else {
        plan.fit(&Target::named(peer), other)?;
        return Ok(plan);
    };
    // Steps do not reach into the other namespace, but for making what is not there.
    let ip = there.name.ip();
    let (what, command) = match (other.up, other.mtu >= FD_MTU) {
        (true, true) => return Ok(plan),
        (false, true) => ("down".to_owned(), format!("{ip} link set {peer} up")),
        (_, false) => (format!("of MTU {}", other.mtu), format!("sh -c '{}'", widen(&ip, peer))),
    };
    let end = format!("{peer} in {}, is {what}", there.name);
    Err(Refusal::OtherEnd { name: name.to_owned(), end, command })
}

fn are_a_pair(here: &Interface, other: &Interface, there: Option<&There>) -> bool {
    let Some(peer) = here.peer() else { return false };
    let same_place = match there {
        None => peer.namespace_id.is_none(),
        Some(there) => peer.namespace_id.is_some() && there.id == peer.namespace_id,
    };
    same_place && peer.index == other.index && matches!(other.kind, Kind::Vxcan(_))
}

fn not_a_pair(in_the_way: &Interface, peer: &str, there: Option<&There>) -> Refusal {
    let Interface { name, .. } = in_the_way;
    if !in_the_way.is_virtual() {
        return Refusal::real(in_the_way);
    }
    let hint = match (in_the_way.ours, there) {
        (true, None) => format!("`sudo vcan-setup down {name}` removes it, or choose another name"),
        (true, Some(there)) => {
            format!("`sudo {} link del {name}` removes it, or choose another name", there.name.ip())
        }
        (false, _) => "choose another name".to_owned(),
    };
    let at = there.map(|there| format!(" in {}", there.name)).unwrap_or_default();
    let what = format!("{}{at}", in_the_way.what());
    Refusal::OtherPair { name: name.clone(), what, peer: peer.to_owned(), hint }
}

impl Plan {
    /// Whether a step is about an interface of this name already.
    fn changes(&self, name: &str) -> bool {
        self.steps.iter().any(|step| step.name == name)
    }

    /// Says of an interface, once, that it is left as it is.
    fn leave(&mut self, line: String) {
        if !self.unchanged.contains(&line) {
            self.unchanged.push(line);
        }
    }

    /// Brings a virtual interface that is there into the target state, if it is ours.
    fn fit(&mut self, target: &Target, interface: &Interface) -> Result<(), Refusal> {
        let Interface { index, mtu, .. } = *interface;
        let name = interface.name.clone();
        let wide = target.carried_by(mtu);
        let action = match (wide, interface.up, interface.ours) {
            (true, true, ours) => {
                let whose = if ours { "" } else { ", made by somebody else" };
                self.leave(format!("{name} is there already, and fits ({}{whose})", interface.what()));
                return Ok(());
            }
            (false, _, false) => return Err(Refusal::Narrow { name, mtu }),
            (true, false, false) => return Err(Refusal::Down(name)),
            (false, was_up, true) => Action::Widen { index, from: mtu, was_up },
            (true, false, true) => Action::BringUp { index },
        };
        self.steps.push(Step { name, action });
        Ok(())
    }

    /// Compares hardware with the skin, and sets it when that was requested.
    fn hardware(
        &mut self,
        target: &Target,
        skin: &SkinBus,
        interface: &Interface,
        hardware: &Hardware,
        set: bool,
    ) -> Result<(), Refusal> {
        let (name, file, what) = (interface.name.clone(), skin.file.clone(), interface.what());
        let (before, rates) = (hardware.rates(), skin.rates);
        let agrees = before.meet(rates);
        let wide = target.carried_by(interface.mtu);
        if agrees && wide && interface.up {
            let checked = if rates.bitrate.is_some() { ", as the skin says" } else { "" };
            self.leave(format!("{name} is {what}, at {before}{checked}, and is left as it is"));
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
                return Err(Refusal::NoRate { name, key, example, file });
            }
            let (index, was_up) = (interface.index, interface.up);
            self.steps.push(Step { name, action: Action::SetRates { index, rates, before, was_up } });
            return Ok(());
        }
        if !agrees {
            return Err(Refusal::Rates { name, has: before, wants: rates, file });
        }
        if !wide {
            return Err(Refusal::HardwareNarrow { name, what, mtu: interface.mtu, file });
        }
        match missing {
            // Its rates are set, and the skin has none.
            Some(_) if before.bitrate.is_some() => Err(Refusal::Down(name)),
            Some((key, example)) => Err(Refusal::NoRate { name, key, example, file }),
            None => Err(Refusal::HardwareDown { name, what, file }),
        }
    }
}

/// The steps that remove those of the target interfaces that this program has made.
///
/// # Errors
/// When an interface was named that is not ours. Buses of a skin are left alone instead.
pub fn down(target: &[Target], present: &[Interface]) -> Result<Plan, Refusal> {
    let mut plan = Plan::default();
    for target in target {
        let name = target.name.clone();
        if plan.changes(&name) {
            continue;
        }
        match (find(present, &name), &target.skin) {
            (None, _) => plan.leave(format!("{name} is not there")),
            (Some(interface), _) if interface.ours && interface.is_virtual() => {
                if !removed_with(&plan, interface, present) {
                    plan.steps.push(Step { name, action: Action::Remove { index: interface.index } });
                }
            }
            (Some(interface), Some(_)) => {
                let what = interface.what();
                plan.leave(format!("{name} is {what} that vcan-setup has not made, and is left alone"));
            }
            (Some(interface), None) => {
                let hint = if interface.is_virtual() {
                    format!(": if it is yours, `sudo ip link del {name}` removes it")
                } else {
                    String::new()
                };
                return Err(Refusal::NotOurs { name, what: interface.what(), hint });
            }
        }
    }
    Ok(plan)
}

/// Whether the other end of its pair, which takes this end with it, is removed already.
fn removed_with(plan: &Plan, interface: &Interface, present: &[Interface]) -> bool {
    let peer = interface.peer().filter(|peer| peer.namespace_id.is_none());
    let peer = peer.and_then(|peer| present.iter().find(|other| other.index == peer.index));
    peer.is_some_and(|peer| plan.changes(&peer.name))
}

#[cfg(test)]
mod tests;
