//! Opening a SocketCAN interface.

use std::io;
use std::os::fd::{AsFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{AddressFamily, Protocol, SocketFlags, SocketType, netdevice, sockopt};
use socketcan::{CanAddr, CanFdSocket, CanFilter, Socket, SocketOptions};

use super::batch::Batch;
use super::io as calls;
use super::{BusError, Filter, Options};

/// The MTU of an interface that carries CAN FD.
const FD_MTU: i32 = 72;

/// Bytes that a gateway lets wait unread in its socket of each bus, unless it is told another number: all cells may
/// answer a report at once.
pub const GATEWAY_RECEIVE_BUFFER: u32 = 8 << 20;

/// Whether the kernel has `CAN_RAW` sockets: anything but "no such protocol" counts as yes.
pub(super) fn has_socketcan() -> bool {
    !matches!(probe(), Err(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT))
}

fn probe() -> Result<OwnedFd, Errno> {
    let protocol = u32::try_from(libc::CAN_RAW).ok().and_then(std::num::NonZeroU32::new);
    let protocol = protocol.map(Protocol::from_raw);
    rustix::net::socket_with(AddressFamily::CAN, SocketType::RAW, SocketFlags::CLOEXEC, protocol)
}

/// Opens the interface with its filters in force: the socket, and how many bytes may wait for it.
pub(super) fn open(name: &str, options: &Options) -> Result<(CanFdSocket, usize), BusError> {
    let failed = |source: io::Error| match source.raw_os_error() {
        Some(libc::EPERM | libc::EACCES) => {
            BusError::Permission { name: name.to_owned(), doing: "open", source }
        }
        Some(libc::ENETDOWN) => BusError::Down { name: name.to_owned() },
        _ => BusError::Io { name: name.to_owned(), doing: "open", source },
    };
    let probe = match probe() {
        Ok(socket) => socket,
        Err(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT) => {
            return Err(BusError::NoSocketCan { name: name.to_owned() });
        }
        Err(errno) => return Err(failed(errno.into())),
    };
    let index = match netdevice::name_to_index(&probe, name) {
        Ok(index) => index,
        Err(Errno::NODEV | Errno::NXIO) => return Err(BusError::NoInterface { name: name.to_owned() }),
        Err(errno) => return Err(failed(errno.into())),
    };
    let socket =
        CanFdSocket::open_addr(&CanAddr::new(index)).map_err(|source| match source.raw_os_error() {
            Some(libc::ENODEV) => BusError::NotCan { name: name.to_owned() },
            _ => failed(source),
        })?;
    let interface = calls::interface(probe.as_fd(), name).map_err(failed)?;
    if !interface.up {
        return Err(BusError::Down { name: name.to_owned() });
    }
    if options.fd && interface.mtu < FD_MTU {
        return Err(BusError::ClassicOnly { name: name.to_owned(), mtu: interface.mtu });
    }

    set_filters(&socket, &options.filters).map_err(failed)?;
    socket.set_error_filter(options.error_mask).map_err(failed)?;
    socket
        .set_socket_option_int(socketcan::socket::SOL_CAN_RAW, libc::CAN_RAW_FD_FRAMES, options.fd.into())
        .map_err(failed)?;
    socket.set_recv_own_msgs(options.own_frames).map_err(failed)?;
    super::set_stamps(&socket).map_err(failed)?;
    socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RXQ_OVFL, 1).map_err(failed)?;
    discard(&socket);
    let granted = set_receive_buffer(&socket, options.receive_buffer).map_err(failed)?;
    Ok((socket, granted))
}

/// Puts filters in force, in place of those that were.
pub(super) fn set_filters(socket: &CanFdSocket, filters: &[Filter]) -> io::Result<()> {
    let filters: Vec<_> = filters.iter().map(|filter| CanFilter::from((filter.id, filter.mask))).collect();
    socket.set_filters(&filters)
}

/// Lets so many bytes wait unread in a socket of any sort; how many the kernel granted and counts, which is twice
/// what was asked for when all was granted.
///
/// # Errors
/// When the system refuses. To get less than was asked for is no error.
pub fn set_receive_buffer(socket: impl AsFd, bytes: usize) -> io::Result<usize> {
    // Forcing needs CAP_NET_ADMIN; without it the system's limit holds.
    if sockopt::set_socket_recv_buffer_size_force(&socket, bytes).is_err() {
        sockopt::set_socket_recv_buffer_size(&socket, bytes)?;
    }
    Ok(sockopt::socket_recv_buffer_size(&socket)?)
}

/// Throws away what came between the opening and the filters: no more than a default buffer holds.
fn discard(socket: &CanFdSocket) {
    let mut batch = Batch::new();
    for _ in 0..16 {
        if batch.receive(socket).is_err() {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernel_grants_twice_what_it_may_and_less_is_no_error() {
        let flags = SocketFlags::CLOEXEC;
        let socket = rustix::net::socket_with(AddressFamily::UNIX, SocketType::DGRAM, flags, None).unwrap();
        assert_eq!(set_receive_buffer(&socket, 64 << 10).unwrap(), 128 << 10);
        let much = GATEWAY_RECEIVE_BUFFER as usize;
        let granted = set_receive_buffer(&socket, much).unwrap();
        assert!(granted > 128 << 10 && granted <= 2 * much, "{granted}");
    }
}
