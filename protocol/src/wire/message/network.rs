//! Network pages: the state of a cell, its counters, and its place in the tree.

use super::{MessageError, State};
use crate::id::Kind;
use crate::packet::{self, WORDS};

/// Value of the parent field in a tree page if the cell has no parent.
const NO_PARENT: u8 = 255;
/// A page with the state of a cell, its counters, or its place in the tree.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum NetworkPage {
    /// Page 0: the heartbeat.
    Heartbeat(Heartbeat),
    /// Page 1: counters of accepted packets.
    Received(ReceivedCounts),
    /// Page 2: counters of rejected frames, by reason.
    Rejected(RejectedCounts),
    /// Page 3: the place of the cell in the tree, and counters of sums.
    Tree(TreePage),
    /// Page 4: the state of each port.
    Ports(PortsPage),
}

/// Page 0: the heartbeat, sent four times a second and after each sync. The epoch byte is that of the last
/// accepted joints.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Heartbeat {
    /// Serial number of the cell.
    pub serial: u32,
    /// Hash of the cell's configuration: [`crate::parameters::Parameters::hash`].
    pub configuration: u16,
    /// Number of packets that the cell sent before this one, modulo 2^16.
    pub sent: u16,
    /// Number of rejected frames, modulo 2^16; page 2 counts them by reason.
    pub rejected: u16,
    /// State bits, the joint that moves the cell, and the protocol version.
    pub state: State,
}

/// Page 1: counters of accepted packets, each modulo 2^16.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[cfg_attr(feature = "host", derive(serde::Serialize))]
pub struct ReceivedCounts {
    /// Number of joints messages accepted. The cell answered them if it was in contact.
    pub joints: u16,
    /// Number of joints messages skipped because they were older than one broadcast period.
    pub joints_late: u16,
    /// Number of joints messages with the same epoch as the previous one.
    pub joints_repeated: u16,
    /// Number of stimuli accepted.
    pub stimuli: u16,
    /// Number of stimuli that arrived after their epoch. They apply from the next epoch on.
    pub stimuli_late: u16,
    /// Number of torques sent.
    pub torques: u16,
}

/// Page 2: counters of rejected frames, each modulo 2^16.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[cfg_attr(feature = "host", derive(serde::Serialize))]
pub struct RejectedCounts {
    /// Number of frames with a length or format that the bus does not use: 16 bytes FD, or classic segments of 8 bytes.
    pub length: u16,
    /// Number of packets with a wrong CRC.
    pub crc: u16,
    /// Number of remote frames, error frames and frames with a 29-bit identifier.
    pub foreign: u16,
    /// Number of packets with an undefined kind, page or command, or with invalid words.
    pub meaning: u16,
    /// Number of packets whose later segments did not arrive.
    pub incomplete: u16,
    /// Number of stimuli that did not fit into the queue, or were sent to a cell outside test mode.
    pub stimuli: u16,
}

/// Page 3: a cell's place in the tree. The epoch byte is that of the last accepted joints.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct TreePage {
    /// The parent, to which the cell sends its sums: the node id of a cell, or 0 for the gateway's side. `None` while
    /// the cell is unreachable.
    pub parent: Option<u8>,
    /// The port that leads to the parent, 0 to 4; undefined without a parent.
    pub parent_port: u8,
    /// Number of wires between the cell and the root of its tree; 0 for a root. Undefined without a parent.
    pub depth: u8,
    /// The round of the exploration in which the depth was determined.
    pub round: u8,
    /// Bit p is set if the cell at port p is a child.
    pub children: u8,
    /// Bit p is set if port p works in both directions.
    pub working_ports: u8,
    /// Number of sums sent, including repetitions, modulo 2^16.
    pub sent: u16,
    /// Number of sums accepted from children, modulo 2^16.
    pub accepted: u16,
    /// Number of sums of children that were dropped, because they were late or no state message came before them;
    /// modulo 2^16.
    pub dropped: u16,
}

/// Page 4: the state of a cell's ports.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct PortsPage {
    /// The state of each port.
    pub ports: [PortState; 4],
    /// Number of times that the cell changed its parent, modulo 2^16.
    pub changes: u16,
}

/// The cell at the other end of a port, and the state of the link.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct PortState {
    /// Node id of the cell at the other end; 0 if that cell has none, or if the port receives nothing.
    pub number: u8,
    /// Number of the port at the other end.
    pub port: u8,
    /// True if the port receives hellos from the other end.
    pub receives: bool,
    /// True if the link works in both directions: the other end also receives hellos from this port.
    pub works: bool,
    /// True if the cell at the other end uses another version of the protocol.
    pub other_version: bool,
}

impl PortState {
    const RECEIVES_FLAG: u16 = 1 << 12;
    const WORKS_FLAG: u16 = 1 << 13;
    const OTHER_VERSION_FLAG: u16 = 1 << 14;

    const fn decode(word: u16) -> Self {
        let [number, high] = word.to_le_bytes();
        Self {
            number,
            port: high & 7,
            receives: word & Self::RECEIVES_FLAG != 0,
            works: word & Self::WORKS_FLAG != 0,
            other_version: word & Self::OTHER_VERSION_FLAG != 0,
        }
    }

    fn encode(self) -> u16 {
        let flag = |set: bool, flag| if set { flag } else { 0 };
        u16::from_le_bytes([self.number, self.port & 7])
            | flag(self.receives, Self::RECEIVES_FLAG)
            | flag(self.works, Self::WORKS_FLAG)
            | flag(self.other_version, Self::OTHER_VERSION_FLAG)
    }
}

/// The last page of each kind from one cell, besides its heartbeat.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct NetworkPages {
    /// Counters of accepted packets.
    pub received: Option<ReceivedCounts>,
    /// Counters of rejected frames.
    pub rejected: Option<RejectedCounts>,
    /// Its place in the tree.
    pub tree: Option<TreePage>,
    /// The state of its ports.
    pub ports: Option<PortsPage>,
}

impl NetworkPages {
    /// Records a page.
    pub const fn record_page(&mut self, page: &NetworkPage) {
        match *page {
            NetworkPage::Heartbeat(_) => {}
            NetworkPage::Received(counts) => self.received = Some(counts),
            NetworkPage::Rejected(counts) => self.rejected = Some(counts),
            NetworkPage::Tree(tree) => self.tree = Some(tree),
            NetworkPage::Ports(ports) => self.ports = Some(ports),
        }
    }
}

impl NetworkPage {
    /// Returns true for a page that a cell sends only in answer to a report command. A heartbeat and the tree
    /// are also sent at other times.
    #[must_use]
    pub const fn is_sent_only_on_request(&self) -> bool {
        !matches!(self, Self::Heartbeat(_) | Self::Tree(_))
    }

    /// Returns the number of the page.
    #[must_use]
    pub fn number(&self) -> u8 {
        self.encode().0
    }

    pub(super) fn decode(page: u8, words: [i16; WORDS]) -> Result<Self, MessageError> {
        let [a, b, c, d, e, f, ..] = words.map(i16::cast_unsigned);
        match page {
            0 => Ok(Self::Heartbeat(Heartbeat {
                serial: u32::from(a) | (u32::from(b) << 16),
                configuration: c,
                sent: d,
                rejected: e,
                state: State(f),
            })),
            1 => Ok(Self::Received(ReceivedCounts {
                joints: a,
                joints_late: b,
                joints_repeated: c,
                stimuli: d,
                stimuli_late: e,
                torques: f,
            })),
            2 => Ok(Self::Rejected(RejectedCounts {
                length: a,
                crc: b,
                foreign: c,
                meaning: d,
                incomplete: e,
                stimuli: f,
            })),
            3 => {
                let ([parent, up], [depth, round]) = (a.to_le_bytes(), b.to_le_bytes());
                let [children, works] = c.to_le_bytes();
                let parent = (parent != NO_PARENT).then_some(parent);
                Ok(Self::Tree(TreePage {
                    parent,
                    parent_port: up,
                    depth,
                    round,
                    children,
                    working_ports: works,
                    sent: d,
                    accepted: e,
                    dropped: f,
                }))
            }
            4 => Ok(Self::Ports(PortsPage { ports: [a, b, c, d].map(PortState::decode), changes: e })),
            _ => Err(MessageError::Page { kind: Kind::Network, page }),
        }
    }

    pub(super) fn encode(self) -> (u8, [i16; WORDS]) {
        let (page, words) = match self {
            Self::Heartbeat(Heartbeat { serial, configuration, sent, rejected, state }) => {
                let [a, b, c, d] = serial.to_le_bytes();
                let segments = [u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d])];
                (0, [segments[0], segments[1], configuration, sent, rejected, state.0])
            }
            Self::Received(ReceivedCounts {
                joints,
                joints_late,
                joints_repeated,
                stimuli,
                stimuli_late,
                torques,
            }) => (1, [joints, joints_late, joints_repeated, stimuli, stimuli_late, torques]),
            Self::Rejected(RejectedCounts { length, crc, foreign, meaning, incomplete, stimuli }) => {
                (2, [length, crc, foreign, meaning, incomplete, stimuli])
            }
            Self::Tree(tree) => {
                let pair = |low, high| u16::from_le_bytes([low, high]);
                let place = [
                    pair(tree.parent.unwrap_or(NO_PARENT), tree.parent_port),
                    pair(tree.depth, tree.round),
                    pair(tree.children, tree.working_ports),
                ];
                (3, [place[0], place[1], place[2], tree.sent, tree.accepted, tree.dropped])
            }
            Self::Ports(PortsPage { ports: [a, b, c, d], changes }) => {
                let [a, b, c, d] = [a, b, c, d].map(PortState::encode);
                (4, [a, b, c, d, changes, 0])
            }
        };
        (page, packet::padded_words(words.map(u16::cast_signed)))
    }
}
