//! Steps of a plan, printed as text and as `ip` commands.

use core::fmt;

use crate::link::{ALIAS_MARK, FD_MTU, HardwareRates};
use crate::namespace::Namespace;

/// A step of a plan: an action on one interface.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Step {
    /// The name of the interface.
    pub name: String,
    /// The action.
    pub action: StepAction,
}

/// An action on an interface.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum StepAction {
    /// Makes a vcan with MTU 72, marks it, and brings it up.
    MakeVcan,
    /// Makes a pair with MTU 72, marks both ends, and brings them up.
    MakePair {
        /// The name of the other end.
        peer: String,
        /// The network namespace of the other end.
        namespace: Option<Namespace>,
    },
    /// Brings up an interface that this program has made.
    BringUp {
        /// The index of the interface.
        index: u32,
    },
    /// Gives an interface that this program has made MTU 72. It is taken down for this, and brought up again.
    Widen {
        /// The index of the interface.
        index: u32,
        /// The MTU before the step, in bytes.
        from: u32,
        /// True if the interface was up before the step.
        was_up: bool,
    },
    /// Sets the bit rates of CAN hardware. It is taken down for this, and brought up again.
    SetRates {
        /// The index of the interface.
        index: u32,
        /// The rates to be set.
        rates: HardwareRates,
        /// The bit rates before the step.
        before: HardwareRates,
        /// True if the interface was up before the step.
        was_up: bool,
    },
    /// Removes an interface that this program has made. If it is one end of a pair, the other end is removed too.
    Remove {
        /// The index of the interface.
        index: u32,
    },
}

impl Step {
    /// Returns the step in a short form, such as `make vcan0`.
    #[must_use]
    pub fn short_description(&self) -> String {
        let name = &self.name;
        match &self.action {
            StepAction::MakeVcan => format!("make {name}"),
            StepAction::MakePair { peer, .. } => format!("make {name} and its other end {peer}"),
            StepAction::BringUp { .. } => format!("bring {name} up"),
            StepAction::Widen { .. } => format!("change the MTU of {name}"),
            StepAction::SetRates { rates, .. } => format!("set {name} to {rates}"),
            StepAction::Remove { .. } => format!("remove {name}"),
        }
    }

    /// Returns the line that is printed when the step is done.
    #[must_use]
    pub fn done_message(&self) -> String {
        let name = &self.name;
        match &self.action {
            StepAction::MakeVcan => format!("made {name}, a vcan with MTU {FD_MTU}, and brought it up"),
            StepAction::MakePair { peer, namespace } => {
                let at = namespace.as_ref().map(|namespace| format!(" in {namespace}")).unwrap_or_default();
                format!(
                    "made {name} and its other end {peer}{at}, a vxcan pair with MTU {FD_MTU}, and brought both up"
                )
            }
            StepAction::BringUp { .. } => format!("{name} is up"),
            StepAction::Widen { .. } => format!("{name} has MTU {FD_MTU}, and is up"),
            StepAction::SetRates { rates, .. } => format!("{name} is up at {rates}"),
            StepAction::Remove { .. } => format!("{name} is removed"),
        }
    }

    /// Returns the `ip` command that has the same effect.
    #[must_use]
    pub fn command(&self) -> String {
        let name = &self.name;
        match &self.action {
            StepAction::MakeVcan => {
                format!(
                    "ip link add {name} mtu {FD_MTU} type vcan && ip link set {name} alias {ALIAS_MARK} up"
                )
            }
            StepAction::MakePair { peer, namespace } => {
                let (netns, ip) = match namespace {
                    Some(namespace) => (format!(" netns {namespace}"), namespace.ip_command()),
                    None => (String::new(), "ip".to_owned()),
                };
                format!(
                    "ip link add {name} mtu {FD_MTU} type vxcan peer name {peer} mtu {FD_MTU}{netns} && ip link set \
                     {name} alias {ALIAS_MARK} up && {ip} link set {peer} alias {ALIAS_MARK} up"
                )
            }
            StepAction::BringUp { .. } => format!("ip link set {name} up"),
            StepAction::Widen { .. } => set_fd_mtu_command("ip", name),
            StepAction::SetRates { rates: HardwareRates { bitrate, data_bitrate }, was_up, .. } => {
                let down = if *was_up { format!("ip link set {name} down && ") } else { String::new() };
                let bitrate = bitrate.unwrap_or(0);
                let fd = match data_bitrate {
                    Some(data) => format!("dbitrate {data} fd on"),
                    None => "fd off".to_owned(),
                };
                format!("{down}ip link set {name} type can bitrate {bitrate} {fd} && ip link set {name} up")
            }
            StepAction::Remove { .. } => format!("ip link del {name}"),
        }
    }
}

/// Returns the command that gives an interface MTU 72. The command begins with `ip`, which may select a namespace.
pub(crate) fn set_fd_mtu_command(ip: &str, name: &str) -> String {
    format!("{ip} link set {name} down && {ip} link set {name} mtu {FD_MTU} up")
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = &self.name;
        match &self.action {
            StepAction::MakeVcan => write!(f, "make {name}, a vcan with MTU {FD_MTU}, and bring it up"),
            StepAction::MakePair { peer, namespace } => {
                write!(f, "make {name} and its other end {peer}")?;
                if let Some(namespace) = namespace {
                    write!(f, " in the network namespace {namespace}")?;
                }
                write!(f, ", a vxcan pair with MTU {FD_MTU}, and bring both up")
            }
            StepAction::BringUp { .. } => write!(f, "bring {name} up"),
            StepAction::Widen { from, .. } => {
                write!(f, "take {name} down, give it MTU {FD_MTU} instead of {from}, and bring it up")
            }
            StepAction::SetRates { rates, before, .. } if rates == before => {
                write!(f, "bring {name} up, at {rates}")
            }
            StepAction::SetRates { rates, before, was_up, .. } => {
                let down = if *was_up { format!("take {name} down, ") } else { String::new() };
                write!(f, "{down}set {name} to {rates} instead of {before}, and bring it up")
            }
            StepAction::Remove { .. } => write!(f, "remove {name}"),
        }
    }
}
