//! SocketCAN: buses that are network interfaces of the kernel.

use std::io;
use std::os::fd::{AsFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{AddressFamily, Protocol, SocketFlags, SocketType, sockopt};
use socketcan::{CanAddr, CanFdSocket, CanFilter, Socket, SocketOptions};

use super::batch::{Datagram, ReceiveBatch};
use super::carrier::{BusBackend, OpenedSocket};
use super::link::NetworkInterface;
use super::{Bus, BusError, BusOptions, Filter};

/// The MTU of an interface that carries CAN FD.
const FD_MTU: u32 = 72;

/// Default size in bytes of a gateway's receive buffer for each bus: room for the answers of all cells to a report at
/// once.
pub const GATEWAY_RECEIVE_BUFFER_BYTES: u32 = 8 << 20;

/// Returns true if the kernel has `CAN_RAW` sockets. Any error except "protocol not supported" counts as
/// true.
#[must_use]
pub fn has_socketcan() -> bool {
    !matches!(probe_can_raw(), Err(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT))
}

/// Returns true if there is an interface of this name, CAN or not. Any error except "no such device" counts
/// as true.
pub(super) fn has_interface(name: &str) -> bool {
    !NetworkInterface::query(name)
        .is_err_and(|error| matches!(error.raw_os_error(), Some(libc::ENODEV | libc::ENXIO)))
}

fn probe_can_raw() -> Result<OwnedFd, Errno> {
    let protocol = u32::try_from(libc::CAN_RAW).ok().and_then(std::num::NonZeroU32::new);
    let protocol = protocol.map(Protocol::from_raw);
    rustix::net::socket_with(AddressFamily::CAN, SocketType::RAW, SocketFlags::CLOEXEC, protocol)
}

/// SocketCAN interfaces.
pub(super) struct SocketCanBackend;

impl BusBackend for SocketCanBackend {
    fn open(&self, name: &str, options: &BusOptions) -> Result<OpenedSocket, BusError> {
        let own = || name.to_owned();
        let failed = |source: io::Error| match source.raw_os_error() {
            Some(libc::ENETDOWN) => BusError::Down(own()),
            _ => BusError::open_error(name, "open", source),
        };
        match probe_can_raw() {
            Ok(_) => {}
            Err(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT) => return Err(BusError::NoSocketCan(own())),
            Err(errno) => return Err(failed(errno.into())),
        }
        let link = NetworkInterface::query(name).map_err(|source| match source.raw_os_error() {
            Some(libc::ENODEV | libc::ENXIO) => BusError::NoInterface(own()),
            _ => failed(source),
        })?;
        let socket = CanFdSocket::open_addr(&CanAddr::new(link.index));
        let socket = socket.map_err(|source| match source.raw_os_error() {
            Some(libc::ENODEV) => BusError::NotCan(own()),
            _ => failed(source),
        })?;
        if !link.up {
            return Err(BusError::Down(own()));
        }
        if options.fd && link.mtu < FD_MTU {
            return Err(BusError::ClassicOnly { name: own(), mtu: link.mtu });
        }
        let granted = configure_socket(&socket, options).map_err(failed)?;
        Ok(OpenedSocket { socket, receive_buffer: granted, is_timed: false })
    }

    fn set_filters(&self, bus: &Bus, filters: &[Filter]) -> Result<(), BusError> {
        set_filters(&bus.socket, filters).map_err(|error| bus.io_error("set the filters of", error))
    }

    fn is_virtual(&self, name: &str) -> io::Result<bool> {
        NetworkInterface::query(name).map(|link| link.is_virtual)
    }

    fn is_own(&self, frame: Datagram<'_>) -> bool {
        frame.is_own()
    }

    fn decode_drop_notice(&self, _notice: &[u8]) -> Option<u32> {
        None
    }

    fn bus_error(&self, errno: Errno) -> Option<fn(String) -> BusError> {
        match errno {
            Errno::NETDOWN | Errno::NETUNREACH => Some(BusError::Down),
            Errno::NODEV | Errno::NXIO => Some(BusError::Gone),
            _ => None,
        }
    }
}

/// Sets the options of a new socket. Returns the size of its receive buffer.
fn configure_socket(socket: &CanFdSocket, options: &BusOptions) -> io::Result<usize> {
    set_filters(socket, &options.filters)?;
    socket.set_error_filter(options.error_mask)?;
    let fd = libc::c_int::from(options.fd);
    socket.set_socket_option_int(socketcan::socket::SOL_CAN_RAW, libc::CAN_RAW_FD_FRAMES, fd)?;
    socket.set_recv_own_msgs(options.own_frames)?;
    socket.set_recv_timestamp(true)?;
    socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RXQ_OVFL, 1)?;
    discard_received_frames(socket);
    set_receive_buffer(socket, options.receive_buffer)
}

fn set_filters(socket: &CanFdSocket, filters: &[Filter]) -> io::Result<()> {
    let filters: Vec<_> = filters.iter().map(|filter| CanFilter::from((filter.id, filter.mask))).collect();
    socket.set_filters(&filters)
}

/// Sets the receive buffer of a socket in bytes. Returns the granted size as the kernel counts it: twice the
/// requested size if it was granted in full.
///
/// # Errors
/// Returns an error if the system call fails. A smaller size than requested is not an error.
pub fn set_receive_buffer(socket: impl AsFd, bytes: usize) -> io::Result<usize> {
    // Exceeding the system's limit requires CAP_NET_ADMIN.
    if sockopt::set_socket_recv_buffer_size_force(&socket, bytes).is_err() {
        sockopt::set_socket_recv_buffer_size(&socket, bytes)?;
    }
    Ok(sockopt::socket_recv_buffer_size(&socket)?)
}

/// Discards frames that arrived between the creation of the socket and the setting of its filters.
fn discard_received_frames(socket: &CanFdSocket) {
    let mut batch = ReceiveBatch::new();
    for _ in 0..16 {
        if batch.receive(socket).is_err() {
            break;
        }
    }
}

/// Sets the policy `SCHED_BATCH` for this thread and its future children, so that they do not preempt a
/// running process when they wake up. Returns true if the system granted it.
///
/// The processes of a bench wake each other hundreds of times a second: the cells, and the server of their bus. Without
/// this policy, every cell that receives a frame preempts the server, at the cost of a context switch per frame.
pub fn set_batch_scheduling() -> bool {
    super::calls::set_sched_batch()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernel_grants_twice_what_it_may_and_less_is_no_error() {
        let flags = SocketFlags::CLOEXEC;
        let socket = rustix::net::socket_with(AddressFamily::UNIX, SocketType::DGRAM, flags, None).unwrap();
        assert_eq!(set_receive_buffer(&socket, 64 << 10).unwrap(), 128 << 10);
        let much = GATEWAY_RECEIVE_BUFFER_BYTES as usize;
        let granted = set_receive_buffer(&socket, much).unwrap();
        assert!(granted > 128 << 10 && granted <= 2 * much, "{granted}");
    }
}
