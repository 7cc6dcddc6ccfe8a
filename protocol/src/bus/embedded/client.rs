//! A client's connection to an embedded bus.

use std::io;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, sockopt};
use socketcan::{CanFdSocket, SocketOptions};

use super::{
    ClientHello, FilterPart, HELLO_VERSION, HelloReply, OWN_FRAME_BYTE_INDEX, decode_drop_notice,
    decode_refusal_notice, split_stamp,
};
use super::{default_directory, open_directory, socket_address};
use crate::bus::batch::{self, Datagram};
use crate::bus::carrier::{BusBackend, OpenedSocket};
use crate::bus::{Bus, BusError, BusOptions, Filter};

/// Maximum time to wait for a server, which answers at once unless it is stopped.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time until a server that is ending resets a new connection.
const CONNECTION_RESET_TIMEOUT: Duration = Duration::from_millis(50);
/// Size of the send buffer in bytes: room for some 700 FD frames, the answers of a whole skin to one message.
const SEND_BUFFER_BYTES: usize = 1 << 18;

/// The embedded bus: served by another process of this user.
pub(in crate::bus) struct EmbeddedBackend;

impl BusBackend for EmbeddedBackend {
    fn open(&self, name: &str, options: &BusOptions) -> Result<OpenedSocket, BusError> {
        let failed = |errno: Errno| BusError::open_error(name, "connect to", errno);
        let gone = |errno| match errno {
            // A busy client's hello comes after the server has turned the client away.
            Errno::PIPE | Errno::CONNRESET if is_served(name, options.directory.as_deref()) => {
                BusError::NoRoom(name.to_owned())
            }
            Errno::PIPE | Errno::CONNRESET => BusError::Closed(name.to_owned()),
            errno => failed(errno),
        };
        let no_answer = || BusError::NoAnswer { name: name.to_owned(), waited: ANSWER_TIMEOUT };
        let socket = CanFdSocket::from(connect(name, options.directory.as_deref())?);
        socket.set_recv_timestamp(true).map_err(|source| BusError::open_error(name, "set up", source))?;
        let hello = ClientHello {
            filters: options.filters.clone(),
            own_frames: options.own_frames,
            fd: options.fd,
            error_mask: options.error_mask,
            buffer: options.receive_buffer as u64,
            version: HELLO_VERSION,
            stamps: true,
        };
        rustix::net::send(&socket, &hello.encode(), SendFlags::NOSIGNAL).map_err(gone)?;
        let wait = Timespec::try_from(ANSWER_TIMEOUT).unwrap_or_default();
        let mut polled = [PollFd::new(&socket, PollFlags::IN)];
        if rustix::io::retry_on_intr(|| poll(&mut polled, Some(&wait))).map_err(failed)? == 0 {
            return Err(no_answer());
        }
        let mut bytes = [0; 64];
        let (len, _) = rustix::net::recv(&socket, &mut bytes, RecvFlags::DONTWAIT).map_err(gone)?;
        sockopt::set_socket_timeout(&socket, sockopt::Timeout::Send, None).map_err(failed)?;
        // A server that is ending resets the connection; one without room hangs up without an answer.
        if len == 0 {
            return Err(BusError::NoRoom(name.to_owned()));
        }
        match HelloReply::decode(bytes.get(..len).unwrap_or_default()) {
            Some(HelloReply::Welcome { granted, stamps: is_timed, .. }) => {
                let receive_buffer = usize::try_from(granted).unwrap_or(usize::MAX);
                Ok(OpenedSocket { socket, receive_buffer, is_timed })
            }
            Some(HelloReply::Refused { version }) => {
                Err(BusError::Refused { name: name.to_owned(), ours: HELLO_VERSION, theirs: version })
            }
            None => Err(closed_error(name, options.directory.as_deref())),
        }
    }

    fn set_filters(&self, bus: &Bus, filters: &[Filter]) -> Result<(), BusError> {
        let parts: Vec<_> = FilterPart::split_filters(filters).map(|part| part.encode()).collect();
        let send = |sent| parts.get::<usize>(sent).map_or(Ok(0), |part| batch::send_one(&bus.socket, part));
        Ok(bus.send_items(parts.len(), send)?)
    }

    fn is_virtual(&self, _name: &str) -> io::Result<bool> {
        Ok(true)
    }

    fn is_own(&self, frame: Datagram<'_>) -> bool {
        frame.bytes().and_then(|bytes| bytes.get(OWN_FRAME_BYTE_INDEX)) == Some(&1)
    }

    fn decode_drop_notice(&self, notice: &[u8]) -> Option<u32> {
        decode_drop_notice(notice)
    }

    fn split_stamp<'b>(&self, datagram: &'b [u8]) -> (&'b [u8], Option<u64>) {
        split_stamp(datagram)
    }

    fn decode_refusal_notice(&self, notice: &[u8]) -> Option<u32> {
        decode_refusal_notice(notice).map(|(total, _)| total)
    }

    fn bus_error(&self, errno: Errno) -> Option<fn(String) -> BusError> {
        matches!(errno, Errno::PIPE | Errno::CONNRESET | Errno::NOTCONN).then_some(BusError::Closed)
    }
}

/// Returns the error for a lost connection: [`BusError::Closed`] if the server has ended, [`BusError::HungUp`] if it
/// still serves other clients.
pub(in crate::bus) fn closed_error(name: &str, directory: Option<&Path>) -> BusError {
    if is_served(name, directory) {
        BusError::HungUp(name.to_owned())
    } else {
        BusError::Closed(name.to_owned())
    }
}

/// Returns true if a server accepts clients of a bus. A client that it turns away for want of room counts as accepted.
fn is_served(name: &str, directory: Option<&Path>) -> bool {
    connect(name, directory).is_ok_and(|socket| is_kept_open(&socket))
}

/// Returns true if a server keeps a new connection open. A server that is ending resets new connections.
fn is_kept_open(socket: &OwnedFd) -> bool {
    let wait = Timespec::try_from(CONNECTION_RESET_TIMEOUT).unwrap_or_default();
    let mut polled = [PollFd::new(socket, PollFlags::IN)];
    let is_quiet = rustix::io::retry_on_intr(|| poll(&mut polled, Some(&wait))) == Ok(0);
    is_quiet || rustix::net::recv(socket, &mut [0; 64], RecvFlags::DONTWAIT).is_ok()
}

/// Connects to a server. The connection may still wait to be accepted by the server, so a timeout limits sending on it.
pub(super) fn connect(name: &str, directory: Option<&Path>) -> Result<OwnedFd, BusError> {
    let directory = directory.map_or_else(default_directory, Path::to_owned);
    let failed = |errno: Errno| BusError::open_error(name, "connect to", errno);
    let not_served = || BusError::NotServed { name: name.to_owned(), directory: directory.clone() };
    open_directory(&directory)
        .map_err(|error| if error.is_absent() { not_served() } else { error.into() })?;
    let address = socket_address(&directory, name)?;
    let socket = seqpacket_socket(SocketFlags::empty()).map_err(failed)?;
    // `connect` blocks while the server's queue of new clients is full; the timeout limits that.
    sockopt::set_socket_timeout(&socket, sockopt::Timeout::Send, Some(ANSWER_TIMEOUT)).map_err(failed)?;
    sockopt::set_socket_send_buffer_size(&socket, SEND_BUFFER_BYTES).map_err(failed)?;
    match rustix::net::connect(&socket, &address) {
        Ok(()) => Ok(socket),
        Err(Errno::NOENT | Errno::CONNREFUSED) => Err(not_served()),
        Err(Errno::AGAIN) => Err(BusError::NoAnswer { name: name.to_owned(), waited: ANSWER_TIMEOUT }),
        Err(errno) => Err(failed(errno)),
    }
}

/// Creates a socket of the type that both ends of an embedded bus use.
///
/// # Errors
/// Returns an error if the system cannot create the socket.
pub fn seqpacket_socket(flags: SocketFlags) -> rustix::io::Result<OwnedFd> {
    rustix::net::socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags | SocketFlags::CLOEXEC, None)
}
