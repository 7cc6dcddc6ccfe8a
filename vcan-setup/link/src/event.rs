//! What a link tells people while it runs.

use std::fmt;

/// What happened.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(crate) enum Event {
    /// Another host has linked the bus.
    Joined(String),
    /// A host is gone, or not reached any more.
    Gone(String),
    /// A connection failed, or was refused.
    Transport(String),
    /// The bus here is away, and why; it is tried again.
    BusAway(String),
    /// It is back.
    BusBack,
    /// A message of a host was none.
    Garbage(String, String),
    /// Frames of other hosts came back from the bus here: something makes a circle.
    Circle,
    /// Two hosts have this name.
    SameName(String),
    /// Frames were lost since the last report: dropped here on the way out, and of other hosts.
    Lost {
        /// From this bus.
        from_here: u64,
        /// From other hosts.
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
