//! The counts of a bus.

use rustix::io::Errno;

/// The counts of a bus. `routed` equals `delivered + dropped + abandoned` when no frames wait.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[non_exhaustive]
pub struct BusTotals {
    /// Accepted clients.
    pub clients: u64,
    /// Refused connections: no hello, or one of another version.
    pub refused: u64,
    /// Connections turned away for lack of files or memory.
    pub turned_away: u64,
    /// Clients given up because their socket failed.
    pub failed: u64,
    /// The last reason why a client was given up.
    pub failure: Option<Errno>,
    /// Frames received from clients.
    pub frames: u64,
    /// Datagrams of clients that were neither a frame nor filters.
    pub garbage: u64,
    /// Deliveries to be made: frames times their receivers.
    pub routed: u64,
    /// Frames written to clients' sockets.
    pub delivered: u64,
    /// Frames dropped because a client did not read; the client gets a report.
    pub dropped: u64,
    /// Frames that waited for a client that disconnected.
    pub abandoned: u64,
}
