//! What a packet means.
//!
//! | kind | node field | words | count |
//! |---|---|---|---|
//! | 0 command | 0 halt, 1 joints, 2 sync, 3 resume, 4 report | joints: six positions, quarter turns, Q1.14; else 0 | joints: joints in use |
//! | 1 sum | sender | sum of torques in Nm, Q7.8 | contributing cells |
//! | 2 torque | sender | own torque in Nm, Q3.12 | 1 |
//! | 3 sensors | sender | a [`SensorPage`] | page |
//! | 4 network | sender | a [`NetworkPage`] | page |
//! | 5 configure | addressee | what to write | parameter, + 0x80 to write; the epoch byte is a tag |
//! | 6 configured | sender | the value in force, or a refusal | parameter, + 0x80 if written; tag |
//! | 7 stimulus | addressee | a [`SensorPage`] | page, + 0x80: from the next joints on |
//!
//! In a torque or a sum the greatest and the least word mean *saturated*.

use thiserror::Error;

use crate::fixed::{Q1_14, Q3_12, Q5_10, Q7_8, Q9_6};
use crate::id::{CellId, Command, Id, Kind, Node};
use crate::packet::{Epoch, Packet, WORDS};

/// The version of this protocol, in every heartbeat.
pub const VERSION: u8 = 1;

/// Set in a stimulus' count: it holds from the next joints on, whatever their epoch.
const FROM_THE_NEXT: u8 = 0x80;
/// Set in the count of `configure` and `configured`: the parameter is written.
const WRITE: u8 = 0x80;
/// In a tree page: no parent.
const NOBODY: u8 = 255;
/// The parameter number that stands for a refusal.
const REFUSED: u8 = 126;

/// The joint positions of one epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Joints {
    /// Positions in quarter turns; those beyond the joints in use are zero.
    pub positions: [Q1_14; WORDS],
    /// Joints in use.
    pub in_use: u8,
}

/// What a cell measures, or shall feel.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum SensorPage {
    /// Page 0: what touches the skin.
    Skin(SkinSensors),
    /// Page 1: accelerometer x, y, z in g.
    Acceleration([Q3_12; 3]),
}

/// Page 0 of the sensors.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SkinSensors {
    /// Three capacitive contact forces in N; their sum is the touch.
    pub contact: [Q5_10; 3],
    /// Proximity, 0 (nothing near) to 1.
    pub proximity: Q1_14,
    /// Two temperatures in degrees Celsius.
    pub temperature: [Q9_6; 2],
}

/// When a stimulus begins to hold.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum From {
    /// From the joints of this epoch on.
    Epoch(Epoch),
    /// From the next joints on, whatever their epoch.
    Next,
}

/// What a cell says of itself and its part of the network.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum NetworkPage {
    /// Page 0.
    Heartbeat(Heartbeat),
    /// Page 1: what became of the packets it heard.
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
    /// Frames refused, modulo 2^16; page 2 says why.
    pub rejected: u16,
    /// How it is.
    pub state: State,
}

/// How a cell is: one bit each, the joint in bits 8 to 11, the protocol version in bits 12 to 15.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct State(pub u16);

impl State {
    /// It has a configuration and computes with it.
    pub const CONFIGURED: Self = Self(1);
    /// It feels a contact.
    pub const ACTIVE: Self = Self(1 << 1);
    /// It was halted and waits for a resume.
    pub const HALTED: Self = Self(1 << 2);
    /// Its flash was damaged; what was in it is not used.
    pub const FLASH_DAMAGED: Self = Self(1 << 3);
    /// It has heard another cell speak under its number.
    pub const DUPLICATE: Self = Self(1 << 4);
    /// It obeys stimuli instead of measuring.
    pub const TEST_MODE: Self = Self(1 << 5);
    /// A torque saturated since the last heartbeat.
    pub const SATURATED: Self = Self(1 << 6);
    /// It has just started and listens for another cell under its number.
    pub const CLAIMING: Self = Self(1 << 7);

    /// The bits and their names, as everything prints them.
    pub const NAMES: [(Self, &'static str); 8] = [
        (Self::CONFIGURED, "configured"),
        (Self::ACTIVE, "active"),
        (Self::HALTED, "halted"),
        (Self::FLASH_DAMAGED, "flash-damaged"),
        (Self::DUPLICATE, "duplicate"),
        (Self::TEST_MODE, "test-mode"),
        (Self::SATURATED, "saturated"),
        (Self::CLAIMING, "claiming"),
    ];

    /// Whether all of these bits are set.
    #[must_use]
    pub const fn has(self, bits: Self) -> bool {
        self.0 & bits.0 == bits.0
    }

    /// The same with these bits set or not.
    #[must_use]
    pub const fn with(self, bits: Self, set: bool) -> Self {
        if set { Self(self.0 | bits.0) } else { Self(self.0 & !bits.0) }
    }

    /// The same with the joint and this protocol's version.
    #[must_use]
    pub const fn with_joint(self, joint: u8) -> Self {
        Self((self.0 & 0xFF) | (((joint & 0xF) as u16) << 8) | ((VERSION as u16) << 12))
    }

    /// The joint that moves the cell; 0 while it is not configured.
    #[must_use]
    pub const fn joint(self) -> u16 {
        (self.0 >> 8) & 0xF
    }

    /// The version of the protocol that the cell speaks.
    #[must_use]
    pub const fn version(self) -> u16 {
        self.0 >> 12
    }
}

/// Page 1: what became of what was heard, each modulo 2^16.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
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
pub struct Refused {
    /// Neither 16 bytes FD nor 8 bytes classic, as the bus has it.
    pub length: u16,
    /// Wrong CRC.
    pub crc: u16,
    /// Remote frame, error frame, 29-bit identifier.
    pub foreign: u16,
    /// A kind, page or command that does not exist, or words that cannot be.
    pub meaning: u16,
    /// First halves whose second half did not come.
    pub incomplete: u16,
    /// Stimuli for which there was no room, or that a measuring cell was sent.
    pub stimuli: u16,
}

/// Page 3: a cell's place in the tree. The epoch byte is that of the last joints taken.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Tree {
    /// Where its sums go: the number of a cell, 0 for the gateway's side; `None` without a way up.
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
    /// Sums of children that were not taken: too late, or not said to be for this cell; modulo 2^16.
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
    /// The number of the cell at the other end; 0 when nothing is heard from there, or it has no number.
    pub number: u8,
    /// The other end's port.
    pub port: u8,
    /// Something is heard from there.
    pub hears: bool,
    /// It hears this cell too.
    pub works: bool,
    /// It speaks another version of the protocol.
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

/// What a `configure` packet asks for.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Request {
    /// The value of a parameter.
    Read {
        /// The parameter's number, known or not.
        number: u8,
    },
    /// A new value for a parameter.
    Write {
        /// The parameter's number, known or not.
        number: u8,
        /// Its words.
        words: [i16; WORDS],
    },
}

/// What a `configured` packet answers.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Answer {
    /// The value that was read, or that is now written.
    Value {
        /// The parameter's number.
        number: u8,
        /// Whether it was written.
        written: bool,
        /// Its words.
        words: [i16; WORDS],
    },
    /// The parameter cannot be had or written so.
    Refused {
        /// The parameter's number.
        number: u8,
        /// Why, [`crate::parameters::ParameterError::code`] or [`Answer::WRONG_HASH`] and so on.
        reason: i16,
    },
}

impl Answer {
    /// A commit whose hash is not that of what was written.
    pub const WRONG_HASH: i16 = 16;
    /// Flash could not be written.
    pub const FLASH_FAILED: i16 = 17;
    /// No such parameter.
    pub const UNKNOWN: i16 = 18;
    /// Words that this parameter cannot have, or a cut outside test mode.
    pub const CANNOT_BE: i16 = 19;
}

/// A packet's meaning.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Message {
    /// Stop answering until a resume.
    Halt,
    /// New joint positions.
    Joints {
        /// The number of this broadcast.
        epoch: Epoch,
        /// The positions.
        joints: Joints,
    },
    /// Answer with a heartbeat.
    Sync,
    /// Leave the halted state.
    Resume,
    /// Answer with the pages of counters.
    Report,
    /// A partial sum.
    Sum {
        /// Who sends it.
        from: CellId,
        /// The joints it answers.
        epoch: Epoch,
        /// Nm.
        torque: [Q7_8; WORDS],
        /// Cells in it; 0 ends what was said before.
        count: u8,
    },
    /// One cell's torque.
    Torque {
        /// Who sends it.
        from: CellId,
        /// The joints it answers.
        epoch: Epoch,
        /// Nm.
        torque: [Q3_12; WORDS],
    },
    /// What a cell measures.
    Sensors {
        /// Who sends it.
        from: CellId,
        /// The last joints it took.
        epoch: Epoch,
        /// The measurements.
        page: SensorPage,
    },
    /// What a cell, or the gateway (node 0), says of itself.
    Network {
        /// Who sends it.
        from: Node,
        /// The last joints it took.
        epoch: Epoch,
        /// What it says.
        page: NetworkPage,
    },
    /// Read or write a parameter.
    Configure {
        /// To whom.
        to: Node,
        /// Comes back in the answer.
        tag: u8,
        /// What is asked.
        request: Request,
    },
    /// The answer.
    Configured {
        /// Who answers.
        from: CellId,
        /// The request's tag.
        tag: u8,
        /// What it answers.
        answer: Answer,
    },
    /// What a cell shall feel.
    Stimulus {
        /// Who shall feel it.
        to: Node,
        /// From when on.
        from: From,
        /// What it shall feel.
        page: SensorPage,
    },
}

/// Why a packet has no meaning.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum MessageError {
    /// A command that does not exist.
    #[error("command {0} does not exist: 0 halt, 1 joints, 2 sync, 3 resume, 4 report do")]
    Command(u8),
    /// A sender that cannot be.
    #[error("{kind} from node {node}, which is no cell", kind = .kind.name())]
    Sender {
        /// The kind.
        kind: Kind,
        /// The node field.
        node: u8,
    },
    /// An addressee that cannot be.
    #[error("{kind} to node {node}, which is no cell", kind = .kind.name())]
    Addressee {
        /// The kind.
        kind: Kind,
        /// The node field.
        node: u8,
    },
    /// A page that does not exist.
    #[error("{kind} page {page} does not exist", kind = .kind.name())]
    Page {
        /// The kind.
        kind: Kind,
        /// The page.
        page: u8,
    },
    /// A count that cannot be.
    #[error("{kind} with count {got}; {allowed} is allowed", kind = .kind.name())]
    Count {
        /// The kind.
        kind: Kind,
        /// The count.
        got: u8,
        /// What is allowed.
        allowed: &'static str,
    },
}

impl Message {
    /// The packet's meaning. Never panics.
    ///
    /// # Errors
    /// When the packet says something that this version of the protocol does not know.
    pub fn decode(packet: &Packet) -> Result<Self, MessageError> {
        let Packet { id: Id { kind, node }, words, epoch, count } = *packet;
        let sender = || match Node::from_byte(node) {
            Node::Cell(cell) => Ok(cell),
            Node::Gateway | Node::Everyone => Err(MessageError::Sender { kind, node }),
        };
        Ok(match kind {
            Kind::Command => match Command::from_byte(node).ok_or(MessageError::Command(node))? {
                Command::Halt => Self::Halt,
                Command::Sync => Self::Sync,
                Command::Resume => Self::Resume,
                Command::Report => Self::Report,
                Command::Joints if (1..=6).contains(&count) => Self::Joints {
                    epoch,
                    joints: Joints { positions: words.map(Q1_14::from_bits), in_use: count },
                },
                Command::Joints => {
                    return Err(MessageError::Count { kind, got: count, allowed: "1 to 6" });
                }
            },
            Kind::Sum if count == 0 && words != [0; WORDS] => {
                return Err(MessageError::Count { kind, got: count, allowed: "1 to 255, or 0 with zeros" });
            }
            Kind::Sum => Self::Sum { from: sender()?, epoch, torque: words.map(Q7_8::from_bits), count },
            Kind::Torque if count != 1 => {
                return Err(MessageError::Count { kind, got: count, allowed: "1" });
            }
            Kind::Torque => Self::Torque { from: sender()?, epoch, torque: words.map(Q3_12::from_bits) },
            Kind::Sensors => {
                Self::Sensors { from: sender()?, epoch, page: SensorPage::decode(kind, count, words)? }
            }
            Kind::Network => match Node::from_byte(node) {
                Node::Everyone => return Err(MessageError::Sender { kind, node }),
                from @ (Node::Gateway | Node::Cell(_)) => {
                    Self::Network { from, epoch, page: NetworkPage::decode(count, words)? }
                }
            },
            Kind::Configure => {
                let number = count & !WRITE;
                let request = if count & WRITE == 0 {
                    Request::Read { number }
                } else {
                    Request::Write { number, words }
                };
                Self::Configure { to: addressee(kind, node)?, tag: epoch.0, request }
            }
            Kind::Configured => {
                let number = count & !WRITE;
                let answer = match words {
                    [refused, reason, ..] if number == REFUSED => {
                        Answer::Refused { number: refused.to_le_bytes()[0], reason }
                    }
                    _ => Answer::Value { number, written: count & WRITE != 0, words },
                };
                Self::Configured { from: sender()?, tag: epoch.0, answer }
            }
            Kind::Stimulus => {
                let from = if count & FROM_THE_NEXT == 0 { From::Epoch(epoch) } else { From::Next };
                let page = SensorPage::decode(kind, count & !FROM_THE_NEXT, words)?;
                Self::Stimulus { to: addressee(kind, node)?, from, page }
            }
        })
    }

    /// The packet that says this.
    #[must_use]
    pub fn encode(&self) -> Packet {
        let cell = |kind, from: CellId| Id::new(kind, Node::Cell(from));
        let bare =
            |command| Packet { id: Id::command(command), words: [0; WORDS], epoch: Epoch(0), count: 0 };
        match *self {
            Self::Halt => bare(Command::Halt),
            Self::Sync => bare(Command::Sync),
            Self::Resume => bare(Command::Resume),
            Self::Report => bare(Command::Report),
            Self::Joints { epoch, joints } => Packet {
                words: joints.positions.map(Q1_14::to_bits),
                epoch,
                count: joints.in_use,
                ..bare(Command::Joints)
            },
            Self::Sum { from, epoch, torque, count } => {
                Packet { id: cell(Kind::Sum, from), words: torque.map(Q7_8::to_bits), epoch, count }
            }
            Self::Torque { from, epoch, torque } => {
                Packet { id: cell(Kind::Torque, from), words: torque.map(Q3_12::to_bits), epoch, count: 1 }
            }
            Self::Sensors { from, epoch, page } => {
                let (count, words) = page.encode();
                Packet { id: cell(Kind::Sensors, from), words, epoch, count }
            }
            Self::Network { from, epoch, page } => {
                let (count, words) = page.encode();
                Packet { id: Id::new(Kind::Network, from), words, epoch, count }
            }
            Self::Configure { to, tag, request } => {
                let (count, words) = match request {
                    Request::Read { number } => (number & !WRITE, [0; WORDS]),
                    Request::Write { number, words } => (number | WRITE, words),
                };
                Packet { id: Id::new(Kind::Configure, to), words, epoch: Epoch(tag), count }
            }
            Self::Configured { from, tag, answer } => {
                let (count, words) = match answer {
                    Answer::Value { number, written, words } => {
                        (number | if written { WRITE } else { 0 }, words)
                    }
                    Answer::Refused { number, reason } => (REFUSED, [i16::from(number), reason, 0, 0, 0, 0]),
                };
                Packet { id: cell(Kind::Configured, from), words, epoch: Epoch(tag), count }
            }
            Self::Stimulus { to, from, page } => {
                let (page, words) = page.encode();
                let (epoch, flag) = match from {
                    From::Epoch(epoch) => (epoch, 0),
                    From::Next => (Epoch(0), FROM_THE_NEXT),
                };
                Packet { id: Id::new(Kind::Stimulus, to), words, epoch, count: page | flag }
            }
        }
    }
}

fn addressee(kind: Kind, node: u8) -> Result<Node, MessageError> {
    match Node::from_byte(node) {
        Node::Gateway => Err(MessageError::Addressee { kind, node }),
        to @ (Node::Cell(_) | Node::Everyone) => Ok(to),
    }
}

impl SensorPage {
    fn decode(kind: Kind, page: u8, words: [i16; WORDS]) -> Result<Self, MessageError> {
        let [a, b, c, d, e, f] = words;
        match page {
            0 => Ok(Self::Skin(SkinSensors {
                contact: [a, b, c].map(Q5_10::from_bits),
                proximity: Q1_14::from_bits(d),
                temperature: [e, f].map(Q9_6::from_bits),
            })),
            1 => Ok(Self::Acceleration([a, b, c].map(Q3_12::from_bits))),
            _ => Err(MessageError::Page { kind, page }),
        }
    }

    fn encode(self) -> (u8, [i16; WORDS]) {
        match self {
            Self::Skin(SkinSensors { contact, proximity, temperature }) => {
                let ([a, b, c], [e, f]) = (contact.map(Q5_10::to_bits), temperature.map(Q9_6::to_bits));
                (0, [a, b, c, proximity.to_bits(), e, f])
            }
            Self::Acceleration(xyz) => {
                let [x, y, z] = xyz.map(Q3_12::to_bits);
                (1, [x, y, z, 0, 0, 0])
            }
        }
    }
}

impl NetworkPage {
    fn decode(page: u8, words: [i16; WORDS]) -> Result<Self, MessageError> {
        let [a, b, c, d, e, f] = words.map(i16::cast_unsigned);
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

    fn encode(self) -> (u8, [i16; WORDS]) {
        let (page, words) = match self {
            Self::Heartbeat(Heartbeat { serial, configuration, sent, rejected, state }) => {
                let [a, b, c, d] = serial.to_le_bytes();
                let halves = [u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d])];
                (0, [halves[0], halves[1], configuration, sent, rejected, state.0])
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
        (page, words.map(u16::cast_signed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Whatever a packet is taken to mean is said again by a packet with the same meaning; words
        /// that a page does not use may differ.
        #[test]
        fn a_meaning_comes_back(id in 0_u16..0x800, words: [i16; WORDS], epoch: u8, count: u8) {
            let packet = Packet { id: Id::from_bits(id), words, epoch: Epoch(epoch), count };
            if let Ok(message) = Message::decode(&packet) {
                prop_assert_eq!(Message::decode(&message.encode()), Ok(message));
                prop_assert_eq!(message.encode().id, packet.id);
            }
        }
    }

    #[test]
    fn what_cannot_be_is_refused_with_the_value() {
        let packet = |id, count| Packet { id: Id::from_bits(id), words: [0; WORDS], epoch: Epoch(0), count };
        let says = |id, count| Message::decode(&packet(id, count)).unwrap_err().to_string();
        assert_eq!(
            says(0x005, 0),
            "command 5 does not exist: 0 halt, 1 joints, 2 sync, 3 resume, 4 report do"
        );
        assert_eq!(says(0x001, 7), "command with count 7; 1 to 6 is allowed");
        assert_eq!(says(0x200, 1), "torque from node 0, which is no cell");
        assert_eq!(says(0x2FF, 1), "torque from node 255, which is no cell");
        assert_eq!(says(0x201, 2), "torque with count 2; 1 is allowed");
        assert_eq!(says(0x301, 2), "sensors page 2 does not exist");
        assert_eq!(says(0x401, 9), "network page 9 does not exist");
        assert_eq!(says(0x500, 0), "configure to node 0, which is no cell");
    }

    #[test]
    fn the_state_word_keeps_its_parts_apart() {
        let state = State::CONFIGURED.with(State::ACTIVE, true).with_joint(5);
        assert!(state.has(State::CONFIGURED) && state.has(State::ACTIVE) && !state.has(State::HALTED));
        assert_eq!((state.joint(), state.version()), (5, 1));
        assert_eq!(state.with(State::ACTIVE, false).0, 0x1501);
    }
}
