//! Lists and changes the network interfaces of the kernel by rtnetlink.
//!
//! The module [`plan`](crate::plan) makes all decisions. This module chooses the index of a new interface itself. Later
//! operations use that index, so that they never affect another interface of the same name.

use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::os::fd::{AsFd, AsRawFd};
use std::thread::{self, ScopedJoinHandle};

use netlink_packet_core::{NLM_F_CREATE, NLM_F_DUMP, NLM_F_EXCL, NlasIterator, Parseable};
use netlink_packet_route::RouteNetlinkMessage;
use netlink_packet_route::link::{
    CanBitTiming, CanCtrlMode, CanCtrlModeFlags, InfoCan, InfoData, InfoKind, InfoVxcan, LinkAttribute,
    LinkFlags, LinkHeader, LinkInfo, LinkMessage,
};
use netlink_packet_route::nsid::{NsidAttribute, NsidMessage};
use protocol::bus::netlink::RtnetlinkSocket;
use rustix::io::Errno;
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use crate::link::{ALIAS_MARK, CanHardware, FD_MTU, HardwareRates, Interface, InterfaceKind, Peer};
use crate::namespace::NAMESPACE_DIRECTORY;
use crate::plan::{Step, StepAction};

mod reading;

use reading::{decode_interface, driver_name};

/// The length in bytes of the header before the attributes of a namespace message.
const NSID_HEADER_BYTES: usize = 4;
/// The maximum number of indices to try for a new interface if other programs take them at the same time. A pair takes
/// two.
const MAX_INDEX_ATTEMPTS: u32 = 64;

/// A netlink socket for the interfaces of one network namespace.
#[derive(Debug)]
pub struct Netlink {
    exchange: RtnetlinkSocket,
}

impl Netlink {
    /// Opens a socket in the namespace of the calling thread.
    ///
    /// # Errors
    /// Returns an error if the system does not provide netlink sockets.
    pub fn open() -> io::Result<Self> {
        RtnetlinkSocket::open().map(|exchange| Self { exchange })
    }

    /// Opens a socket in another network namespace. A socket stays in the namespace in which it was opened, so a
    /// temporary thread enters the namespace and opens the socket there.
    ///
    /// # Errors
    /// Returns an error if the namespace may not be entered, or if the file is not a namespace.
    pub fn open_in(namespace: &File) -> io::Result<Self> {
        let enter = || {
            move_into_link_name_space(namespace.as_fd(), Some(LinkNameSpaceType::Network))?;
            Self::open()
        };
        thread::scope(|scope| thread::Builder::new().spawn_scoped(scope, enter).map(ScopedJoinHandle::join))?
            .unwrap_or_else(|_| {
                Err(io::Error::other("the thread that entered the network namespace crashed"))
            })
    }

    /// Returns all interfaces of the namespace, sorted by index.
    ///
    /// # Errors
    /// Returns an error if the kernel does not answer.
    pub fn interfaces(&mut self) -> io::Result<Vec<Interface>> {
        let mut interfaces: Vec<_> =
            self.query_all_interfaces()?.iter().filter_map(|link| decode_interface(link)).collect();
        interfaces.sort_by_key(|interface| interface.index);
        let names: HashMap<_, _> =
            interfaces.iter().map(|interface| (interface.index, interface.name.clone())).collect();
        let mut namespaces = None;
        for interface in &mut interfaces {
            match &mut interface.kind {
                InterfaceKind::Vxcan(Some(Peer { index, name, namespace_id: None, .. })) => {
                    *name = names.get(index).cloned();
                }
                InterfaceKind::Vxcan(Some(Peer { index, name, namespace, namespace_id: Some(id) })) => {
                    let known = namespaces.get_or_insert_with(|| self.named_namespaces());
                    *namespace = known.get(id).cloned();
                    // The kernel tells the name of the other end only to users with access to its namespace.
                    *name = self.interface_name_in(*id, *index).ok().flatten();
                }
                InterfaceKind::Hardware(hardware) => hardware.driver = driver_name(&interface.name),
                InterfaceKind::Vcan | InterfaceKind::Vxcan(None) | InterfaceKind::Other(_) => {}
            }
        }
        Ok(interfaces)
    }

    /// Returns the kernel's message about each interface.
    fn query_all_interfaces(&mut self) -> io::Result<Vec<Vec<u8>>> {
        self.exchange.request(RouteNetlinkMessage::GetLink(LinkMessage::default()), NLM_F_DUMP)
    }

    /// Returns the id by which this namespace knows another one; `None` if it has no id.
    ///
    /// # Errors
    /// Returns an error if the kernel refuses.
    pub fn namespace_id(&mut self, namespace: &File) -> io::Result<Option<i32>> {
        let fd = u32::try_from(namespace.as_raw_fd()).map_err(io::Error::other)?;
        let mut message = NsidMessage::default();
        message.attributes.push(NsidAttribute::Fd(fd));
        let answers = self.exchange.request(RouteNetlinkMessage::GetNsId(message), 0)?;
        let attributes = answers.iter().filter_map(|answer| answer.get(NSID_HEADER_BYTES..));
        let mut ids =
            attributes.flat_map(NlasIterator::new).flatten().filter_map(|it| NsidAttribute::parse(&it).ok());
        Ok(ids
            .find_map(|it| if let NsidAttribute::Id(id) = it { Some(id) } else { None })
            .filter(|&id| id >= 0))
    }

    /// Returns the names of the namespaces that have an id in this one.
    fn named_namespaces(&mut self) -> HashMap<i32, String> {
        let mut names = HashMap::new();
        for entry in std::fs::read_dir(NAMESPACE_DIRECTORY).into_iter().flatten().flatten() {
            let id = File::open(entry.path()).and_then(|file| self.namespace_id(&file));
            if let Ok(Some(id)) = id {
                names.insert(id, entry.file_name().to_string_lossy().into_owned());
            }
        }
        names
    }

    fn interface_name_in(&mut self, namespace: i32, index: u32) -> io::Result<Option<String>> {
        let queried = link_message(index, [LinkAttribute::IfNetnsId(namespace)]);
        Ok(self.query_interface(queried)?.map(|interface| interface.name))
    }

    /// Queries the interface that a message identifies. Returns `None` if it does not exist.
    fn query_interface(&mut self, about: LinkMessage) -> io::Result<Option<Interface>> {
        let answers = self.exchange.request(RouteNetlinkMessage::GetLink(about), 0)?;
        Ok(answers.iter().find_map(|answer| decode_interface(answer)))
    }

    /// Makes a vcan interface, marks it and brings it up. Returns its index.
    ///
    /// # Errors
    /// Returns the kernel's error. The interface was then not made, or was removed again.
    pub fn make_vcan(&mut self, name: &str) -> io::Result<u32> {
        let index = self.add_interface(name, |_| Ok(vec![LinkInfo::Kind(InfoKind::Vcan)]))?;
        let marked = self.mark_and_set_up(index);
        self.undo_on_error(marked, Undo::Remove { index }).map(|_| index)
    }

    /// Makes a pair of virtual interfaces, marks both ends and brings them up. Returns the index of the end in this
    /// namespace.
    ///
    /// # Errors
    /// Returns the kernel's error. The pair was then not made, or was removed again.
    pub fn make_vxcan_pair(
        &mut self,
        name: &str,
        peer: &str,
        mut there: Option<(&File, &mut Self)>,
    ) -> io::Result<u32> {
        let mut peer_index = 0;
        let index = self.add_interface(name, |attempt| {
            let mut end =
                link_message(0, [LinkAttribute::IfName(peer.to_owned()), LinkAttribute::Mtu(FD_MTU)]);
            if let Some((namespace, there)) = &mut there {
                end.attributes.push(LinkAttribute::NetNsFd(namespace.as_raw_fd()));
                peer_index = there.free_index()? + attempt.number;
            } else {
                peer_index = attempt.index + 1;
            }
            end.header.index = peer_index;
            let data = InfoData::Vxcan(InfoVxcan::Peer(end));
            Ok(vec![LinkInfo::Kind(InfoKind::Vxcan), LinkInfo::Data(data)])
        })?;
        let marked = self.mark_and_set_up(index).and_then(|()| match there {
            Some((_, there)) => there.mark_and_set_up(peer_index),
            None => self.mark_and_set_up(peer_index),
        });
        self.undo_on_error(marked, Undo::Remove { index }).map(|_| index)
    }

    /// Returns an index that is higher than those of all interfaces.
    fn free_index(&mut self) -> io::Result<u32> {
        let links = self.query_all_interfaces()?;
        let indices = links.iter().filter_map(|link| LinkHeader::parse(link).ok()).map(|header| header.index);
        Ok(indices.max().unwrap_or(0) + 1)
    }

    /// Makes an interface with MTU 72, which is down. Returns its index. The index is chosen here, because the kernel
    /// does not report the one that it would choose, and the name might belong to another interface before it can be
    /// looked up.
    fn add_interface(
        &mut self,
        name: &str,
        mut info: impl FnMut(CreationAttempt) -> io::Result<Vec<LinkInfo>>,
    ) -> io::Result<u32> {
        let first = self.free_index()?;
        let mut number = 0;
        loop {
            let index = first + number;
            let info = LinkAttribute::LinkInfo(info(CreationAttempt { index, number })?);
            let message = link_message(
                index,
                [LinkAttribute::IfName(name.to_owned()), LinkAttribute::Mtu(FD_MTU), info],
            );
            let flags = NLM_F_CREATE | NLM_F_EXCL;
            match self.exchange.request(RouteNetlinkMessage::NewLink(message), flags) {
                Ok(_) => return Ok(index),
                // Another program has taken the index of the other end in the meantime.
                Err(error) if is_errno(&error, Errno::BUSY) && number < MAX_INDEX_ATTEMPTS => number += 2,
                // Another program has taken the index of this end. The kernel returns the same error if the name is
                // taken.
                Err(error)
                    if is_errno(&error, Errno::EXIST)
                        && number < MAX_INDEX_ATTEMPTS
                        && self.free_index()? > index =>
                {
                    number += 2;
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn mark_and_set_up(&mut self, index: u32) -> io::Result<()> {
        // The alias is set first. If a later step fails, the next command then recognises the interface and can remove
        // it.
        self.change_link(link_message(index, [LinkAttribute::IfAlias(ALIAS_MARK.to_owned())]))?;
        self.set_interface_up(index, true)
    }

    fn change_link(&mut self, message: LinkMessage) -> io::Result<()> {
        self.exchange.request(RouteNetlinkMessage::NewLink(message), 0).map(|_| ())
    }

    /// Brings an interface up or down.
    ///
    /// # Errors
    /// Returns the kernel's error.
    pub fn set_interface_up(&mut self, index: u32, up: bool) -> io::Result<()> {
        let mut message = link_message(index, []);
        message.header.change_mask = LinkFlags::Up;
        message.header.flags = if up { LinkFlags::Up } else { LinkFlags::empty() };
        self.change_link(message)
    }

    /// Sets the MTU of an interface, which must be down.
    ///
    /// # Errors
    /// Returns the kernel's error.
    pub fn set_mtu(&mut self, index: u32, mtu: u32) -> io::Result<()> {
        self.change_link(link_message(index, [LinkAttribute::Mtu(mtu)]))
    }

    /// Sets the bit rates of CAN hardware, which must be down. Without a data rate it is switched to classic CAN.
    ///
    /// # Errors
    /// Returns the driver's error.
    pub fn set_bit_rates(&mut self, index: u32, rates: HardwareRates) -> io::Result<()> {
        let fd = if rates.data_bitrate.is_some() { CanCtrlModeFlags::Fd } else { CanCtrlModeFlags::empty() };
        let mut data = vec![InfoCan::CtrlMode(CanCtrlMode { mask: CanCtrlModeFlags::Fd, flags: fd })];
        data.extend(rates.bitrate.map(|rate| InfoCan::BitTiming(CanBitTiming::new(rate))));
        data.extend(rates.data_bitrate.map(|rate| InfoCan::DataBitTiming(CanBitTiming::new(rate))));
        let info = vec![LinkInfo::Kind(InfoKind::Can), LinkInfo::Data(InfoData::Can(data))];
        self.change_link(link_message(index, [LinkAttribute::LinkInfo(info)]))
    }

    /// Checks that the actual bit rates are close enough to the requested ones, because drivers accept deviations of up
    /// to 5 %.
    fn check_bit_rates(&mut self, index: u32, target: HardwareRates) -> io::Result<()> {
        let nearest = self
            .query_interface(link_message(index, []))?
            .and_then(|it| it.hardware().map(CanHardware::bit_rates));
        match nearest.filter(|nearest| !nearest.matches(target)) {
            Some(nearest) => {
                let why = format!("the nearest bit rates that its clock allows are {nearest}");
                Err(io::Error::other(why))
            }
            None => Ok(()),
        }
    }

    /// Removes an interface. If it is one end of a pair, the kernel removes the other end too.
    ///
    /// # Errors
    /// Returns the kernel's error.
    pub fn remove(&mut self, index: u32) -> io::Result<()> {
        self.exchange.request(RouteNetlinkMessage::DelLink(link_message(index, [])), 0).map(|_| ())
    }

    /// Executes a step of a plan. Returns the action that undoes the step, if there is one.
    ///
    /// # Errors
    /// Returns the kernel's error. The part of the step that was already executed is then undone.
    pub fn execute_step(
        &mut self,
        step: &Step,
        there: Option<(&File, &mut Self)>,
    ) -> io::Result<Option<Undo>> {
        let restore = |index, mtu, up| Undo::Restore { index, mtu, rates: None, up };
        let Step { name, action } = step;
        match *action {
            StepAction::MakeVcan => self.make_vcan(name).map(|index| Some(Undo::Remove { index })),
            StepAction::MakePair { ref peer, .. } => {
                self.make_vxcan_pair(name, peer, there).map(|index| Some(Undo::Remove { index }))
            }
            StepAction::BringUp { index } => {
                self.set_interface_up(index, true).map(|()| Some(restore(index, None, false)))
            }
            StepAction::Widen { index, from, was_up } => {
                let done = self.set_interface_up(index, false).and_then(|()| self.set_mtu(index, FD_MTU));
                let done = done.and_then(|()| self.set_interface_up(index, true));
                self.undo_on_error(done, restore(index, Some(from), was_up)).map(Some)
            }
            StepAction::SetRates { index, rates, before, was_up } => {
                let undo = Undo::Restore { index, mtu: None, rates: Some(before), up: was_up };
                let down = if was_up { self.set_interface_up(index, false) } else { Ok(()) };
                let done = down
                    .and_then(|()| self.set_bit_rates(index, rates))
                    .and_then(|()| self.check_bit_rates(index, rates))
                    .and_then(|()| self.set_interface_up(index, true));
                self.undo_on_error(done, undo).map(Some)
            }
            StepAction::Remove { index } => self.remove(index).map(|()| None),
        }
    }

    fn undo_on_error(&mut self, done: io::Result<()>, undo: Undo) -> io::Result<Undo> {
        if done.is_err() {
            // The error of the step is reported, not one of undoing it.
            let _ = self.undo(&undo);
        }
        done.map(|()| undo)
    }

    /// Undoes a step that was executed.
    ///
    /// # Errors
    /// Returns the kernel's error.
    pub fn undo(&mut self, undo: &Undo) -> io::Result<()> {
        match *undo {
            Undo::Remove { index } => self.remove(index),
            Undo::Restore { index, mtu, rates, up } => {
                self.set_interface_up(index, false)?;
                if let Some(mtu) = mtu {
                    self.set_mtu(index, mtu)?;
                }
                // The kernel cannot remove a bit rate that was set once.
                if let Some(rates @ HardwareRates { bitrate: Some(_), .. }) = rates {
                    self.set_bit_rates(index, rates)?;
                }
                if up { self.set_interface_up(index, true) } else { Ok(()) }
            }
        }
    }
}

/// The action that undoes a step.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum Undo {
    /// Removes an interface, because the step made it.
    Remove {
        /// The index of the interface.
        index: u32,
    },
    /// Restores the settings of an interface, because the step changed them.
    Restore {
        /// The index of the changed interface.
        index: u32,
        /// The former MTU, if it was changed.
        mtu: Option<u32>,
        /// The former bit rates, if they were changed.
        rates: Option<HardwareRates>,
        /// True if the interface was up.
        up: bool,
    },
}

/// The arguments of one attempt to make an interface.
#[derive(Clone, Copy)]
struct CreationAttempt {
    index: u32,
    number: u32,
}

fn is_errno(error: &io::Error, errno: Errno) -> bool {
    error.raw_os_error() == Some(errno.raw_os_error())
}

/// Returns a netlink message about the interface with this index.
fn link_message(index: u32, attributes: impl IntoIterator<Item = LinkAttribute>) -> LinkMessage {
    let mut message = LinkMessage::default();
    message.header.index = index;
    message.attributes.extend(attributes);
    message
}
