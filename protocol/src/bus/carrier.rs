//! The interface that each kind of bus implements.

use std::io;

use rustix::io::Errno;
use socketcan::CanFdSocket;

use super::batch::Datagram;
use super::{Bus, BusError, BusOptions, Filter};

/// A socket of an open bus.
pub(super) struct OpenedSocket {
    pub(super) socket: CanFdSocket,
    /// Size of the receive buffer, as the kernel counts it.
    pub(super) receive_buffer: usize,
    /// True if time stamps are those of a timed bus: ends of frames.
    pub(super) is_timed: bool,
}

/// The operations in which the kinds of buses differ; the rest of [`Bus`] is common to all.
pub(super) trait BusBackend {
    /// Opens a bus, with filters and time stamps enabled.
    fn open(&self, name: &str, options: &BusOptions) -> Result<OpenedSocket, BusError>;

    /// Returns the name under which a process serves the bus.
    fn served_name(&self, name: &str) -> String {
        name.to_owned()
    }

    /// Replaces the filters.
    fn set_filters(&self, bus: &Bus, filters: &[Filter]) -> Result<(), BusError>;

    /// Returns true if the bus of this name has no hardware.
    fn is_virtual(&self, name: &str) -> io::Result<bool>;

    /// Returns true if the socket that received this frame also sent it.
    fn is_own(&self, frame: Datagram<'_>) -> bool;

    /// Splits the bytes of a datagram into a frame and the time stamp that the bus gave it, if any.
    fn split_stamp<'b>(&self, datagram: &'b [u8]) -> (&'b [u8], Option<u64>) {
        (datagram, None)
    }

    /// Decodes a refusal notice and returns the number of frames refused so far; `None` for other datagrams.
    fn decode_refusal_notice(&self, _notice: &[u8]) -> Option<u32> {
        None
    }

    /// Decodes a drop notice and returns the number of frames dropped so far; `None` for other datagrams.
    fn decode_drop_notice(&self, notice: &[u8]) -> Option<u32>;

    /// Converts a system error of an open socket to the bus error that it means on this kind of bus; `None` if the
    /// error has no special meaning.
    fn bus_error(&self, errno: Errno) -> Option<fn(String) -> BusError>;
}
