//! Opening a SocketCAN interface.

use std::io;
use std::os::fd::{AsFd, OwnedFd};

use rustix::io::Errno;
use rustix::net::{AddressFamily, Protocol, SocketFlags, SocketType, netdevice, sockopt};
use socketcan::{CanAddr, CanFdSocket, CanFilter, Socket, SocketOptions};

use super::batch::Batch;
use super::io as calls;
use super::{BusError, Options};

/// The MTU of an interface that carries CAN FD.
const FD_MTU: i32 = 72;

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

    let filters: Vec<_> =
        options.filters.iter().map(|filter| CanFilter::from((filter.id, filter.mask))).collect();
    socket.set_filters(&filters).map_err(failed)?;
    socket.set_error_filter(options.error_mask).map_err(failed)?;
    socket
        .set_socket_option_int(socketcan::socket::SOL_CAN_RAW, libc::CAN_RAW_FD_FRAMES, options.fd.into())
        .map_err(failed)?;
    socket.set_recv_own_msgs(options.own_frames).map_err(failed)?;
    super::set_stamps(&socket).map_err(failed)?;
    socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RXQ_OVFL, 1).map_err(failed)?;
    discard(&socket);
    // Forcing needs CAP_NET_ADMIN; without it the system's limit holds, and what was granted is reported.
    if sockopt::set_socket_recv_buffer_size_force(&socket, options.receive_buffer).is_err() {
        sockopt::set_socket_recv_buffer_size(&socket, options.receive_buffer)
            .map_err(|errno| failed(errno.into()))?;
    }
    let granted = sockopt::socket_recv_buffer_size(&socket).map_err(|errno| failed(errno.into()))?;
    Ok((socket, granted))
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
