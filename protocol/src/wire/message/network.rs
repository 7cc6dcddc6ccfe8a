//! What a cell reports of itself and its part of the network.

use super::{MessageError, State};
use crate::id::Kind;
use crate::packet::{self, WORDS};

/// In a tree page: no parent.
const NOBODY: u8 = 255;
/// What a cell reports of itself and its part of the network.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum NetworkPage {
    /// Page 0.
    Heartbeat(Heartbeat),
    /// Page 1: what became of the packets that it received.
    Heard(Heard),
    /// Page 2: what it refused, by reason.
    Refused(Refused),
    /// Page 3: its place in the tree, and what became of sums.
    Tree(Tree),
    /// Page 4: what its ports lead to.
    Ports(Ports),
}

/// Page 0: sign of life, four times a second and after each sync. The epoch byte is that of the last
/// joints taken.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Heartbeat {
    /// The cell's serial number.
    pub serial: u32,
    /// Hash of its configuration, [`crate::parameters::Parameters::hash`].
    pub configuration: u16,
    /// Packets sent before this one, modulo 2^16.
    pub sent: u16,
    /// Frames refused, modulo 2^16; page 2 has the reasons.
    pub rejected: u16,
    /// How it is.
    pub state: State,
}

/// Page 1: what became of received packets, each modulo 2^16.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[cfg_attr(feature = "host", derive(serde::Serialize))]
pub struct Heard {
    /// Joints taken and answered if in contact.
    pub joints: u16,
    /// Joints skipped because they were older than one period.
    pub joints_late: u16,
    /// Joints of the epoch that was the last already.
    pub joints_repeated: u16,
    /// Stimuli taken.
    pub stimuli: u16,
    /// Stimuli that came after the epoch they were meant for (taken from the next one on).
    pub stimuli_late: u16,
    /// Torques sent.
    pub torques: u16,
}

/// Page 2: frames refused, each modulo 2^16.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[cfg_attr(feature = "host", derive(serde::Serialize))]
pub struct Refused {
    /// Neither 16 bytes FD nor 8 bytes classic, as the bus has it.
    pub length: u16,
    /// Wrong CRC.
    pub crc: u16,
    /// Remote frame, error frame, 29-bit identifier.
    pub foreign: u16,
    /// A kind, page or command that does not exist, or words that cannot be.
    pub meaning: u16,
    /// First segments whose second segment did not come.
    pub incomplete: u16,
    /// Stimuli for which there was no room, or that a measuring cell was sent.
    pub stimuli: u16,
}

/// Page 3: a cell's place in the tree. The epoch byte is that of the last joints taken.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Tree {
    /// Where its sums go: the node id of a cell, 0 for the gateway's side; `None` where it is unreachable.
    pub parent: Option<u8>,
    /// The port that leads there, 0 to 4; not looked at without a parent.
    pub up: u8,
    /// Wires to the root of its tree: 0 is a root; not looked at without a parent.
    pub depth: u8,
    /// The exploration from which the depth is.
    pub round: u8,
    /// Bit p: the cell at port p is its child.
    pub children: u8,
    /// Bit p: port p works in both directions.
    pub works: u8,
    /// Sums sent, resends among them, modulo 2^16.
    pub sent: u16,
    /// Sums taken from children, modulo 2^16.
    pub taken: u16,
    /// Sums of children that were not taken: too late, or without a state message; modulo 2^16.
    pub dropped: u16,
}

/// Page 4: what a cell's ports lead to.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Ports {
    /// Each port.
    pub ports: [PortState; 4],
    /// How often its parent changed, modulo 2^16.
    pub changes: u16,
}

/// What one port leads to.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct PortState {
    /// The node id of the cell at the other end; 0 when nothing is received from there, or it has no node id.
    pub number: u8,
    /// The other end's port.
    pub port: u8,
    /// Hellos are received from there.
    pub hears: bool,
    /// The other end receives this cell too.
    pub works: bool,
    /// It uses another version of the protocol.
    pub other_version: bool,
}

impl PortState {
    const HEARS: u16 = 1 << 12;
    const WORKS: u16 = 1 << 13;
    const OTHER_VERSION: u16 = 1 << 14;

    const fn decode(word: u16) -> Self {
        let [number, high] = word.to_le_bytes();
        Self {
            number,
            port: high & 7,
            hears: word & Self::HEARS != 0,
            works: word & Self::WORKS != 0,
            other_version: word & Self::OTHER_VERSION != 0,
        }
    }

    fn encode(self) -> u16 {
        let flag = |set: bool, flag| if set { flag } else { 0 };
        u16::from_le_bytes([self.number, self.port & 7])
            | flag(self.hears, Self::HEARS)
            | flag(self.works, Self::WORKS)
            | flag(self.other_version, Self::OTHER_VERSION)
    }
}

impl NetworkPage {
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
            1 => Ok(Self::Heard(Heard {
                joints: a,
                joints_late: b,
                joints_repeated: c,
                stimuli: d,
                stimuli_late: e,
                torques: f,
            })),
            2 => Ok(Self::Refused(Refused {
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
                let parent = (parent != NOBODY).then_some(parent);
                Ok(Self::Tree(Tree {
                    parent,
                    up,
                    depth,
                    round,
                    children,
                    works,
                    sent: d,
                    taken: e,
                    dropped: f,
                }))
            }
            4 => Ok(Self::Ports(Ports { ports: [a, b, c, d].map(PortState::decode), changes: e })),
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
            Self::Heard(Heard { joints, joints_late, joints_repeated, stimuli, stimuli_late, torques }) => {
                (1, [joints, joints_late, joints_repeated, stimuli, stimuli_late, torques])
            }
            Self::Refused(Refused { length, crc, foreign, meaning, incomplete, stimuli }) => {
                (2, [length, crc, foreign, meaning, incomplete, stimuli])
            }
            Self::Tree(tree) => {
                let pair = |low, high| u16::from_le_bytes([low, high]);
                let place = [
                    pair(tree.parent.unwrap_or(NOBODY), tree.up),
                    pair(tree.depth, tree.round),
                    pair(tree.children, tree.works),
                ];
                (3, [place[0], place[1], place[2], tree.sent, tree.taken, tree.dropped])
            }
            Self::Ports(Ports { ports: [a, b, c, d], changes }) => {
                let [a, b, c, d] = [a, b, c, d].map(PortState::encode);
                (4, [a, b, c, d, changes, 0])
            }
        };
        (page, packet::words(words.map(u16::cast_signed)))
    }
}
