//! Decodes the kernel's message about an interface.

use std::path::Path;

use netlink_packet_route::link::{
    CanBitTiming, CanCtrlModeFlags, InfoCan, InfoData, InfoKind, LinkAttribute, LinkFlags, LinkHeader,
    LinkInfo, LinkLayerType,
};
use protocol::bus::netlink::link_attributes;

use crate::link::{
    ALIAS_MARK, CanHardware, ControllerState, Interface, InterfaceCounters, InterfaceKind, Peer,
};

/// Decodes the kernel's message about an interface. Returns `None` if it is incomplete.
pub(super) fn decode_interface(bytes: &[u8]) -> Option<Interface> {
    let header = LinkHeader::parse(bytes).ok()?;
    let is_can = header.link_layer_type == LinkLayerType::Can;
    let mut interface = Interface {
        index: header.index,
        name: String::new(),
        kind: InterfaceKind::Other(describe_non_can_interface(header.link_layer_type, None)),
        ours: false,
        up: header.flags.contains(LinkFlags::Up),
        mtu: 0,
        counters: InterfaceCounters::default(),
    };
    let (mut peer, mut namespace, mut info) = (None, None, Vec::new());
    for attribute in link_attributes(bytes) {
        if let LinkAttribute::IfName(name) = attribute {
            interface.name = name;
        } else if let LinkAttribute::IfAlias(alias) = attribute {
            interface.ours = alias == ALIAS_MARK;
        } else if let LinkAttribute::Mtu(mtu) = attribute {
            interface.mtu = mtu;
        } else if let LinkAttribute::Link(index) = attribute {
            peer = Some(index);
        } else if let LinkAttribute::LinkNetNsId(id) = attribute {
            namespace = Some(id);
        } else if let LinkAttribute::LinkInfo(given) = attribute {
            info = given;
        } else if let LinkAttribute::Stats64(stats) = attribute {
            interface.counters = InterfaceCounters {
                received: stats.rx_packets,
                sent: stats.tx_packets,
                dropped: stats.rx_dropped + stats.tx_dropped,
                errors: stats.rx_errors + stats.tx_errors,
            };
        }
    }
    let kind = info.iter().find_map(|it| if let LinkInfo::Kind(kind) = it { Some(kind) } else { None });
    let data = info.iter().find_map(|it| if let LinkInfo::Data(data) = it { Some(data) } else { None });
    interface.kind = match (is_can, kind) {
        (false, kind) => InterfaceKind::Other(describe_non_can_interface(header.link_layer_type, kind)),
        (true, Some(InfoKind::Vcan)) => InterfaceKind::Vcan,
        (true, Some(InfoKind::Vxcan)) => InterfaceKind::Vxcan(peer.map(|index| Peer {
            index,
            name: None,
            namespace: None,
            namespace_id: namespace,
        })),
        (true, _) => {
            let data = if let Some(InfoData::Can(data)) = data { data.as_slice() } else { &[] };
            InterfaceKind::Hardware(decode_hardware(data))
        }
    };
    Some(interface)
}

fn decode_hardware(data: &[InfoCan]) -> CanHardware {
    let mut hardware = CanHardware::default();
    let set = |timing: &CanBitTiming| Some(timing.bitrate).filter(|&rate| rate > 0);
    for attribute in data {
        if let InfoCan::BitTiming(timing) = attribute {
            hardware.bitrate = set(timing);
        } else if let InfoCan::DataBitTiming(timing) = attribute {
            hardware.data_bitrate = set(timing);
        } else if let InfoCan::State(state) = attribute {
            hardware.state = ControllerState::from_number(*state);
        } else if let InfoCan::CtrlMode(mode) = attribute {
            hardware.fd = mode.flags.contains(CanCtrlModeFlags::Fd);
            hardware.listen_only = mode.flags.contains(CanCtrlModeFlags::ListenOnly);
        }
    }
    hardware
}

/// Describes an interface that does not carry CAN, for errors.
fn describe_non_can_interface(layer: LinkLayerType, kind: Option<&InfoKind>) -> String {
    if layer == LinkLayerType::Loopback {
        return "the loopback interface".to_owned();
    }
    match kind {
        Some(kind) => format!("a network interface ({kind})"),
        None => format!("a network interface ({})", layer.to_string().to_lowercase()),
    }
}

/// Returns the name of the driver of an interface, as sysfs has it.
pub(super) fn driver_name(name: &str) -> Option<String> {
    let link = std::fs::read_link(Path::new("/sys/class/net").join(name).join("device/driver")).ok()?;
    Some(link.file_name()?.to_string_lossy().into_owned())
}
