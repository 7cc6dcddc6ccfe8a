//! Reasons why a plan is refused.

use protocol::usage::Failure;
use thiserror::Error;

use super::widen;
use crate::link::{FD_MTU, Interface, HardwareRates};

/// The reason why a plan is refused: one line, with the command that fixes it.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum Refusal {
    /// The interface does not carry CAN.
    #[error("{name} is real, {what}, and is left alone: choose another name, as `vcan-setup up vcan0` does")]
    NotCan {
        /// The name.
        name: String,
        /// A description of the interface.
        what: String,
    },
    /// CAN hardware was named where a virtual interface is made.
    #[error(
        "{name} is real, {what}, and is left alone: to check its bit rates put it into a skin and run `vcan-setup up SKIN.toml`, to see it `vcan-setup status {name}`"
    )]
    Hardware {
        /// The name.
        name: String,
        /// A description of the interface.
        what: String,
    },
    /// An interface of another program has too small an MTU.
    #[error(
        "{name} has MTU {mtu} and CAN FD needs {FD_MTU}; vcan-setup has not made it and leaves it alone: `sudo sh -c '{}'` fixes it",
        widen("ip", name)
    )]
    Narrow {
        /// The name.
        name: String,
        /// The MTU.
        mtu: u32,
    },
    /// An interface of another program is down.
    #[error(
        "{0} is down; vcan-setup has not made it and leaves it alone: `sudo ip link set {0} up` fixes it"
    )]
    Down(String),
    /// An interface that is not an end of the requested pair has its name.
    #[error("{name} is there already and is {what}, not one end of a pair with {peer}: {hint}")]
    OtherPair {
        /// The name.
        name: String,
        /// A description of the interface.
        what: String,
        /// The requested other end.
        peer: String,
        /// The action to take.
        hint: String,
    },
    /// The other end of an existing pair does not work.
    #[error(
        "the other end of {name}, {end}, and vcan-setup changes nothing there: `sudo {command}` fixes it"
    )]
    OtherEnd {
        /// The name.
        name: String,
        /// The other end and its fault.
        end: String,
        /// The command to run.
        command: String,
    },
    /// Both ends of a pair in one namespace have the same name.
    #[error(
        "{0} cannot be both ends of a pair in one network namespace: give --peer another name, or --namespace"
    )]
    OneName(String),
    /// Hardware is missing: the skin gives the bus a bit rate.
    #[error(
        "there is no interface {name}, and {file} gives it a bitrate, so it is hardware: plug it in and load its driver, or leave out bitrate and it will be a vcan"
    )]
    Absent {
        /// The name.
        name: String,
        /// The skin's file.
        file: String,
    },
    /// Two skins give one bus different bit rates.
    #[error("of {name} {one} and {other}: run `vcan-setup up` with one of them, or make them agree")]
    AtOdds {
        /// The name.
        name: String,
        /// The first skin and its rates.
        one: String,
        /// The second skin and its rates.
        other: String,
    },
    /// The hardware has other bit rates.
    #[error(
        "{name} is at {has} and {file} says {wants}: `sudo vcan-setup up {file} --set-bit-rates` sets them, or change {file}"
    )]
    Rates {
        /// The name.
        name: String,
        /// The present rates.
        has: HardwareRates,
        /// The rates of the skin.
        wants: HardwareRates,
        /// The skin's file.
        file: String,
    },
    /// The hardware is down.
    #[error(
        "{name} is {what}, and down: `sudo vcan-setup up {file} --set-bit-rates` sets its bit rates and brings it up"
    )]
    HardwareDown {
        /// The name.
        name: String,
        /// A description of the interface.
        what: String,
        /// The skin's file.
        file: String,
    },
    /// The hardware is in classic mode, but the skin requires CAN FD.
    #[error(
        "{name} is {what} with MTU {mtu}, and {file} says format = \"fd\", which needs {FD_MTU}: `sudo vcan-setup up {file} --set-bit-rates` switches it to CAN FD if it can, or use \"classic\""
    )]
    HardwareNarrow {
        /// The name.
        name: String,
        /// A description of the interface.
        what: String,
        /// The MTU.
        mtu: u32,
        /// The skin's file.
        file: String,
    },
    /// Bit rates are to be set, but the skin gives none.
    #[error("{file} has no {key} for {name}: put `{key} = {example}` under its [[bus]], then try again")]
    NoRate {
        /// The name.
        name: String,
        /// The missing key.
        key: &'static str,
        /// A common value.
        example: u32,
        /// The skin's file.
        file: String,
    },
    /// The interface to be removed was not made by this program.
    #[error("{name} is {what} that vcan-setup has not made, and is left alone{hint}")]
    NotOurs {
        /// The name.
        name: String,
        /// A description of the interface.
        what: String,
        /// The action to take.
        hint: String,
    },
}

impl Refusal {
    /// Returns the refusal for an interface that is not virtual.
    pub(super) fn real(interface: &Interface) -> Self {
        let (name, what) = (interface.name.clone(), interface.what());
        if interface.is_can() { Self::Hardware { name, what } } else { Self::NotCan { name, what } }
    }

    /// Returns true if the command line or the skin is wrong, rather than the state of the machine.
    #[must_use]
    pub const fn is_usage(&self) -> bool {
        match self {
            Self::NotCan { .. }
            | Self::Hardware { .. }
            | Self::OneName(_)
            | Self::AtOdds { .. }
            | Self::NoRate { .. }
            | Self::NotOurs { .. } => true,
            Self::Narrow { .. }
            | Self::Down(_)
            | Self::OtherPair { .. }
            | Self::OtherEnd { .. }
            | Self::Absent { .. }
            | Self::Rates { .. }
            | Self::HardwareDown { .. }
            | Self::HardwareNarrow { .. } => false,
        }
    }
}

impl From<Refusal> for Failure {
    fn from(refusal: Refusal) -> Self {
        if refusal.is_usage() { Self::usage(refusal) } else { Self::run(refusal) }
    }
}
