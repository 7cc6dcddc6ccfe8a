//! Network interfaces, queried over netlink. `/sys` is not used, because it may show another network namespace.

use std::io;

use netlink_packet_route::RouteNetlinkMessage;
use netlink_packet_route::link::{InfoKind, LinkAttribute, LinkFlags, LinkHeader, LinkInfo, LinkMessage};

use super::netlink::{RtnetlinkSocket, link_attributes};

/// A network interface.
#[derive(Clone, Copy, Debug)]
pub(super) struct NetworkInterface {
    pub(super) index: u32,
    /// MTU in bytes: 16 for classic CAN, 72 for CAN FD.
    pub(super) mtu: u32,
    /// True if the interface is up (`IFF_UP`).
    pub(super) up: bool,
    /// True if the kernel simulates the interface: a vcan, or an end of a vxcan.
    pub(super) is_virtual: bool,
}

impl NetworkInterface {
    /// Queries the kernel for the interface of this name.
    pub(super) fn query(name: &str) -> io::Result<Self> {
        let mut message = LinkMessage::default();
        message.attributes.push(LinkAttribute::IfName(name.to_owned()));
        let answers = RtnetlinkSocket::open()?.request(RouteNetlinkMessage::GetLink(message), 0)?;
        let answer = answers.first().map_or(&[][..], Vec::as_slice);
        let LinkHeader { index, flags, .. } = LinkHeader::parse(answer).map_err(io::Error::other)?;
        let mut link = Self { index, mtu: 0, up: flags.contains(LinkFlags::Up), is_virtual: false };
        for attribute in link_attributes(answer) {
            if let LinkAttribute::Mtu(mtu) = attribute {
                link.mtu = mtu;
            } else if let LinkAttribute::LinkInfo(infos) = attribute {
                let is_virtual = |info| matches!(info, &LinkInfo::Kind(InfoKind::Vcan | InfoKind::Vxcan));
                link.is_virtual = infos.iter().any(is_virtual);
            }
        }
        Ok(link)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loopback_interface_is_no_vcan_and_one_that_is_not_there_is_an_error() {
        assert!(!NetworkInterface::query("lo").unwrap().is_virtual);
        let error = NetworkInterface::query("nosuchcan0").unwrap_err();
        assert_eq!(error.raw_os_error(), Some(libc::ENODEV), "{error}");
    }
}
