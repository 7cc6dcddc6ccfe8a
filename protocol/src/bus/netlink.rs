//! Requests to the kernel over rtnetlink, and the complete lists of answers.

use std::io;
use std::os::fd::OwnedFd;
use std::time::Duration;

use netlink_packet_core::{
    ErrorBuffer, NLM_F_ACK, NLM_F_DUMP_INTR, NLM_F_REQUEST, NLMSG_DONE, NLMSG_ERROR, NetlinkBuffer,
    NetlinkHeader, NetlinkMessage, NetlinkPayload, NlasIterator, ParseableParametrized,
};
use netlink_packet_route::link::LinkAttribute;
use netlink_packet_route::{AddressFamily, RouteNetlinkMessage};
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::sockopt::{Timeout, set_socket_timeout};
use rustix::net::{RecvFlags, SendFlags, SocketFlags, SocketType};

/// Maximum time to wait for the kernel, which normally answers at once.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of attempts to read a list that the kernel changes while it is read.
const MAX_READ_ATTEMPTS: usize = 8;
/// Size of `struct ifinfomsg` in bytes; the attributes follow it.
const INTERFACE_HEADER_BYTES: usize = 16;

/// A netlink socket in the network namespace in which it was opened.
#[derive(Debug)]
pub struct RtnetlinkSocket {
    socket: OwnedFd,
    sequence: u32,
}

impl RtnetlinkSocket {
    /// Opens a socket in the calling thread's network namespace.
    ///
    /// # Errors
    /// Returns an error if the system cannot create the socket.
    pub fn open() -> io::Result<Self> {
        let socket = rustix::net::socket_with(
            rustix::net::AddressFamily::NETLINK,
            SocketType::RAW,
            SocketFlags::CLOEXEC,
            // NETLINK_ROUTE is protocol 0.
            None,
        )?;
        set_socket_timeout(&socket, Timeout::Recv, Some(ANSWER_TIMEOUT))?;
        rustix::net::connect(&socket, &SocketAddrNetlink::new(0, 0))?;
        Ok(Self { socket, sequence: 0 })
    }

    /// Sends a request and returns all answers, each without its netlink header.
    ///
    /// # Errors
    /// Returns the error that the kernel answers, or a timeout.
    pub fn request(&mut self, payload: RouteNetlinkMessage, flags: u16) -> io::Result<Vec<Vec<u8>>> {
        for _ in 0..MAX_READ_ATTEMPTS {
            let (answers, interrupted) = self.query(payload.clone(), flags)?;
            if !interrupted {
                return Ok(answers);
            }
        }
        Err(io::Error::other("the network interfaces changed during each attempt to read them: try again"))
    }

    fn query(&mut self, payload: RouteNetlinkMessage, flags: u16) -> io::Result<(Vec<Vec<u8>>, bool)> {
        self.sequence += 1;
        let mut header = NetlinkHeader::default();
        header.flags = NLM_F_REQUEST | NLM_F_ACK | flags;
        header.sequence_number = self.sequence;
        let mut message = NetlinkMessage::new(header, NetlinkPayload::InnerMessage(payload));
        message.finalize();
        let mut bytes = vec![0; message.buffer_len()];
        message.serialize(&mut bytes);
        rustix::net::send(&self.socket, &bytes, SendFlags::empty())?;

        let (mut answers, mut interrupted) = (Vec::new(), false);
        let mut buffer = vec![0; 1 << 17];
        loop {
            let (len, _) = rustix::io::retry_on_intr(|| {
                rustix::net::recv(&self.socket, &mut buffer[..], RecvFlags::empty())
            })?;
            let mut rest = buffer.get(..len).unwrap_or_default();
            while let Ok(answer) = NetlinkBuffer::new_checked(rest) {
                let len = (answer.length() as usize).next_multiple_of(4);
                rest = rest.get(len..).unwrap_or_default();
                if answer.sequence_number() != self.sequence {
                    continue;
                }
                interrupted |= answer.flags() & NLM_F_DUMP_INTR != 0;
                match answer.message_type() {
                    NLMSG_DONE => return Ok((answers, interrupted)),
                    NLMSG_ERROR => {
                        let error = ErrorBuffer::new_checked(answer.payload()).map_err(io::Error::other)?;
                        return match error.code() {
                            None => Ok((answers, interrupted)),
                            Some(code) => Err(io::Error::from_raw_os_error(code.get().abs())),
                        };
                    }
                    _ => answers.push(answer.payload().to_vec()),
                }
            }
        }
    }
}

/// Decodes the attributes of an interface in an answer. Unknown attributes are skipped, so that an unusual
/// interface does not hide the others.
pub fn link_attributes(answer: &[u8]) -> impl Iterator<Item = LinkAttribute> {
    NlasIterator::new(answer.get(INTERFACE_HEADER_BYTES..).unwrap_or_default())
        .flatten()
        .filter_map(|attribute| LinkAttribute::parse_with_param(&attribute, AddressFamily::Unspec).ok())
}
