//! The network interfaces of the kernel, with the properties that matter for CAN.

use core::fmt;

use serde::Serialize;

/// The alias that marks the interfaces made by this program. `ip link show` prints it.
pub const ALIAS_MARK: &str = "skinbus";
/// The MTU in bytes of an interface that carries classic CAN only.
pub const CLASSIC_MTU: u32 = 16;
/// The MTU in bytes of an interface that carries classic CAN and CAN FD.
pub const FD_MTU: u32 = 72;

/// A network interface as the kernel reports it.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Interface {
    /// The index of the interface.
    pub index: u32,
    /// The name of the interface.
    pub name: String,
    /// The kind of the interface.
    pub kind: InterfaceKind,
    /// True if this program made the interface, which then has the alias [`ALIAS_MARK`].
    pub ours: bool,
    /// True if the interface is up.
    pub up: bool,
    /// The MTU in bytes: 16 for classic CAN, 72 for CAN FD, more for CAN XL.
    pub mtu: u32,
    /// The traffic counters.
    pub counters: InterfaceCounters,
}

/// The kind of an interface.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum InterfaceKind {
    /// A virtual CAN bus inside of the kernel.
    Vcan,
    /// One end of a pair of virtual interfaces. The other end may be in another network namespace.
    Vxcan(Option<Peer>),
    /// A CAN controller, or an adapter with a CAN driver.
    Hardware(CanHardware),
    /// An interface that does not carry CAN; the text describes it.
    Other(String),
}

impl InterfaceKind {
    /// Returns the kind of the interface in one word.
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

/// The other end of a pair of virtual interfaces.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Peer {
    /// The index of the other end in its own network namespace.
    pub index: u32,
    /// The name of the other end; `None` if this user may not read it.
    pub name: Option<String>,
    /// The name under /run/netns of the network namespace of the other end; `None` if that is this namespace or has no
    /// name.
    pub namespace: Option<String>,
    /// The id by which this namespace knows that of the other end; `None` if both ends are in this one.
    pub namespace_id: Option<i32>,
}

/// The properties of a CAN controller.
#[derive(Clone, Debug, Default, Eq, PartialEq, Serialize)]
pub struct CanHardware {
    /// The name of the driver.
    pub driver: Option<String>,
    /// The error state of the controller, by its error counters.
    pub state: Option<ControllerState>,
    /// The bit rate in bit/s; `None` if it is not set.
    pub bitrate: Option<u32>,
    /// The bit rate of CAN FD data in bit/s; `None` if it is not set.
    pub data_bitrate: Option<u32>,
    /// True if the controller is switched to CAN FD.
    pub fd: bool,
    /// True if the controller only listens: it can neither send nor acknowledge.
    pub listen_only: bool,
}

/// The nominal and the data bit rate of CAN hardware.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct HardwareRates {
    /// The bit rate in bit/s; `None` if it is not set.
    pub bitrate: Option<u32>,
    /// The bit rate of CAN FD data in bit/s; `None` for classic CAN.
    pub data_bitrate: Option<u32>,
}

impl CanHardware {
    /// Returns the bit rates in use; a controller in classic mode has no data bit rate.
    #[must_use]
    pub fn bit_rates(&self) -> HardwareRates {
        HardwareRates { bitrate: self.bitrate, data_bitrate: self.data_bitrate.filter(|_| self.fd) }
    }
}

impl HardwareRates {
    /// Returns true if both rates are within half a percent of those of `target`. A rate that `target` does not have
    /// may have any value.
    #[must_use]
    pub fn matches(self, target: Self) -> bool {
        // A controller derives bit rates from its clock by whole-number division, so the actual rate may differ a
        // little from the requested one. The nodes of a bus tolerate more than this difference.
        let near = |target: Option<u32>, has: Option<u32>| {
            let near = |target: u32, has: u32| u64::from(target.abs_diff(has)) * 200 <= target.into();
            target.is_none_or(|target| has.is_some_and(|has| near(target, has)))
        };
        near(target.bitrate, self.bitrate) && near(target.data_bitrate, self.data_bitrate)
    }
}

/// Formats rates as `500 kbit/s, data 83333 bit/s`.
impl fmt::Display for HardwareRates {
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

/// The error state of a controller.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "SCREAMING-KEBAB-CASE")]
pub enum ControllerState {
    /// Normal operation.
    ErrorActive,
    /// More than 96 errors.
    ErrorWarning,
    /// More than 127 errors: the controller no longer signals errors by destroying the frames of others.
    ErrorPassive,
    /// More than 255 errors: the controller neither sends nor receives.
    BusOff,
    /// The interface is down.
    Stopped,
    /// The controller sleeps.
    Sleeping,
}

impl ControllerState {
    /// Returns the state that the kernel reports as this number; `None` if there is none.
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

    /// Returns the name of the state, as `ip -details link` prints it.
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

/// Counts of the frames of an interface since it was made.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct InterfaceCounters {
    /// Frames received by the interface.
    pub received: u64,
    /// Frames sent by the interface.
    pub sent: u64,
    /// Frames dropped by the interface in either direction.
    pub dropped: u64,
    /// Frames in either direction that were damaged.
    pub errors: u64,
}

impl Interface {
    /// Returns true if the interface is virtual, so that this program may make and remove it.
    #[must_use]
    pub const fn is_virtual(&self) -> bool {
        matches!(self.kind, InterfaceKind::Vcan | InterfaceKind::Vxcan(_))
    }

    /// Returns the other end if the interface is one end of a pair.
    #[must_use]
    pub const fn peer(&self) -> Option<&Peer> {
        if let InterfaceKind::Vxcan(Some(peer)) = &self.kind { Some(peer) } else { None }
    }

    /// Returns the properties of the controller if the interface is hardware.
    #[must_use]
    pub const fn hardware(&self) -> Option<&CanHardware> {
        if let InterfaceKind::Hardware(hardware) = &self.kind { Some(hardware) } else { None }
    }

    /// Returns true if the interface carries CAN frames.
    #[must_use]
    pub const fn is_can(&self) -> bool {
        !matches!(self.kind, InterfaceKind::Other(_))
    }

    /// Describes the interface in an error: `a vcan`, `CAN hardware (kvaser_pci)`, `an ethernet interface`.
    #[must_use]
    pub fn description(&self) -> String {
        match &self.kind {
            InterfaceKind::Vcan => "a vcan".to_owned(),
            InterfaceKind::Vxcan(_) => "a vxcan".to_owned(),
            InterfaceKind::Hardware(CanHardware { driver: Some(driver), .. }) => {
                format!("CAN hardware ({driver})")
            }
            InterfaceKind::Hardware(_) => "CAN hardware".to_owned(),
            InterfaceKind::Other(what) => what.clone(),
        }
    }
}
