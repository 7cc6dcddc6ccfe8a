//! What is done, one thing at a time: in words, and as `ip` would be told.

use core::fmt;

use crate::link::{FD_MTU, Hardware, MARK, bit_rate};
use crate::namespace::Namespace;

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
            None => format!("bitrate {bitrate} fd off"),
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

/// A controller's clock is divided by whole numbers: it may miss what was asked for, by less than the nodes
/// of a bus may differ.
fn near(wanted: Option<u32>, has: Option<u32>) -> bool {
    wanted.is_none_or(|wanted| has.is_some_and(|has| u64::from(wanted.abs_diff(has)) * 200 <= wanted.into()))
}
