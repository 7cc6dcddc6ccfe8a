//! What is to be done, before anything is done: wanted interfaces and those that are there come to
//! steps, or to a refusal.
//!
//! ```text
//!   wanted  --+
//!             +--> up, down --> steps, each of which can be said in words and as an `ip` command
//!   present --+            \--> or why nothing is done at all
//! ```
//!
//! A step makes an interface, or changes or removes one that this program has made. The one exception is
//! [`Step::SetRates`], which is planned only when it was asked for, and only for CAN hardware.

use core::fmt;

use protocol::can::Format;
use protocol::skin::Skin;
use thiserror::Error;

use crate::link::{FD_MTU, Hardware, Interface, Kind, MARK, Peer, Place, bit_rate};
use crate::namespace::Namespace;

/// An interface that somebody wants.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Wanted {
    /// Its name.
    pub name: String,
    /// Which frames it has to carry.
    pub format: Format,
    /// The skin that it is a bus of; `None` when it was named on the command line.
    pub skin: Option<SkinBus>,
}

/// What a skin says of a bus that may be hardware.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct SkinBus {
    /// The skin's file.
    pub file: String,
    /// `bitrate`.
    pub bitrate: Option<u32>,
    /// `data_bitrate`.
    pub data_bitrate: Option<u32>,
}

impl Wanted {
    /// An interface that was named, for all frames.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self { name: name.to_owned(), format: Format::Fd, skin: None }
    }

    /// The buses of a skin.
    #[must_use]
    pub fn of_skin(file: &str, skin: &Skin) -> Vec<Self> {
        let wanted = |bus: &protocol::skin::Bus| Self {
            name: bus.name.clone(),
            format: bus.format,
            skin: Some(SkinBus {
                file: file.to_owned(),
                bitrate: bus.bitrate,
                data_bitrate: bus.data_bitrate,
            }),
        };
        skin.buses.iter().map(wanted).collect()
    }

    /// Of hardware that was named nobody knows which frames are wanted: those that it carries.
    pub fn take_format_of_hardware(&mut self, present: &[Interface]) {
        let there = find(present, &self.name).filter(|it| matches!(it.kind, Kind::Hardware(_)));
        if self.skin.is_none() && there.is_some_and(|it| it.mtu < FD_MTU) {
            self.format = Format::Classic;
        }
    }

    /// Whether it can only be hardware: a skin gives it a bit rate.
    #[must_use]
    pub fn is_hardware(&self) -> bool {
        self.skin.as_ref().is_some_and(|skin| skin.bitrate.is_some())
    }

    /// Whether an interface's MTU carries the frames that are wanted.
    #[must_use]
    pub const fn carried_by(&self, mtu: u32) -> bool {
        matches!(self.format, Format::Classic) || mtu >= FD_MTU
    }
}

/// A pair that somebody wants, seen from its first end.
#[derive(Clone, Copy, Debug)]
pub struct WantedPair<'a> {
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

/// One thing that is to be done.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum Step {
    /// Makes a vcan with MTU 72, marks it, and brings it up.
    MakeVcan {
        /// Its name.
        name: String,
    },
    /// Makes a pair with MTU 72, marks both ends, and brings them up.
    MakePair {
        /// The end that is here.
        name: String,
        /// The other end.
        peer: String,
        /// The other end's network namespace.
        namespace: Option<Namespace>,
    },
    /// Brings an interface of ours up.
    BringUp {
        /// Its name.
        name: String,
        /// Its number.
        index: u32,
    },
    /// Gives an interface of ours MTU 72, for which it has to be down, and brings it up.
    Widen {
        /// Its name.
        name: String,
        /// Its number.
        index: u32,
        /// What it has had, in bytes.
        from: u32,
        /// Whether it was up.
        was_up: bool,
    },
    /// Sets the bit rates of CAN hardware, for which it has to be down, and brings it up.
    SetRates {
        /// Its name.
        name: String,
        /// Its number.
        index: u32,
        /// What is to be set.
        rates: Rates,
        /// What was set.
        before: Rates,
        /// Whether it was up.
        was_up: bool,
    },
    /// Removes an interface of ours, and the other end of its pair with it.
    Remove {
        /// Its name.
        name: String,
        /// Its number.
        index: u32,
    },
}

/// Bit rates of CAN hardware.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Rates {
    /// Bits in a second; `None`: none are set.
    pub bitrate: Option<u32>,
    /// Bits in a second of CAN FD data; `None`: classic CAN.
    pub data_bitrate: Option<u32>,
}

impl Rates {
    /// Those that hardware has; in classic mode it has none for data.
    #[must_use]
    pub fn of(hardware: &Hardware) -> Self {
        Self { bitrate: hardware.bitrate, data_bitrate: hardware.data_bitrate.filter(|_| hardware.fd) }
    }

    /// Whether these are what was wanted, but for half a percent.
    #[must_use]
    pub fn meet(self, wanted: Self) -> bool {
        near(wanted.bitrate, self.bitrate) && near(wanted.data_bitrate, self.data_bitrate)
    }
}

impl fmt::Display for Rates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.bitrate, self.data_bitrate) {
            (None, _) => f.write_str("no bit rate"),
            (Some(rate), None) => f.write_str(&bit_rate(rate)),
            (Some(rate), Some(data)) => write!(f, "{}, data {}", bit_rate(rate), bit_rate(data)),
        }
    }
}

impl Step {
    /// The interface that it is about.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::MakeVcan { name }
            | Self::MakePair { name, .. }
            | Self::BringUp { name, .. }
            | Self::Widen { name, .. }
            | Self::SetRates { name, .. }
            | Self::Remove { name, .. } => name,
        }
    }

    /// What it does, in few words: `make vcan0`.
    #[must_use]
    pub fn doing(&self) -> String {
        match self {
            Self::MakeVcan { name } => format!("make {name}"),
            Self::MakePair { name, peer, .. } => format!("make {name} and its other end {peer}"),
            Self::BringUp { name, .. } => format!("bring {name} up"),
            Self::Widen { name, .. } => format!("change the MTU of {name}"),
            Self::SetRates { name, rates, .. } => format!("set {name} to {rates}"),
            Self::Remove { name, .. } => format!("remove {name}"),
        }
    }

    /// What is said once it is done.
    #[must_use]
    pub fn done(&self) -> String {
        match self {
            Self::MakeVcan { name } => format!("{name} is made, a vcan with MTU {FD_MTU}, and up"),
            Self::MakePair { name, peer, namespace } => {
                let at = namespace.as_ref().map(|namespace| format!(" in {namespace}")).unwrap_or_default();
                format!(
                    "{name} is made, and its other end {peer}{at}, a vxcan pair with MTU {FD_MTU}, both up"
                )
            }
            Self::BringUp { name, .. } => format!("{name} is up"),
            Self::Widen { name, .. } => format!("{name} has MTU {FD_MTU}, and is up"),
            Self::SetRates { name, rates, .. } => format!("{name} is at {rates}, and up"),
            Self::Remove { name, .. } => format!("{name} is removed"),
        }
    }

    /// What somebody would type to do the same with `ip`.
    #[must_use]
    pub fn command(&self) -> String {
        match self {
            Self::MakeVcan { name } => {
                format!("ip link add {name} mtu {FD_MTU} type vcan && ip link set {name} alias {MARK} up")
            }
            Self::MakePair { name, peer, namespace } => {
                let (netns, ip) = match namespace {
                    Some(namespace) => (format!(" netns {namespace}"), namespace.ip()),
                    None => (String::new(), "ip".to_owned()),
                };
                format!(
                    "ip link add {name} mtu {FD_MTU} type vxcan peer name {peer} mtu {FD_MTU}{netns} && ip link set \
                     {name} alias {MARK} up && {ip} link set {peer} alias {MARK} up"
                )
            }
            Self::BringUp { name, .. } => format!("ip link set {name} up"),
            Self::Widen { name, .. } => {
                format!("ip link set {name} down && ip link set {name} mtu {FD_MTU} up")
            }
            Self::SetRates { name, rates, was_up, .. } => {
                let down = if *was_up { format!("ip link set {name} down && ") } else { String::new() };
                format!("{down}ip link set {name} type can {} && ip link set {name} up", rates.arguments())
            }
            Self::Remove { name, .. } => format!("ip link del {name}"),
        }
    }
}

impl Rates {
    /// As `ip link set ... type can` takes them.
    fn arguments(self) -> String {
        let bitrate = self.bitrate.unwrap_or(0);
        match self.data_bitrate {
            Some(data) => format!("bitrate {bitrate} dbitrate {data} fd on"),
            None => format!("bitrate {bitrate}"),
        }
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MakeVcan { name } => write!(f, "make {name}, a vcan with MTU {FD_MTU}, and bring it up"),
            Self::MakePair { name, peer, namespace } => {
                write!(f, "make {name} and its other end {peer}")?;
                if let Some(namespace) = namespace {
                    write!(f, " in the network namespace {namespace}")?;
                }
                write!(f, ", a vxcan pair with MTU {FD_MTU}, and bring both up")
            }
            Self::BringUp { name, .. } => write!(f, "bring {name} up"),
            Self::Widen { name, from, .. } => {
                write!(f, "take {name} down, give it MTU {FD_MTU} instead of {from}, and bring it up")
            }
            Self::SetRates { name, rates, before, was_up, .. } => {
                let down = if *was_up { format!("take {name} down, ") } else { String::new() };
                let same = rates == before;
                if same {
                    write!(f, "bring {name} up, at {rates}")
                } else {
                    write!(f, "{down}set {name} to {rates} instead of {before}, and bring it up")
                }
            }
            Self::Remove { name, .. } => write!(f, "remove {name}"),
        }
    }
}

/// What is done, and what is not and why.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Plan {
    /// In this order.
    pub steps: Vec<Step>,
    /// One line on each interface that is left as it is.
    pub left: Vec<String>,
}

/// Why nothing is done: one line, with the command that mends it.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum Refusal {
    /// An interface that carries something else.
    #[error("{name} is real, {what}, and is left alone: choose another name, as `vcan-setup up vcan0` does")]
    NotCan {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
    },
    /// CAN hardware that was named where something virtual is made.
    #[error(
        "{name} is real, {what}, and is left alone: to check its bit rates put it into a skin and run `vcan-setup up SKIN.toml`, to see it `vcan-setup status {name}`"
    )]
    Hardware {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
    },
    /// Somebody else's, with too small an MTU.
    #[error(
        "{name} has MTU {mtu} and CAN FD needs {FD_MTU}; vcan-setup has not made it and leaves it alone: `sudo sh -c 'ip link set {name} down && ip link set {name} mtu {FD_MTU} up'` mends it"
    )]
    Narrow {
        /// Its name.
        name: String,
        /// Its MTU.
        mtu: u32,
    },
    /// Somebody else's, and down.
    #[error(
        "{name} is down; vcan-setup has not made it and leaves it alone: `sudo ip link set {name} up` mends it"
    )]
    Down {
        /// Its name.
        name: String,
    },
    /// A pair is wanted where there is something else.
    #[error("{name} is there already and is {what}, not one end of a pair with {peer}: {remedy}")]
    OtherPair {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
        /// The other end that was wanted.
        peer: String,
        /// What to do.
        remedy: String,
    },
    /// A pair that is there, and whose other end does not work.
    #[error(
        "the other end of {name}, {end}, and vcan-setup changes nothing there: `sudo {command}` mends it"
    )]
    OtherEnd {
        /// Its name.
        name: String,
        /// The other end, and what is wrong with it.
        end: String,
        /// What to do.
        command: String,
    },
    /// A pair of one name in one namespace.
    #[error(
        "{name} cannot be both ends of a pair in one network namespace: give --peer another name, or --namespace"
    )]
    OneName {
        /// The name.
        name: String,
    },
    /// A bus that has a bit rate and is not there.
    #[error(
        "there is no interface {name}, and {file} gives it a bitrate, so it is hardware: plug it in and load its driver, or leave out bitrate and it will be a vcan"
    )]
    Absent {
        /// Its name.
        name: String,
        /// The skin's file.
        file: String,
    },
    /// Hardware with other bit rates.
    #[error(
        "{name} is at {has} and {file} says {wants}: `sudo vcan-setup up {file} --set-bit-rates` sets them, or change {file}"
    )]
    Rates {
        /// Its name.
        name: String,
        /// What is set.
        has: Rates,
        /// What the skin wants.
        wants: String,
        /// The skin's file.
        file: String,
    },
    /// Hardware that is down.
    #[error(
        "{name} is {what}, and down: `sudo vcan-setup up {file} --set-bit-rates` sets its bit rates and brings it up"
    )]
    HardwareDown {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
        /// The skin's file.
        file: String,
    },
    /// Hardware in classic mode on a bus that the skin calls FD.
    #[error(
        "{name} is {what} with MTU {mtu}, and {file} says format = \"fd\", which needs {FD_MTU}: `sudo vcan-setup up {file} --set-bit-rates` switches it to CAN FD if it can, or use \"classic\""
    )]
    HardwareNarrow {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
        /// Its MTU.
        mtu: u32,
        /// The skin's file.
        file: String,
    },
    /// Bit rates are to be set and the skin has none.
    #[error("{file} has no {key} for {name}: put `{key} = {example}` under its [[bus]], then try again")]
    NoRate {
        /// Its name.
        name: String,
        /// The key that is missing.
        key: &'static str,
        /// A usual value.
        example: u32,
        /// The skin's file.
        file: String,
    },
    /// Interfaces that were to be removed and are somebody else's.
    #[error("{name} is {what} that vcan-setup has not made, and is left alone{remedy}")]
    NotOurs {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
        /// What to do.
        remedy: String,
    },
}

impl Refusal {
    /// Whether the command line or the skin is wrong, and not the state of the machine.
    #[must_use]
    pub const fn is_usage(&self) -> bool {
        match self {
            Self::NotCan { .. }
            | Self::Hardware { .. }
            | Self::OneName { .. }
            | Self::NoRate { .. }
            | Self::NotOurs { .. } => true,
            Self::Narrow { .. }
            | Self::Down { .. }
            | Self::OtherPair { .. }
            | Self::OtherEnd { .. }
            | Self::Absent { .. }
            | Self::Rates { .. }
            | Self::HardwareDown { .. }
            | Self::HardwareNarrow { .. } => false,
        }
    }
}

fn find<'a>(present: &'a [Interface], name: &str) -> Option<&'a Interface> {
    present.iter().find(|interface| interface.name == name)
}

/// What has to be done so that every wanted interface is there, is up and carries what it has to.
///
/// # Errors
/// When that cannot be had without touching something that is not ours. Then nothing is to be done.
pub fn up(wanted: &[Wanted], present: &[Interface], set_bit_rates: bool) -> Result<Plan, Refusal> {
    let mut plan = Plan::default();
    for wanted in wanted {
        if plan.steps.iter().any(|step| step.name() == wanted.name) {
            continue;
        }
        let Some(interface) = find(present, &wanted.name) else {
            let hardware = wanted.skin.as_ref().filter(|skin| skin.bitrate.is_some());
            if let Some(SkinBus { file, .. }) = hardware {
                return Err(Refusal::Absent { name: wanted.name.clone(), file: file.clone() });
            }
            plan.steps.push(Step::MakeVcan { name: wanted.name.clone() });
            continue;
        };
        match (&interface.kind, &wanted.skin) {
            (Kind::Vcan | Kind::Vxcan(_), _) => plan.fit(wanted, interface)?,
            (Kind::Hardware(hardware), Some(skin)) => {
                plan.hardware(wanted, skin, interface, hardware, set_bit_rates)?;
            }
            (Kind::Hardware(_), None) => {
                return Err(Refusal::Hardware { name: wanted.name.clone(), what: interface.what() });
            }
            (Kind::Other(what), _) => {
                return Err(Refusal::NotCan { name: wanted.name.clone(), what: what.clone() });
            }
        }
    }
    Ok(plan)
}

/// What has to be done so that both ends of a pair are there and up.
///
/// # Errors
/// When that cannot be had without touching something that is not ours. Then nothing is to be done.
pub fn up_pair(wanted: &WantedPair<'_>, present: &[Interface]) -> Result<Plan, Refusal> {
    let WantedPair { name, peer, there } = *wanted;
    if there.is_none() && name == peer {
        return Err(Refusal::OneName { name: name.to_owned() });
    }
    let present_there = there.map_or(present, |there| &there.present);
    let ends = (find(present, name), find(present_there, peer));
    let mut plan = Plan::default();
    let (here, other) = match ends {
        (None, None) => {
            plan.steps.push(Step::MakePair {
                name: name.to_owned(),
                peer: peer.to_owned(),
                namespace: there.map(|there| there.name.clone()),
            });
            return Ok(plan);
        }
        (Some(here), Some(other)) if are_a_pair(here, other, there) => (here, other),
        (Some(in_the_way), _) => return Err(not_a_pair(in_the_way, peer, None)),
        (None, Some(in_the_way)) => return Err(not_a_pair(in_the_way, name, there)),
    };
    plan.fit(&Wanted::named(name), here)?;
    let Some(there) = there else {
        plan.fit(&Wanted::named(peer), other)?;
        return Ok(plan);
    };
    // Steps do not reach into the other namespace, but for making what is not there.
    let ip = there.name.ip();
    let (what, command) = match (other.up, other.mtu >= FD_MTU) {
        (true, true) => return Ok(plan),
        (false, true) => ("down".to_owned(), format!("{ip} link set {peer} up")),
        (_, false) => (
            format!("of MTU {}", other.mtu),
            format!("sh -c '{ip} link set {peer} down && {ip} link set {peer} mtu {FD_MTU} up'"),
        ),
    };
    let end = format!("{peer} in {}, is {what}", there.name);
    Err(Refusal::OtherEnd { name: name.to_owned(), end, command })
}

fn are_a_pair(here: &Interface, other: &Interface, there: Option<&There>) -> bool {
    let Kind::Vxcan(Some(Peer { index, place, .. })) = &here.kind else { return false };
    let same_place = match (place, there) {
        (Place::Here, None) => true,
        (Place::Namespace { id, .. }, Some(there)) => there.id == Some(*id),
        (Place::Here, Some(_)) | (Place::Namespace { .. }, None) => false,
    };
    same_place && *index == other.index && matches!(other.kind, Kind::Vxcan(_))
}

fn not_a_pair(in_the_way: &Interface, peer: &str, there: Option<&There>) -> Refusal {
    let Interface { name, .. } = in_the_way;
    if !in_the_way.is_virtual() {
        return match in_the_way.is_can() {
            true => Refusal::Hardware { name: name.clone(), what: in_the_way.what() },
            false => Refusal::NotCan { name: name.clone(), what: in_the_way.what() },
        };
    }
    let remedy = match (in_the_way.ours, there) {
        (true, None) => format!("`sudo vcan-setup down {name}` removes it, or choose another name"),
        (true, Some(there)) => {
            format!("`sudo {} link del {name}` removes it, or choose another name", there.name.ip())
        }
        (false, _) => "choose another name".to_owned(),
    };
    let at = there.map(|there| format!(" in {}", there.name)).unwrap_or_default();
    let what = format!("{}{at}", in_the_way.what());
    Refusal::OtherPair { name: name.clone(), what, peer: peer.to_owned(), remedy }
}

impl Plan {
    /// Brings a virtual interface that is there into the wanted state, if it is ours.
    fn fit(&mut self, wanted: &Wanted, interface: &Interface) -> Result<(), Refusal> {
        let Interface { index, mtu, .. } = *interface;
        let name = interface.name.clone();
        let wide = wanted.carried_by(mtu);
        match (wide, interface.up, interface.ours) {
            (true, true, ours) => {
                let whose = if ours { "" } else { ", made by somebody else" };
                self.left.push(format!("{name} is there already, and fits ({}{whose})", interface.what()));
            }
            (false, _, false) => return Err(Refusal::Narrow { name, mtu }),
            (true, false, false) => return Err(Refusal::Down { name }),
            (false, was_up, true) => self.steps.push(Step::Widen { name, index, from: mtu, was_up }),
            (true, false, true) => self.steps.push(Step::BringUp { name, index }),
        }
        Ok(())
    }

    /// Compares hardware with the skin, and sets it when that was asked for.
    fn hardware(
        &mut self,
        wanted: &Wanted,
        skin: &SkinBus,
        interface: &Interface,
        hardware: &Hardware,
        set: bool,
    ) -> Result<(), Refusal> {
        let (name, file, what) = (interface.name.clone(), skin.file.clone(), interface.what());
        let before = Rates::of(hardware);
        let agrees = agrees(skin, hardware);
        let wide = wanted.carried_by(interface.mtu);
        if agrees && wide && interface.up {
            let checked = if skin.bitrate.is_some() { ", as the skin says" } else { "" };
            self.left.push(format!("{name} is {what}, at {before}{checked}, and is left as it is"));
            return Ok(());
        }
        if set {
            let needs_data = wanted.format == Format::Fd;
            let missing = match (skin.bitrate, skin.data_bitrate) {
                (None, _) => Some(("bitrate", 1_000_000)),
                (Some(_), None) if needs_data => Some(("data_bitrate", 5_000_000)),
                (Some(_), _) => None,
            };
            if let Some((key, example)) = missing {
                return Err(Refusal::NoRate { name, key, example, file });
            }
            let rates = Rates { bitrate: skin.bitrate, data_bitrate: skin.data_bitrate };
            let (index, was_up) = (interface.index, interface.up);
            self.steps.push(Step::SetRates { name, index, rates, before, was_up });
            return Ok(());
        }
        if !agrees {
            let wants = wanted_rates(skin);
            return Err(Refusal::Rates { name, has: before, wants, file });
        }
        if !wide {
            return Err(Refusal::HardwareNarrow { name, what, mtu: interface.mtu, file });
        }
        Err(Refusal::HardwareDown { name, what, file })
    }
}

/// Whether hardware has the bit rates that a skin names; what it does not name may be anything.
#[must_use]
pub fn agrees(skin: &SkinBus, hardware: &Hardware) -> bool {
    Rates::of(hardware).meet(Rates { bitrate: skin.bitrate, data_bitrate: skin.data_bitrate })
}

/// A controller's clock is divided by whole numbers: it may miss what was asked for, by less than the nodes
/// of a bus may differ.
fn near(wanted: Option<u32>, has: Option<u32>) -> bool {
    wanted.is_none_or(|wanted| has.is_some_and(|has| u64::from(wanted.abs_diff(has)) * 200 <= wanted.into()))
}

/// The bit rates that hardware has, in words.
#[must_use]
pub fn set_rates(hardware: &Hardware) -> String {
    Rates::of(hardware).to_string()
}

/// The bit rates that a skin names, in words.
#[must_use]
pub fn wanted_rates(skin: &SkinBus) -> String {
    Rates { bitrate: skin.bitrate, data_bitrate: skin.data_bitrate }.to_string()
}

/// What has to be done so that none of the wanted interfaces is left that this program has made.
///
/// # Errors
/// When an interface was named that is not ours. Buses of a skin are left alone instead.
pub fn down(wanted: &[Wanted], present: &[Interface]) -> Result<Plan, Refusal> {
    let mut plan = Plan::default();
    for wanted in wanted {
        let name = wanted.name.clone();
        if plan.steps.iter().any(|step| step.name() == name) {
            continue;
        }
        match (find(present, &name), &wanted.skin) {
            (None, _) => plan.left.push(format!("{name} is not there")),
            (Some(interface), _) if interface.ours && interface.is_virtual() => {
                let with = removed_with(&plan, interface, present);
                if !with {
                    plan.steps.push(Step::Remove { name, index: interface.index });
                }
            }
            (Some(interface), Some(_)) => {
                let what = interface.what();
                plan.left.push(format!("{name} is {what} that vcan-setup has not made, and is left alone"));
            }
            (Some(interface), None) => {
                let remedy = if interface.is_virtual() {
                    format!(": if it is yours, `sudo ip link del {name}` removes it")
                } else {
                    String::new()
                };
                return Err(Refusal::NotOurs { name, what: interface.what(), remedy });
            }
        }
    }
    Ok(plan)
}

/// Whether the other end of its pair, which takes this end with it, is removed already.
fn removed_with(plan: &Plan, interface: &Interface, present: &[Interface]) -> bool {
    let Kind::Vxcan(Some(Peer { index, place: Place::Here, .. })) = &interface.kind else { return false };
    let peer = present.iter().find(|other| other.index == *index);
    peer.is_some_and(|peer| plan.steps.iter().any(|step| step.name() == peer.name))
}

#[cfg(test)]
mod tests;
