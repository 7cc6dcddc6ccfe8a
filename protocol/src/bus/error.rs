//! What can be wrong with a bus, in one line each: what, which value, what is allowed, what to do.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use thiserror::Error;

use super::Filter;
use super::embedded::DirectoryError;

/// Why a bus cannot be opened or used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BusError {
    /// No interface can have this name.
    #[error("{0:?} is no bus name: 1 to 15 bytes without spaces, '/' or ':', and not '.' or '..'")]
    Name(String),
    /// The kernel takes only so many filters.
    #[error("{got} filters are too many for one socket on {name}: at most {max}", max = Filter::MAX)]
    Filters {
        /// The bus.
        name: String,
        /// How many were requested.
        got: usize,
    },
    /// SocketCAN was requested and the kernel has none.
    #[error(
        "{0}: this kernel has no SocketCAN; load it with `modprobe can_raw`, or use the embedded bus \
         (--bus-kind embedded)"
    )]
    NoSocketCan(String),
    /// The kernel has SocketCAN and no such interface.
    #[error("there is no interface {0}: make it with `vcan-setup up {0}`, or plug it in if it is hardware")]
    NoInterface(String),
    /// An interface of another sort.
    #[error(
        "{0} is an interface, but no CAN interface: name one that `ip -br link show type can` or `type vcan` lists"
    )]
    NotCan(String),
    /// A classic interface where CAN FD is required.
    #[error(
        "{name} has MTU {mtu} and CAN FD needs 72: set it with `ip link set {name} down && ip link set \
         {name} mtu 72 up`, or use the classic format (CAN hardware: `vcan-setup doctor SKIN.toml` says how)"
    )]
    ClassicOnly {
        /// The interface.
        name: String,
        /// Its MTU in bytes.
        mtu: u32,
    },
    /// The interface is down: found when it was opened, or while it was in use. It may come back.
    #[error(
        "{0} is down: bring it up with `ip link set {0} up`; if that is refused, `vcan-setup doctor {0}` says why"
    )]
    Down(String),
    /// The interface was removed while it was in use.
    #[error("{0} was removed while it was in use: make it again and open it again")]
    Gone(String),
    /// Not allowed.
    #[error("not allowed to {doing} {name}: {source}")]
    Permission {
        /// The bus.
        name: String,
        /// What was tried.
        doing: &'static str,
        /// The system's error.
        source: io::Error,
    },
    /// Nobody serves this embedded bus.
    #[error(
        "no embedded bus {name} is served in {}: start `vcan-setup serve {name}`, or `skinbus run`, which \
         serves it", directory.display()
    )]
    NotServed {
        /// The bus.
        name: String,
        /// Where its socket would be.
        directory: PathBuf,
    },
    /// There is neither an interface nor an embedded bus of this name, and either would do.
    #[error(
        "there is no interface {name}, and no embedded bus of this name is served in {}: make the interface with \
         `vcan-setup up {name}`, or serve the bus with `vcan-setup serve {name}`", directory.display()
    )]
    Absent {
        /// The bus.
        name: String,
        /// Where its socket would be.
        directory: PathBuf,
    },
    /// The directory of embedded buses is not as private as it must be.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// The embedded bus uses another version, or did not understand the request.
    #[error(
        "the embedded bus {name} refuses: it speaks version {theirs}, this program version {ours}; use both from one build"
    )]
    Refused {
        /// The bus.
        name: String,
        /// The version of this program.
        ours: u8,
        /// The version of the bus.
        theirs: u8,
    },
    /// The embedded bus does not answer.
    #[error(
        "the embedded bus {name} did not answer within {} ms: is its server stopped, or out of files (`ulimit -n`)?",
        waited.as_millis()
    )]
    NoAnswer {
        /// The bus.
        name: String,
        /// How long it was waited for.
        waited: Duration,
    },
    /// The server of the embedded bus has no room for another client.
    #[error(
        "the embedded bus {0} has no room for another client: its server may have no more files open; end other clients, or \
         raise `ulimit -Hn` where it is started"
    )]
    TurnedAway(String),
    /// The server of the embedded bus has ended. The bus has to be opened again.
    #[error("the embedded bus {0} was closed: its server ended")]
    Closed(String),
    /// The server of the embedded bus has closed this connection, and goes on. The bus has to be opened again.
    #[error(
        "the embedded bus {0} was closed: its server hung up on this program alone and serves others still; attach again"
    )]
    HungUp(String),
    /// The queue stayed full.
    #[error("{name} took no frame for {} ms: its queue is full; send less, or ask whether anybody is on the bus", waited.as_millis())]
    Full {
        /// The bus.
        name: String,
        /// How long room was waited for.
        waited: Duration,
    },
    /// An FD frame for a bus that was opened for classic frames only.
    #[error("a CAN FD frame cannot be sent on {0}, which was opened for classic frames only")]
    FdFrame(String),
    /// Any other error of the system.
    #[error("cannot {doing} {name}: {source}")]
    Io {
        /// The bus.
        name: String,
        /// What was tried.
        doing: &'static str,
        /// The system's error.
        source: io::Error,
    },
}

impl BusError {
    /// The system does not let a bus be opened.
    pub(super) fn refused(name: &str, doing: &'static str, source: impl Into<io::Error>) -> Self {
        let (name, source) = (name.to_owned(), source.into());
        if source.kind() == io::ErrorKind::PermissionDenied {
            return Self::Permission { name, doing, source };
        }
        Self::Io { name, doing, source }
    }

    /// Whether the same bus may work again later without being opened again: it is down, or full.
    #[must_use]
    pub const fn may_pass(&self) -> bool {
        matches!(self, Self::Down(_) | Self::Full { .. })
    }

    /// Whether to open the bus again later may succeed without a change to this process.
    #[must_use]
    pub const fn may_open_later(&self) -> bool {
        matches!(
            self,
            Self::NotServed { .. }
                | Self::Absent { .. }
                | Self::NoAnswer { .. }
                | Self::TurnedAway(_)
                | Self::NoInterface(_)
                | Self::ClassicOnly { .. }
                | Self::Down(_)
                | Self::Gone(_)
                | Self::Closed(_)
                | Self::HungUp(_)
                | Self::Io { .. }
        )
    }

    /// Whether the bus has ended and has to be opened again.
    #[must_use]
    pub const fn is_closed(&self) -> bool {
        matches!(self, Self::Closed(_) | Self::HungUp(_) | Self::Gone(_))
    }
}

/// Not all frames were sent; those before were.
#[derive(Debug, Error)]
#[error("{cause} ({sent} of {target} frames sent)")]
pub struct SendError {
    /// How many frames were sent, from the first one on.
    pub sent: usize,
    /// How many there were.
    pub target: usize,
    /// What happened.
    #[source]
    pub cause: BusError,
}

impl From<SendError> for BusError {
    fn from(error: SendError) -> Self {
        error.cause
    }
}
