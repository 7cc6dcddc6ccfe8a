//! What an interface of the kernel is, as far as a CAN bus is concerned.

use core::fmt;

use serde::Serialize;

/// The alias (`ip link show` prints it) that marks what this program has made, and nothing else.
pub const MARK: &str = "skinbus";
/// The largest frame of an interface that carries classic CAN only.
pub const CLASSIC_MTU: u32 = 16;
/// The same of one that carries CAN FD too.
pub const FD_MTU: u32 = 72;

/// An interface.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Interface {
    /// Its number.
    pub index: u32,
    /// Its name.
    pub name: String,
    /// What it is.
    pub kind: Kind,
    /// Whether this program has made it: it bears the [`MARK`].
    pub ours: bool,
    /// Whether it is up.
    pub up: bool,
    /// The largest frame in bytes: 16 for classic CAN, 72 for CAN FD, more for CAN XL.
    pub mtu: u32,
    /// What went through it.
    pub counters: Counters,
}

/// What an interface is.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum Kind {
    /// A bus in the kernel.
    Vcan,
    /// One end of a pair, which may lead into another network namespace.
    Vxcan(Option<Peer>),
    /// A CAN controller, or an adapter that looks like one.
    Hardware(Hardware),
    /// No CAN at all: in words, what it is.
    Other(String),
}

impl Kind {
    /// In one word.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Vcan => "vcan",
            Self::Vxcan(_) => "vxcan",
            Self::Hardware(_) => "hardware",
            Self::Other(_) => "other",
        }
    }
}

/// The other end of a pair.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Peer {
    /// Its number, in its own namespace.
    pub index: u32,
    /// Its name, if it may be known.
    pub name: Option<String>,
    /// The name of its network namespace under /run/netns, if that is another one and has a name.
    pub namespace: Option<String>,
    /// The number that its network namespace has in this one; `None` when it is this one.
    pub namespace_id: Option<i32>,
}

/// A CAN controller.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Hardware {
    /// Its driver.
    pub driver: Option<String>,
    /// What its error counters have come to.
    pub state: Option<State>,
    /// Bits in a second; `None` while none are set.
    pub bitrate: Option<u32>,
    /// Bits in a second of CAN FD data; `None` while none are set.
    pub data_bitrate: Option<u32>,
    /// Whether it is switched to CAN FD.
    pub fd: bool,
    /// Whether it only listens: it cannot send, nor acknowledge.
    pub listen_only: bool,
}

/// Bit rates of CAN hardware.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Rates {
    /// Bits in a second; `None`: none are set.
    pub bitrate: Option<u32>,
    /// Bits in a second of CAN FD data; `None`: classic CAN.
    pub data_bitrate: Option<u32>,
}

impl Hardware {
    /// The bit rates that it has; in classic mode it has none for data.
    #[must_use]
    pub fn rates(&self) -> Rates {
        Rates { bitrate: self.bitrate, data_bitrate: self.data_bitrate.filter(|_| self.fd) }
    }
}

impl Rates {
    /// Whether these are the target's, within half a percent; a rate that the target leaves open may be anything.
    #[must_use]
    pub fn meet(self, target: Self) -> bool {
        // A controller's clock is divided by whole numbers: it may miss what was requested, by less than the
        // nodes of a bus may differ.
        let near = |target: Option<u32>, has: Option<u32>| {
            let near = |target: u32, has: u32| u64::from(target.abs_diff(has)) * 200 <= target.into();
            target.is_none_or(|target| has.is_some_and(|has| near(target, has)))
        };
        near(target.bitrate, self.bitrate) && near(target.data_bitrate, self.data_bitrate)
    }
}

/// For people: `500 kbit/s, data 83333 bit/s`.
impl fmt::Display for Rates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let words = |rate: u32| {
            if rate.is_multiple_of(1_000) {
                format!("{} kbit/s", rate / 1_000)
            } else {
                format!("{rate} bit/s")
            }
        };
        match (self.bitrate, self.data_bitrate) {
            (None, _) => f.write_str("no bit rate"),
            (Some(rate), None) => f.write_str(&words(rate)),
            (Some(rate), Some(data)) => write!(f, "{}, data {}", words(rate), words(data)),
        }
    }
}

/// How far a controller's error counters have brought it.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "SCREAMING-KEBAB-CASE")]
pub enum State {
    /// All is well.
    ErrorActive,
    /// More than 96 errors.
    ErrorWarning,
    /// More than 127: it must not destroy others' frames any more.
    ErrorPassive,
    /// More than 255: it takes no part any more.
    BusOff,
    /// Down.
    Stopped,
    /// Asleep.
    Sleeping,
}

impl State {
    /// The state by the number that the kernel gives it.
    #[must_use]
    pub const fn from_number(number: u32) -> Option<Self> {
        Some(match number {
            0 => Self::ErrorActive,
            1 => Self::ErrorWarning,
            2 => Self::ErrorPassive,
            3 => Self::BusOff,
            4 => Self::Stopped,
            5 => Self::Sleeping,
            _ => return None,
        })
    }

    /// The state's name, as `ip -details link` prints it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::ErrorActive => "ERROR-ACTIVE",
            Self::ErrorWarning => "ERROR-WARNING",
            Self::ErrorPassive => "ERROR-PASSIVE",
            Self::BusOff => "BUS-OFF",
            Self::Stopped => "STOPPED",
            Self::Sleeping => "SLEEPING",
        }
    }
}

/// What went through an interface since it was made.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct Counters {
    /// Frames received.
    pub received: u64,
    /// Frames sent.
    pub sent: u64,
    /// Frames that the interface dropped, either way.
    pub dropped: u64,
    /// Frames that were damaged, either way.
    pub errors: u64,
}

impl Interface {
    /// Whether it is made of software alone, so that it may be made and removed.
    #[must_use]
    pub const fn is_virtual(&self) -> bool {
        matches!(self.kind, Kind::Vcan | Kind::Vxcan(_))
    }

    /// The other end, of a pair.
    #[must_use]
    pub const fn peer(&self) -> Option<&Peer> {
        if let Kind::Vxcan(Some(peer)) = &self.kind { Some(peer) } else { None }
    }

    /// The controller, of hardware.
    #[must_use]
    pub const fn hardware(&self) -> Option<&Hardware> {
        if let Kind::Hardware(hardware) = &self.kind { Some(hardware) } else { None }
    }

    /// Whether it carries CAN frames.
    #[must_use]
    pub const fn is_can(&self) -> bool {
        !matches!(self.kind, Kind::Other(_))
    }

    /// What it is, in words: `a vcan`, `CAN hardware (kvaser_pci)`, `an ethernet interface`.
    #[must_use]
    pub fn what(&self) -> String {
        match &self.kind {
            Kind::Vcan => "a vcan".to_owned(),
            Kind::Vxcan(_) => "a vxcan".to_owned(),
            Kind::Hardware(Hardware { driver: Some(driver), .. }) => format!("CAN hardware ({driver})"),
            Kind::Hardware(_) => "CAN hardware".to_owned(),
            Kind::Other(what) => what.clone(),
        }
    }
}
