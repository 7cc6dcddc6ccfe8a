//! Why nothing is done.

use protocol::usage::Failure;
use thiserror::Error;

use super::widen;
use crate::link::{FD_MTU, Interface, Rates};

/// Why nothing is done: one line, with the command that fixes it.
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
        "{name} has MTU {mtu} and CAN FD needs {FD_MTU}; vcan-setup has not made it and leaves it alone: `sudo sh -c '{}'` fixes it",
        widen("ip", name)
    )]
    Narrow {
        /// Its name.
        name: String,
        /// Its MTU.
        mtu: u32,
    },
    /// Somebody else's, and down.
    #[error(
        "{0} is down; vcan-setup has not made it and leaves it alone: `sudo ip link set {0} up` fixes it"
    )]
    Down(String),
    /// A pair is requested where there is something else.
    #[error("{name} is there already and is {what}, not one end of a pair with {peer}: {hint}")]
    OtherPair {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
        /// The other end that was requested.
        peer: String,
        /// What to do.
        hint: String,
    },
    /// A pair that is there, and whose other end does not work.
    #[error(
        "the other end of {name}, {end}, and vcan-setup changes nothing there: `sudo {command}` fixes it"
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
        "{0} cannot be both ends of a pair in one network namespace: give --peer another name, or --namespace"
    )]
    OneName(String),
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
    /// Two skins that give one bus different bit rates.
    #[error("of {name} {one} and {other}: run `vcan-setup up` with one of them, or make them agree")]
    AtOdds {
        /// Its name.
        name: String,
        /// The value of the one.
        one: String,
        /// The value of the other.
        other: String,
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
        wants: Rates,
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
    /// Interfaces that were to be removed and that this program has not made.
    #[error("{name} is {what} that vcan-setup has not made, and is left alone{hint}")]
    NotOurs {
        /// Its name.
        name: String,
        /// What it is.
        what: String,
        /// What to do.
        hint: String,
    },
}

impl Refusal {
    /// Of what is not virtual, and is left alone.
    pub(super) fn real(interface: &Interface) -> Self {
        let (name, what) = (interface.name.clone(), interface.what());
        if interface.is_can() { Self::Hardware { name, what } } else { Self::NotCan { name, what } }
    }

    /// Whether the command line or the skin is wrong, and not the state of the machine.
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
