//! Events that a link reports while it runs.

use std::fmt;

/// An event of a link.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(crate) enum LinkEvent {
    /// Another host has linked the bus.
    Joined(String),
    /// A host has left or can no longer be reached; its name is given.
    Gone(String),
    /// A connection to another host failed or was refused; the error is given.
    Transport(String),
    /// The local bus cannot be used; the reason is given. The link tries to open it again.
    BusAway(String),
    /// The local bus is available again.
    BusBack,
    /// A host sent an invalid message. The fields are the name of the host and the error.
    Garbage(String, String),
    /// Frames that the link put on the local bus came back from it: the buses are joined in a circle.
    Circle,
    /// Two hosts use this name.
    SameName(String),
    /// Frames were lost since the last event of this kind.
    Lost {
        /// The number of lost frames from the local bus.
        from_here: u64,
        /// The number of lost frames from other hosts.
        from_others: u64,
    },
}

impl fmt::Display for LinkEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Joined(host) => write!(f, "host '{host}' has joined"),
            Self::Gone(host) => write!(f, "host '{host}' has left or cannot be reached"),
            Self::Transport(what) => f.write_str(what),
            Self::BusAway(why) => {
                write!(f, "the bus is unavailable ({why}); it is opened when it becomes available")
            }
            Self::BusBack => f.write_str("the bus is available again"),
            Self::Garbage(host, why) => write!(f, "host '{host}' sent invalid data: {why}"),
            Self::Circle => f.write_str(
                "frames from other hosts come back over this bus, and the link drops them: a second link or \
                 an adapter also connects the buses; remove one of the connections",
            ),
            Self::SameName(host) => {
                write!(f, "two hosts have the name '{host}': give each its own name with --host")
            }
            Self::Lost { from_here, from_others } => {
                write!(
                    f,
                    "the link lost {from_here} frames from this host and {from_others} from other hosts"
                )
            }
        }
    }
}
