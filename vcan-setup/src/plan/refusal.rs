//! Reasons why a plan is refused.

use protocol::usage::Failure;
use thiserror::Error;

use super::set_fd_mtu_command;
use crate::link::{FD_MTU, HardwareRates, Interface};

/// The reason why a plan is refused. Its text is one line that contains a command to fix the cause.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum PlanRefusal {
    /// The interface does not carry CAN.
    #[error(
        "{name} is {what}, which vcan-setup does not change: choose another name, as in `vcan-setup up vcan0`"
    )]
    NotCan {
        /// The name of the interface.
        name: String,
        /// A description of the interface.
        what: String,
    },
    /// The named interface is CAN hardware, but the command makes virtual interfaces.
    #[error(
        "{name} is {what}, which vcan-setup does not change: to check its bit rates, add it to a skin and \
         run `vcan-setup up SKIN.toml`; `vcan-setup status {name}` shows them"
    )]
    Hardware {
        /// The name of the interface.
        name: String,
        /// A description of the interface.
        what: String,
    },
    /// The interface has too small an MTU, and another program has made it.
    #[error(
        "{name} has MTU {mtu}, but CAN FD needs {FD_MTU}; vcan-setup did not make it and does not change it: \
         `sudo sh -c '{}'` fixes it",
        set_fd_mtu_command("ip", name)
    )]
    Narrow {
        /// The name of the interface.
        name: String,
        /// The MTU of the interface, in bytes.
        mtu: u32,
    },
    /// The interface is down, and another program has made it.
    #[error(
        "{0} is down; vcan-setup did not make it and does not change it: `sudo ip link set {0} up` fixes it"
    )]
    Down(String),
    /// The name belongs to an interface that is not an end of the requested pair.
    #[error("{name} already exists and is {what}, not one end of a pair with {peer}: {hint}")]
    OtherPair {
        /// The name of the interface.
        name: String,
        /// A description of the interface.
        what: String,
        /// The name of the other end that was requested.
        peer: String,
        /// Advice to the user.
        hint: String,
    },
    /// The other end of an existing pair is down or has too small an MTU, and is in another namespace.
    #[error(
        "the other end of {name}, {end}; vcan-setup changes nothing in another namespace: `sudo {command}` \
         fixes it"
    )]
    OtherEnd {
        /// The name of the end in this namespace.
        name: String,
        /// The name of the other end, and what is wrong with it.
        end: String,
        /// The command that fixes it.
        command: String,
    },
    /// Both ends of a pair in one namespace were given one name.
    #[error(
        "{0} cannot be both ends of a pair in one network namespace: give another name to --peer, or add --namespace"
    )]
    OneName(String),
    /// The interface does not exist. It is hardware, because the skin states a bit rate for it.
    #[error(
        "there is no interface {name}, and {file} gives it a bitrate, so it is hardware: plug it in and load \
         its driver, or remove bitrate to get a vcan"
    )]
    Absent {
        /// The name of the interface.
        name: String,
        /// The path of the skin.
        file: String,
    },
    /// Two skins state different bit rates for the same bus.
    #[error(
        "two skins differ on the bit rates of {name}: {one}, but {other}; run `vcan-setup up` with one of \
         the skins, or correct one of them"
    )]
    AtOdds {
        /// The name of the bus.
        name: String,
        /// The first skin, and the bit rates in it.
        one: String,
        /// The second skin, and the bit rates in it.
        other: String,
    },
    /// The hardware has other bit rates than the skin states.
    #[error(
        "{name} runs at {has}, but {file} requires {wants}: `sudo vcan-setup up {file} --set-bit-rates` sets them, or change {file}"
    )]
    Rates {
        /// The name of the interface.
        name: String,
        /// The bit rates of the hardware.
        has: HardwareRates,
        /// The bit rates in the skin.
        wants: HardwareRates,
        /// The path of the skin.
        file: String,
    },
    /// The hardware is down.
    #[error(
        "{name} is {what}, but down: `sudo vcan-setup up {file} --set-bit-rates` sets its bit rates and \
         brings it up"
    )]
    HardwareDown {
        /// The name of the interface.
        name: String,
        /// A description of the interface.
        what: String,
        /// The path of the skin.
        file: String,
    },
    /// The hardware is set to classic CAN, but the skin requires CAN FD.
    #[error(
        "{name} is {what} with MTU {mtu}, but {file} has format = \"fd\", which needs {FD_MTU}: `sudo vcan-setup up {file} --set-bit-rates` tries CAN FD on it, or set format = \"classic\""
    )]
    HardwareNarrow {
        /// The name of the interface.
        name: String,
        /// A description of the interface.
        what: String,
        /// The MTU of the interface, in bytes.
        mtu: u32,
        /// The path of the skin.
        file: String,
    },
    /// The user requests that bit rates be set, but the skin states none.
    #[error("{file} has no {key} for {name}: put `{key} = {example}` under its [[bus]], then try again")]
    NoRate {
        /// The name of the bus.
        name: String,
        /// The key that is missing in the skin.
        key: &'static str,
        /// A common value of the key.
        example: u32,
        /// The path of the skin.
        file: String,
    },
    /// The interface is to be removed, but another program has made it.
    #[error("{name} is {what} that vcan-setup did not make, so it stays unchanged{hint}")]
    NotOurs {
        /// The name of the interface.
        name: String,
        /// A description of the interface.
        what: String,
        /// Advice to the user.
        hint: String,
    },
}

impl PlanRefusal {
    /// Returns the refusal to make or remove an interface that is not virtual.
    pub(super) fn not_virtual(interface: &Interface) -> Self {
        let (name, what) = (interface.name.clone(), interface.description());
        if interface.is_can() { Self::Hardware { name, what } } else { Self::NotCan { name, what } }
    }

    /// Returns true if the command line or a skin is wrong; false if the state of the machine is the reason.
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

impl From<PlanRefusal> for Failure {
    fn from(refusal: PlanRefusal) -> Self {
        if refusal.is_usage() { Self::usage_error(refusal) } else { Self::run_error(refusal) }
    }
}
