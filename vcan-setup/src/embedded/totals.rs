//! Counts of the frames and clients of an embedded bus.

use rustix::io::Errno;

/// Counts of a bus. `routed` equals `delivered + dropped + abandoned` if no frames are queued.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[non_exhaustive]
pub struct BusTotals {
    /// Accepted clients.
    pub clients: u64,
    /// Connections that were refused, because the hello was missing or had another version.
    pub refused: u64,
    /// Connections that were closed for lack of file descriptors or memory.
    pub turned_away: u64,
    /// Clients that were disconnected because their sockets failed.
    pub failed: u64,
    /// The error for which a client was last disconnected.
    pub failure: Option<Errno>,
    /// Frames received from clients.
    pub frames: u64,
    /// Datagrams from clients that were neither frames nor filters.
    pub garbage: u64,
    /// The number of deliveries: each frame is counted once for each of its receivers.
    pub routed: u64,
    /// Frames that were written to the sockets of clients.
    pub delivered: u64,
    /// Frames that were dropped because the client did not read. The client is told their number.
    pub dropped: u64,
    /// Frames that were queued for clients when these disconnected.
    pub abandoned: u64,
}
