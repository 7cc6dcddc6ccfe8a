//! What each kind of bus does in its own way.

use std::io;

use rustix::io::Errno;
use socketcan::CanFdSocket;

use super::batch::Datagram;
use super::{Bus, BusError, Filter, Options};

/// What each kind of bus does in its own way; the rest of [`Bus`] is the same for all.
pub(super) trait Carrier {
    /// Opens a bus with its filters set and time stamps on what arrives: the socket, and how many bytes may wait for
    /// it, as the kernel counts them.
    fn open(&self, name: &str, options: &Options) -> Result<(CanFdSocket, usize), BusError>;

    /// Replaces the filters.
    fn set_filters(&self, bus: &Bus, filters: &[Filter]) -> Result<(), BusError>;

    /// Whether nothing real hangs on the bus of this name.
    fn is_virtual(&self, name: &str) -> io::Result<bool>;

    /// Whether a frame came back to the very socket that sent it.
    fn is_own(&self, frame: Datagram<'_>) -> bool;

    /// How many frames were dropped so far, from a datagram that reports it instead of a frame.
    fn dropped(&self, notice: &[u8]) -> Option<u32>;

    /// The state of the bus that an error of an open socket shows, when it shows any.
    fn cause(&self, errno: Errno) -> Option<fn(String) -> BusError>;
}
