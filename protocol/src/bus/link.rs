//! Whether an interface is real: asked of the kernel, because `/sys` may show another network.

use std::io;
use std::time::Duration;

use netlink_packet_core::{
    ErrorBuffer, NLM_F_REQUEST, NLMSG_ERROR, NetlinkBuffer, NetlinkHeader, NetlinkMessage, NetlinkPayload,
    NlasIterator, ParseableParametrized,
};
use netlink_packet_route::link::{InfoKind, LinkAttribute, LinkInfo, LinkMessage};
use netlink_packet_route::{AddressFamily, RouteNetlinkMessage};
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::sockopt::{Timeout, set_socket_timeout};
use rustix::net::{RecvFlags, SendFlags, SocketFlags, SocketType};

/// How long the kernel may take to answer; it answers at once.
const PATIENCE: Duration = Duration::from_secs(5);
/// Bytes of `struct ifinfomsg`, after which the attributes begin.
const HEADER: usize = 16;

/// Whether the interface is one that the kernel only simulates: a vcan, or an end of a vxcan.
pub(super) fn is_virtual(name: &str) -> io::Result<bool> {
    let answer = ask(name)?;
    let answer = NetlinkBuffer::new_checked(&answer).map_err(io::Error::other)?;
    if answer.message_type() == NLMSG_ERROR {
        let error = ErrorBuffer::new_checked(answer.payload()).map_err(io::Error::other)?;
        let code = error.code().map_or(0, |code| code.get().abs());
        return Err(io::Error::from_raw_os_error(code));
    }
    // What is not understood is left out: it says nothing of the kind.
    let attributes = NlasIterator::new(answer.payload().get(HEADER..).unwrap_or_default()).flatten();
    let attributes =
        attributes.filter_map(|it| LinkAttribute::parse_with_param(&it, AddressFamily::Unspec).ok());
    Ok(attributes.into_iter().any(|attribute| {
        let LinkAttribute::LinkInfo(infos) = attribute else { return false };
        infos.iter().any(|info| matches!(info, LinkInfo::Kind(InfoKind::Vcan | InfoKind::Vxcan)))
    }))
}

/// What the kernel answers when it is asked for an interface.
fn ask(name: &str) -> io::Result<Vec<u8>> {
    let (family, kind) = (rustix::net::AddressFamily::NETLINK, SocketType::RAW);
    // NETLINK_ROUTE is protocol 0.
    let socket = rustix::net::socket_with(family, kind, SocketFlags::CLOEXEC, None)?;
    set_socket_timeout(&socket, Timeout::Recv, Some(PATIENCE))?;
    rustix::net::connect(&socket, &SocketAddrNetlink::new(0, 0))?;

    let mut link = LinkMessage::default();
    link.attributes.push(LinkAttribute::IfName(name.to_owned()));
    let mut header = NetlinkHeader::default();
    header.flags = NLM_F_REQUEST;
    let payload = NetlinkPayload::InnerMessage(RouteNetlinkMessage::GetLink(link));
    let mut message = NetlinkMessage::new(header, payload);
    message.finalize();
    let mut bytes = vec![0; message.buffer_len()];
    message.serialize(&mut bytes);
    rustix::net::send(&socket, &bytes, SendFlags::empty())?;

    let mut answer = vec![0; 1 << 15];
    let receive = || rustix::net::recv(&socket, &mut answer[..], RecvFlags::empty());
    let (len, _) = rustix::io::retry_on_intr(receive)?;
    answer.truncate(len);
    Ok(answer)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loopback_interface_is_no_vcan_and_one_that_is_not_there_is_an_error() {
        assert!(!is_virtual("lo").unwrap());
        let error = is_virtual("nosuchcan0").unwrap_err();
        assert_eq!(error.raw_os_error(), Some(libc::ENODEV), "{error}");
    }
}
