//! The counts of a bus.

use rustix::io::Errno;

/// What a bus has done. `routed` is always `delivered + dropped + abandoned` when nothing waits.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[non_exhaustive]
pub struct Totals {
    /// Clients that were let in.
    pub clients: u64,
    /// Connections that were refused: no hello, or one of another version.
    pub refused: u64,
    /// Connections that were turned away because there was no file or memory for them.
    pub turned_away: u64,
    /// Clients that were given up because their socket failed, and the last reason.
    pub failed: u64,
    /// See above.
    pub failure: Option<Errno>,
    /// Frames taken from clients.
    pub frames: u64,
    /// Datagrams of clients that were neither a frame nor filters.
    pub garbage: u64,
    /// Frames times the clients that were to get them.
    pub routed: u64,
    /// Frames handed to clients' sockets.
    pub delivered: u64,
    /// Frames dropped because a client did not read; reported to it.
    pub dropped: u64,
    /// Frames that waited for a client that went away.
    pub abandoned: u64,
}
