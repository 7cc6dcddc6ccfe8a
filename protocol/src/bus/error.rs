//! Errors of a bus. Each message is one line with the name of the bus, the invalid value, the allowed values and a
//! remedy.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use thiserror::Error;

use super::Filter;
use super::embedded::DirectoryError;

/// The error for a bus that cannot be opened or used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BusError {
    /// The name is not valid for a bus.
    #[error(
        "{0:?} is not a valid bus name: use 1 to 15 bytes without spaces, '/' or ':', and not '.' or '..'"
    )]
    Name(String),
    /// There are more filters than the kernel accepts.
    #[error(
        "{got} filters are too many for a socket on {name}: use at most {max}",
        max = Filter::MAX_COUNT
    )]
    Filters {
        /// The bus.
        name: String,
        /// Requested number of filters.
        got: usize,
    },
    /// SocketCAN was requested, but the kernel does not support it.
    #[error(
        "{0}: this kernel has no SocketCAN; load it with `modprobe can_raw`, or use the embedded bus \
         (--bus-kind embedded)"
    )]
    NoSocketCan(String),
    /// The kernel supports SocketCAN, but there is no interface of this name.
    #[error("there is no interface {0}: make it with `vcan-setup up {0}`, or plug it in if it is hardware")]
    NoInterface(String),
    /// The interface is not a CAN interface.
    #[error("{0} is not a CAN interface: name one that `ip -br link show type can` or `type vcan` lists")]
    NotCan(String),
    /// CAN FD was requested on an interface for classic CAN.
    #[error(
        "{name} has MTU {mtu}, but CAN FD needs 72: set it with `ip link set {name} down && ip link set \
         {name} mtu 72 up`, or use the classic format (CAN hardware: `vcan-setup doctor SKIN.toml` shows \
         how)"
    )]
    ClassicOnly {
        /// The interface.
        name: String,
        /// MTU of the interface in bytes.
        mtu: u32,
    },
    /// The interface was down when it was opened, or went down later. It may come up again.
    #[error(
        "{0} is down: bring it up with `ip link set {0} up`; if that fails, `vcan-setup doctor {0}` shows why"
    )]
    Down(String),
    /// The interface was removed while it was in use.
    #[error("{0} was removed while it was in use: create it again, then open it again")]
    Gone(String),
    /// The process lacks permission.
    #[error("this program is not allowed to {doing} {name}: {source}")]
    Permission {
        /// The bus.
        name: String,
        /// The attempted operation, as the object of "cannot".
        doing: &'static str,
        /// The system's error.
        source: io::Error,
    },
    /// No process serves this embedded bus.
    #[error(
        "no embedded bus {name} is served in {}: start `vcan-setup serve {name}`, or `skinbus run`, which \
         serves it", directory.display()
    )]
    NotServed {
        /// The bus.
        name: String,
        /// The directory that was searched.
        directory: PathBuf,
    },
    /// There is neither a kernel interface nor an embedded bus of this name. Only
    /// [`Choice::Auto`](super::KindChoice::Auto) returns this.
    #[error(
        "there is no interface {name}, and no running program serves an embedded bus of this name in {}: make the \
         interface with `vcan-setup up {name}`, or serve the bus with `vcan-setup serve {name}`", directory.display()
    )]
    Absent {
        /// The bus.
        name: String,
        /// The directory that was searched.
        directory: PathBuf,
    },
    /// The directory of embedded buses cannot be used or is not private.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// The embedded bus uses another version, or did not understand the hello.
    #[error(
        "the embedded bus {name} refused the connection: it uses version {theirs}, this program uses version {ours}; \
         use both from the same build"
    )]
    Refused {
        /// The bus.
        name: String,
        /// The protocol version of this program.
        ours: u8,
        /// The protocol version of the server.
        theirs: u8,
    },
    /// The embedded bus did not answer in time.
    #[error(
        "the embedded bus {name} did not answer within {} ms: check that its server runs and has file \
         descriptors left (`ulimit -n`)",
        waited.as_millis()
    )]
    NoAnswer {
        /// The bus.
        name: String,
        /// Time for which the answer was awaited.
        waited: Duration,
    },
    /// The server of the embedded bus cannot accept another client.
    #[error(
        "the embedded bus {0} cannot accept another client: its server has no file descriptors left; end other clients, or \
         raise `ulimit -Hn` where the server is started"
    )]
    NoRoom(String),
    /// Frames take time on the embedded bus, which this client does not support.
    #[error(
        "frames take time on the embedded bus {0}, which serial lines, other hosts and conformance tests do not \
         support: serve it without --rates, or end the run with --bus-time real"
    )]
    TakesTime(String),
    /// The server of the embedded bus has ended. The bus must be opened again.
    #[error("the embedded bus {0} was closed: its server ended")]
    Closed(String),
    /// The server of the embedded bus has closed this connection, but still serves others. The bus must be
    /// opened again.
    #[error(
        "the embedded bus {0} was closed: its server disconnected this program, but still serves others; \
         connect again"
    )]
    HungUp(String),
    /// The transmit queue of the bus stayed full until the send timeout.
    #[error(
        "{name} accepted no frame for {} ms: its queue is full; send less, or check that another node is on the bus",
        waited.as_millis()
    )]
    Full {
        /// The bus.
        name: String,
        /// Time for which room was awaited.
        waited: Duration,
    },
    /// An FD frame cannot be sent on a bus that was opened for classic frames only.
    #[error("a CAN FD frame cannot be sent on {0}, which was opened for classic frames only")]
    FdFrame(String),
    /// Any other error of the system.
    #[error("cannot {doing} {name}: {source}")]
    Io {
        /// The bus.
        name: String,
        /// The attempted operation, as the object of "cannot".
        doing: &'static str,
        /// The system's error.
        source: io::Error,
    },
}

impl BusError {
    /// Converts an error of the system, returned when opening a bus, to the most specific bus error.
    pub(super) fn open_error(name: &str, doing: &'static str, source: impl Into<io::Error>) -> Self {
        let (name, source) = (name.to_owned(), source.into());
        if source.kind() == io::ErrorKind::PermissionDenied {
            return Self::Permission { name, doing, source };
        }
        Self::Io { name, doing, source }
    }

    /// Returns true if the error may pass while the bus stays open: the interface is down, or the transmit queue is
    /// full.
    #[must_use]
    pub const fn is_temporary(&self) -> bool {
        matches!(self, Self::Down(_) | Self::Full { .. })
    }

    /// Returns true if a later attempt to open the bus may succeed.
    #[must_use]
    pub const fn may_open_later(&self) -> bool {
        matches!(
            self,
            Self::NotServed { .. }
                | Self::Absent { .. }
                | Self::NoAnswer { .. }
                | Self::NoRoom(_)
                | Self::NoInterface(_)
                | Self::ClassicOnly { .. }
                | Self::Down(_)
                | Self::Gone(_)
                | Self::Closed(_)
                | Self::HungUp(_)
                | Self::Io { .. }
        )
    }

    /// Returns true if the connection has ended and the bus must be opened again.
    #[must_use]
    pub const fn is_closed(&self) -> bool {
        matches!(self, Self::Closed(_) | Self::HungUp(_) | Self::Gone(_))
    }
}

/// The error for a call that did not send all of its frames.
#[derive(Debug, Error)]
#[error("{cause} ({sent} of {total} frames sent)")]
pub struct SendError {
    /// Number of frames that were sent before the error.
    pub sent: usize,
    /// Number of frames that the call was to send.
    pub total: usize,
    /// The error that ended sending.
    #[source]
    pub cause: BusError,
}

impl From<SendError> for BusError {
    fn from(error: SendError) -> Self {
        error.cause
    }
}
