//! What an interface of the kernel is, as far as a CAN bus is concerned.

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

/// The other end of a pair.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Peer {
    /// Its number, in its own namespace.
    pub index: u32,
    /// Its name, if it may be known.
    pub name: Option<String>,
    /// Where it is.
    pub place: Place,
}

/// Where the other end of a pair is.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum Place {
    /// In the same network namespace.
    Here,
    /// In the one that has this number here, and perhaps a name.
    Namespace {
        /// The number.
        id: i32,
        /// The name under /run/netns.
        name: Option<String>,
    },
}

/// A CAN controller.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Hardware {
    /// Its driver.
    pub driver: Option<String>,
    /// Bits in a second; `None` while none are set.
    pub bitrate: Option<u32>,
    /// Bits in a second of CAN FD data; `None` while none are set.
    pub data_bitrate: Option<u32>,
    /// Whether it is switched to CAN FD.
    pub fd: bool,
    /// Whether it only listens: it cannot send, nor acknowledge.
    pub listen_only: bool,
    /// What its error counters have come to.
    pub state: Option<State>,
}

/// How far a controller's error counters have brought it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
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
        match number {
            0 => Some(Self::ErrorActive),
            1 => Some(Self::ErrorWarning),
            2 => Some(Self::ErrorPassive),
            3 => Some(Self::BusOff),
            4 => Some(Self::Stopped),
            5 => Some(Self::Sleeping),
            _ => None,
        }
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
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
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

/// A bit rate for people: `500 kbit/s`, `83333 bit/s`.
#[must_use]
pub fn bit_rate(rate: u32) -> String {
    if rate.is_multiple_of(1_000) { format!("{} kbit/s", rate / 1_000) } else { format!("{rate} bit/s") }
}
