//! Events that a link reports while it runs.

use std::fmt;

/// An event of a link.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(crate) enum Event {
    /// Another host has linked the bus.
    Joined(String),
    /// A host has left, or can no longer be reached.
    Gone(String),
    /// A connection failed or was refused.
    Transport(String),
    /// The local bus is unavailable, with the reason. It is reopened as soon as possible.
    BusAway(String),
    /// The local bus is available again.
    BusBack,
    /// A host sent an invalid message: its name, and the error.
    Garbage(String, String),
    /// Frames of other hosts came back from the local bus: the buses are joined in a circle.
    Circle,
    /// Two hosts have this name.
    SameName(String),
    /// Frames were lost since the last report.
    Lost {
        /// Frames of the local bus.
        from_here: u64,
        /// Frames of other hosts.
        from_others: u64,
    },
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Joined(host) => write!(f, "host '{host}' has joined"),
            Self::Gone(host) => write!(f, "host '{host}' is gone, or not reached"),
            Self::Transport(what) => f.write_str(what),
            Self::BusAway(why) => write!(f, "the bus is away ({why}); it is opened when it is there"),
            Self::BusBack => f.write_str("the bus is back"),
            Self::Garbage(host, why) => write!(f, "host '{host}' sent {why}"),
            Self::Circle => f.write_str(
                "frames of other hosts come back from this bus and are not sent once more: something else joins the buses too, \
                 such as a second link or an adapter; take one of them away",
            ),
            Self::SameName(host) => {
                write!(f, "two hosts call themselves '{host}': give each --host a name of its own")
            }
            Self::Lost { from_here, from_others } => {
                write!(f, "lost: {from_here} frames from here, {from_others} from other hosts")
            }
        }
    }
}
