//! What a packet means.
//!
//! | kind | node field | words | count |
//! |---|---|---|---|
//! | 0 command | 0 halt, 1 joints, 2 sync, 3 resume, 4 report | joints: a position for each joint, quarter turns or m, Q1.14; else 0 | joints: joints in use |
//! | 1 sum | sender | sum of torques in Nm or N, Q7.8 | contributing cells |
//! | 2 torque | sender | own torque in Nm or N, in the format of the bus, [`crate::fixed::TorqueFormat`] | 1 |
//! | 3 sensors | sender | a [`SensorPage`] | page |
//! | 4 network | sender | a [`NetworkPage`] | page |
//! | 5 configure | destination | what to write | parameter, + 0x80 to write; the epoch byte is a tag |
//! | 6 configured | sender | the present value, or a refusal | parameter, + 0x80 if written; tag |
//! | 7 stimulus | destination | a [`SensorPage`] | page, + 0x80: from the next joints on |
//!
//! In a torque or a sum the largest and the smallest word mean *saturated*.

mod network;
mod sensors;
mod state;

pub use network::{Heard, Heartbeat, NetworkPage, PortState, Ports, Refused, Tree};
pub use sensors::{BaselinePage, SensorPage, SkinSensors};
pub use state::State;

use core::ops::RangeInclusive;

use thiserror::Error;

use crate::fixed::{Q1_14, Q5_10};
use crate::id::{CellId, Command, Id, Kind, Node};
use crate::packet::{self, Epoch, Length, Packet, WORDS, Words};
use crate::parameters::MAX_JOINTS;

/// The version of this protocol, in every heartbeat.
pub const VERSION: u8 = 1;

/// Set in a stimulus' count: it holds from the next joints on, whatever their epoch.
pub(crate) const FROM_THE_NEXT: u8 = 0x80;
/// Set in the count of `configure` and `configured`: the parameter is written.
pub(crate) const WRITE: u8 = 0x80;
/// The parameter number that stands for a refusal.
pub(crate) const REFUSED: u8 = 126;

/// The joint positions of one epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Joints {
    /// Positions in quarter turns, of prismatic joints in m; those beyond the joints in use are zero.
    pub positions: [Q1_14; MAX_JOINTS],
    /// Joints in use.
    pub in_use: u8,
}

/// When a stimulus begins to hold.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum From {
    /// From the joints of this epoch on.
    Epoch(Epoch),
    /// From the next joints on, whatever their epoch.
    Next,
}

/// The request of a `configure` packet.
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
    /// Words that this parameter cannot have, or `links_down` outside test mode.
    pub const CANNOT_BE: i16 = 19;
    /// It is no tare while something touches the cell, or before it has taken joints.
    pub const TOUCHED: i16 = 20;
    /// What the sensor reads is farther from 0 than the baseline's limit.
    pub const BEYOND_LIMIT: i16 = 21;
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
        /// Nm or N, Q7.8, a word for each joint.
        torque: Words,
        /// Cells in it; 0 ends the sums before.
        count: u8,
    },
    /// One cell's torque.
    Torque {
        /// Who sends it.
        from: CellId,
        /// The joints it answers.
        epoch: Epoch,
        /// Nm or N in the format of the bus, a word for each joint.
        torque: Words,
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
    /// What a cell, or the gateway (node 0), reports of itself.
    Network {
        /// Who sends it.
        from: Node,
        /// The last joints it took.
        epoch: Epoch,
        /// What it reports.
        page: NetworkPage,
    },
    /// Read or write a parameter.
    Configure {
        /// Destination.
        to: Node,
        /// Comes back in the answer.
        tag: u8,
        /// The request.
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
    /// When the packet has a kind, page or value that this version of the protocol does not know.
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
                Command::Joints => {
                    let allowed = allowed_joints(words.length());
                    if !allowed.0.contains(&count) {
                        return Err(MessageError::Count { kind, got: count, allowed: allowed.1 });
                    }
                    let positions = words.padded().map(Q1_14::from_bits);
                    Self::Joints { epoch, joints: Joints { positions, in_use: count } }
                }
            },
            Kind::Sum if count == 0 && !words.is_zero() => {
                return Err(MessageError::Count { kind, got: count, allowed: "1 to 255, or 0 with zeros" });
            }
            Kind::Sum => Self::Sum { from: sender()?, epoch, torque: words, count },
            Kind::Torque if count != 1 => {
                return Err(MessageError::Count { kind, got: count, allowed: "1" });
            }
            Kind::Torque => Self::Torque { from: sender()?, epoch, torque: words },
            Kind::Sensors => {
                Self::Sensors { from: sender()?, epoch, page: SensorPage::decode(kind, count, words.six())? }
            }
            Kind::Network => match Node::from_byte(node) {
                Node::Everyone => return Err(MessageError::Sender { kind, node }),
                from @ (Node::Gateway | Node::Cell(_)) => {
                    Self::Network { from, epoch, page: NetworkPage::decode(count, words.six())? }
                }
            },
            Kind::Configure => {
                let number = count & !WRITE;
                let request = if count & WRITE == 0 {
                    Request::Read { number }
                } else {
                    Request::Write { number, words: words.six() }
                };
                Self::Configure { to: addressee(kind, node)?, tag: epoch.0, request }
            }
            Kind::Configured => {
                let number = count & !WRITE;
                let words = words.six();
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
                let page = SensorPage::decode(kind, count & !FROM_THE_NEXT, words.six())?;
                Self::Stimulus { to: addressee(kind, node)?, from, page }
            }
        })
    }

    /// Encodes it to a packet.
    #[must_use]
    pub fn encode(&self) -> Packet {
        let with = |words, epoch, count| Packet { id: self.id(), words, epoch, count };
        let packet = |words: [i16; WORDS], epoch, count| with(words.into(), epoch, count);
        match *self {
            Self::Halt | Self::Sync | Self::Resume | Self::Report => packet([0; WORDS], Epoch(0), 0),
            Self::Joints { epoch, joints } => with(joints.words(), epoch, joints.in_use),
            Self::Sum { epoch, torque, count, .. } => with(torque, epoch, count),
            Self::Torque { epoch, torque, .. } => with(torque, epoch, 1),
            Self::Sensors { epoch, page, .. } => {
                let (count, words) = page.encode();
                packet(words, epoch, count)
            }
            Self::Network { epoch, page, .. } => {
                let (count, words) = page.encode();
                packet(words, epoch, count)
            }
            Self::Configure { tag, request, .. } => {
                let (count, words) = match request {
                    Request::Read { number } => (number & !WRITE, [0; WORDS]),
                    Request::Write { number, words } => (number | WRITE, words),
                };
                packet(words, Epoch(tag), count)
            }
            Self::Configured { tag, answer, .. } => {
                let (count, words) = match answer {
                    Answer::Value { number, written, words } => {
                        (number | if written { WRITE } else { 0 }, words)
                    }
                    Answer::Refused { number, reason } => {
                        (REFUSED, packet::words([i16::from(number), reason]))
                    }
                };
                packet(words, Epoch(tag), count)
            }
            Self::Stimulus { from, page, .. } => {
                let (page, words) = page.encode();
                let (epoch, flag) = match from {
                    From::Epoch(epoch) => (epoch, 0),
                    From::Next => (Epoch(0), FROM_THE_NEXT),
                };
                packet(words, epoch, page | flag)
            }
        }
    }
}

impl Message {
    /// The identifier under which it is sent.
    #[must_use]
    pub fn id(&self) -> Id {
        let cell = |kind, from| Id::new(kind, Node::Cell(from));
        match *self {
            Self::Halt => Id::command(Command::Halt),
            Self::Joints { .. } => Id::command(Command::Joints),
            Self::Sync => Id::command(Command::Sync),
            Self::Resume => Id::command(Command::Resume),
            Self::Report => Id::command(Command::Report),
            Self::Sum { from, .. } => cell(Kind::Sum, from),
            Self::Torque { from, .. } => cell(Kind::Torque, from),
            Self::Sensors { from, .. } => cell(Kind::Sensors, from),
            Self::Network { from, .. } => Id::new(Kind::Network, from),
            Self::Configure { to, .. } => Id::new(Kind::Configure, to),
            Self::Configured { from, .. } => cell(Kind::Configured, from),
            Self::Stimulus { to, .. } => Id::new(Kind::Stimulus, to),
        }
    }

    /// The cell that sends it; `None` when the gateway's side does.
    #[must_use]
    pub fn sender(&self) -> Option<CellId> {
        self.id().sender()
    }

    /// Its epoch, if it has one.
    #[must_use]
    pub const fn epoch(&self) -> Option<Epoch> {
        match *self {
            Self::Joints { epoch, .. }
            | Self::Sum { epoch, .. }
            | Self::Torque { epoch, .. }
            | Self::Sensors { epoch, .. }
            | Self::Network { epoch, .. }
            | Self::Stimulus { from: From::Epoch(epoch), .. } => Some(epoch),
            Self::Halt
            | Self::Sync
            | Self::Resume
            | Self::Report
            | Self::Configure { .. }
            | Self::Configured { .. }
            | Self::Stimulus { from: From::Next, .. } => None,
        }
    }

    /// The tag of a request or of its answer.
    #[must_use]
    pub const fn tag(&self) -> Option<u8> {
        if let Self::Configure { tag, .. } | Self::Configured { tag, .. } = *self { Some(tag) } else { None }
    }

    /// What a cell measures, or shall feel.
    #[must_use]
    pub const fn sensor_page(&self) -> Option<SensorPage> {
        if let Self::Sensors { page, .. } | Self::Stimulus { page, .. } = *self { Some(page) } else { None }
    }

    /// Whether a word of it means *saturated*; `None` of what is neither a torque nor a sum.
    #[must_use]
    pub fn is_saturated(&self) -> Option<bool> {
        self.torque_words().map(|words| words.is_saturated())
    }

    /// Whether it reports a touch: a torque or a sum that is not all zero, a stimulus or sensors with a contact force
    /// or a proximity, a heartbeat of an active cell.
    #[must_use]
    pub fn is_contact(&self) -> bool {
        if let Self::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = self {
            return heartbeat.state.has(State::ACTIVE);
        }
        if let Some(SensorPage::Skin(skin)) = self.sensor_page() {
            return skin.contact != [Q5_10::ZERO; 3] || skin.proximity != Q1_14::ZERO;
        }
        self.torque_words().is_some_and(|words| !words.is_zero())
    }

    /// The words of a torque or a sum.
    const fn torque_words(&self) -> Option<Words> {
        if let Self::Torque { torque, .. } | Self::Sum { torque, .. } = *self { Some(torque) } else { None }
    }
}

impl Joints {
    /// The words that travel: as many as the joints in use need.
    fn words(&self) -> Words {
        Words::new(Length::for_joints(self.in_use.into()), self.positions.map(Q1_14::to_bits))
    }
}

/// The joints that words of this length are for.
const fn allowed_joints(length: Length) -> (RangeInclusive<u8>, &'static str) {
    match length {
        Length::Six => (1..=6, "1 to 6"),
        Length::Eight => (7..=8, "7 or 8"),
        Length::Ten => (9..=10, "9 or 10"),
        Length::Fourteen => (11..=14, "11 to 14"),
    }
}

fn addressee(kind: Kind, node: u8) -> Result<Node, MessageError> {
    match Node::from_byte(node) {
        Node::Gateway => Err(MessageError::Addressee { kind, node }),
        to @ (Node::Cell(_) | Node::Everyone) => Ok(to),
    }
}

#[cfg(test)]
mod tests;
