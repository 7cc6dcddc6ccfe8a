//! Messages: the meaning of packets.
//!
//! | kind | node field | words | count |
//! |---|---|---|---|
//! | 0 command | 0 halt, 1 joints, 2 sync, 3 resume, 4 report | joints: a position for each joint, quarter turns or m, Q1.14; else 0 | joints: joints in use |
//! | 1 sum | sender | sum of torques in Nm or N, Q7.8 | contributing cells |
//! | 2 torque | sender | own torque in Nm or N, in the format of the bus, [`crate::fixed::TorqueFormat`] | 1 |
//! | 3 sensors | sender | a [`SensorPage`] | page |
//! | 4 network | sender | a [`NetworkPage`] | page |
//! | 5 configure | destination | the value to write | parameter, + 0x80 to write; the epoch byte is a tag |
//! | 6 configured | sender | the present value, or a refusal | parameter, + 0x80 if written; tag |
//! | 7 stimulus | destination | a [`SensorPage`] | page, + 0x80: from the next joints on |
//!
//! In a torque or a sum the largest and the smallest word mean *saturated*.

mod network;
mod sensors;
mod state;

pub use network::{
    Heartbeat, NetworkPage, NetworkPages, PortState, PortsPage, ReceivedCounts, RejectedCounts, TreePage,
};
pub use sensors::{BaselinePage, SensorPage, SensorReadings, SkinSensors};
pub use state::State;

use thiserror::Error;

use crate::fixed::{Q1_14, Q5_10};
use crate::id::{CellId, Command, Id, Kind, Node};
use crate::packet::{self, Epoch, Length, Packet, PacketRef, WORDS, Words};
use crate::parameters::MAX_JOINTS;

/// The version of this protocol, sent in every heartbeat.
pub const VERSION: u8 = 1;

/// Bit in the count byte of a stimulus: the stimulus applies from the next joints on, whatever their epoch.
pub(crate) const FROM_NEXT_JOINTS_FLAG: u8 = 0x80;
/// Bit in the count byte of `configure` and `configured`: the request is a write, not a read.
pub(crate) const WRITE_FLAG: u8 = 0x80;
/// Value of the parameter number in a `configured` packet that refuses a request.
pub(crate) const REFUSAL_NUMBER: u8 = 126;

/// The joint positions of one epoch.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Joints {
    /// Positions: quarter turns of revolute joints, m of prismatic joints, zero for unused joints.
    pub positions: [Q1_14; MAX_JOINTS],
    /// Number of joints in use.
    pub in_use: u8,
}

/// The time from which a stimulus applies.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum StimulusStart {
    /// From the joints of this epoch on.
    Epoch(Epoch),
    /// From the next joints on, whatever their epoch.
    Next,
}

/// The request in a `configure` packet.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Request {
    /// A request for the value of a parameter.
    Read {
        /// The number of the parameter, which need not exist.
        number: u8,
    },
    /// A request to change the value of a parameter.
    Write {
        /// The number of the parameter, which need not exist.
        number: u8,
        /// The new words of the parameter.
        words: [i16; WORDS],
    },
}

/// The reply in a `configured` packet.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Answer {
    /// The value of the parameter after a read or write.
    Value {
        /// The parameter's number.
        number: u8,
        /// True after a write, false after a read.
        written: bool,
        /// The words of the parameter.
        words: [i16; WORDS],
    },
    /// The request was refused.
    Refused {
        /// The parameter's number.
        number: u8,
        /// The reason: [`crate::parameters::ParameterError::code`], or a constant of [`Answer`] such as
        /// [`Answer::REFUSED_WRONG_HASH`].
        reason: i16,
    },
}

impl Answer {
    /// Reason of a refusal: the hash of a commit differs from that of the written parameters.
    pub const REFUSED_WRONG_HASH: i16 = 16;
    /// Reason of a refusal: writing to flash failed.
    pub const REFUSED_FLASH_FAILED: i16 = 17;
    /// Reason of a refusal: the parameter does not exist.
    pub const REFUSED_UNKNOWN_PARAMETER: i16 = 18;
    /// Reason of a refusal: the words are invalid for this parameter, or `links_down` was written outside test mode.
    pub const REFUSED_INVALID_WORDS: i16 = 19;
    /// Reason of a refusal: a tare was requested while the cell is touched, or before it has received joints.
    pub const REFUSED_CELL_TOUCHED: i16 = 20;
    /// Reason of a refusal: the sensor value exceeds the limit of the baseline.
    pub const REFUSED_ABOVE_BASELINE_LIMIT: i16 = 21;
}

/// A decoded packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Message {
    /// A command to stop sending torques and sums until a resume.
    Halt,
    /// A broadcast of joint positions, which begins an epoch.
    Joints {
        /// The epoch that the broadcast begins.
        epoch: Epoch,
        /// The joint positions.
        joints: Joints,
    },
    /// A command to send a heartbeat.
    Sync,
    /// A command to leave the halted state.
    Resume,
    /// A command to send the pages of counters.
    Report,
    /// The sum of the torques of a cell and of all cells below it in the tree.
    Sum {
        /// The sender.
        from: CellId,
        /// The epoch of the joints that the sum answers.
        epoch: Epoch,
        /// Sum in Nm or N in Q7.8, one word per joint.
        torque: Words,
        /// Number of cells whose torque is in the sum. With 0 the sender ends its earlier sums.
        count: u8,
    },
    /// The torque of one cell alone.
    Torque {
        /// The sender.
        from: CellId,
        /// The epoch of the joints that the torque answers.
        epoch: Epoch,
        /// Torque in Nm or N in the torque format of the bus, one word per joint.
        torque: Words,
    },
    /// Measurements of a cell.
    Sensors {
        /// The sender.
        from: CellId,
        /// The epoch of the last accepted joints.
        epoch: Epoch,
        /// The measurements.
        page: SensorPage,
    },
    /// Status of a cell, or of the gateway (node 0).
    Network {
        /// The sender.
        from: Node,
        /// The epoch of the last joints that the sender accepted.
        epoch: Epoch,
        /// The status page.
        page: NetworkPage,
    },
    /// A request to read or write a parameter.
    Configure {
        /// The node whose parameter is requested.
        to: Node,
        /// A tag that the requester chooses and the reply repeats.
        tag: u8,
        /// The request.
        request: Request,
    },
    /// The reply to a request.
    Configured {
        /// The replying cell.
        from: CellId,
        /// The tag of the request.
        tag: u8,
        /// The value of the parameter, or a refusal.
        answer: Answer,
    },
    /// Simulated sensor values for a cell.
    Stimulus {
        /// The node that is to use the values.
        to: Node,
        /// The time from which the stimulus applies.
        from: StimulusStart,
        /// The sensor values.
        page: SensorPage,
    },
}

/// The error for a packet that does not decode to a message.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum MessageError {
    /// The number of the command is undefined.
    #[error("command {0} does not exist: use 0 halt, 1 joints, 2 sync, 3 resume or 4 report")]
    Command(u8),
    /// The node field does not name a node that may send this kind.
    #[error("{kind} from node {node}, which is not a cell", kind = .kind.name())]
    Sender {
        /// The kind of the packet.
        kind: Kind,
        /// The node field.
        node: u8,
    },
    /// The node field does not name a node that this kind may be sent to.
    #[error("{kind} to node {node}, which is not a cell", kind = .kind.name())]
    Addressee {
        /// The kind of the packet.
        kind: Kind,
        /// The node field.
        node: u8,
    },
    /// The page number is undefined for this kind.
    #[error("{kind} page {page} does not exist", kind = .kind.name())]
    Page {
        /// The kind of the packet.
        kind: Kind,
        /// The page number.
        page: u8,
    },
    /// The count byte is out of range for this kind.
    #[error("{kind} with count {got}; allowed: {allowed}", kind = .kind.name())]
    Count {
        /// The kind of the packet.
        kind: Kind,
        /// The count byte.
        got: u8,
        /// The allowed range.
        allowed: &'static str,
    },
}

impl Message {
    /// Decodes a packet. Never panics.
    ///
    /// # Errors
    /// Returns an error if this version of the protocol does not define the packet's kind, page or value.
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
                    check_joint_count(words.length(), count)?;
                    let positions = words.padded().map(Q1_14::from_bits);
                    Self::Joints { epoch, joints: Joints { positions, in_use: count } }
                }
            },
            Kind::Sum if count == 0 && !words.is_zero() => {
                return Err(MessageError::Count {
                    kind,
                    got: count,
                    allowed: "1 to 255, or 0 if all words are 0",
                });
            }
            Kind::Sum => Self::Sum { from: sender()?, epoch, torque: words, count },
            Kind::Torque if count != 1 => {
                return Err(MessageError::Count { kind, got: count, allowed: "1" });
            }
            Kind::Torque => Self::Torque { from: sender()?, epoch, torque: words },
            Kind::Sensors => Self::Sensors {
                from: sender()?,
                epoch,
                page: SensorPage::decode(kind, count, words.first_six())?,
            },
            Kind::Network => match Node::from_byte(node) {
                Node::Everyone => return Err(MessageError::Sender { kind, node }),
                from @ (Node::Gateway | Node::Cell(_)) => {
                    Self::Network { from, epoch, page: NetworkPage::decode(count, words.first_six())? }
                }
            },
            Kind::Configure => {
                let number = count & !WRITE_FLAG;
                let request = if count & WRITE_FLAG == 0 {
                    Request::Read { number }
                } else {
                    Request::Write { number, words: words.first_six() }
                };
                Self::Configure { to: addressee(kind, node)?, tag: epoch.0, request }
            }
            Kind::Configured => {
                let number = count & !WRITE_FLAG;
                let words = words.first_six();
                let answer = match words {
                    [refused, reason, ..] if number == REFUSAL_NUMBER => {
                        Answer::Refused { number: refused.to_le_bytes()[0], reason }
                    }
                    _ => Answer::Value { number, written: count & WRITE_FLAG != 0, words },
                };
                Self::Configured { from: sender()?, tag: epoch.0, answer }
            }
            Kind::Stimulus => {
                let from = if count & FROM_NEXT_JOINTS_FLAG == 0 {
                    StimulusStart::Epoch(epoch)
                } else {
                    StimulusStart::Next
                };
                let page = SensorPage::decode(kind, count & !FROM_NEXT_JOINTS_FLAG, words.first_six())?;
                Self::Stimulus { to: addressee(kind, node)?, from, page }
            }
        })
    }

    /// Encodes the message as a packet.
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
                    Request::Read { number } => (number & !WRITE_FLAG, [0; WORDS]),
                    Request::Write { number, words } => (number | WRITE_FLAG, words),
                };
                packet(words, Epoch(tag), count)
            }
            Self::Configured { tag, answer, .. } => {
                let (count, words) = match answer {
                    Answer::Value { number, written, words } => {
                        (number | if written { WRITE_FLAG } else { 0 }, words)
                    }
                    Answer::Refused { number, reason } => {
                        (REFUSAL_NUMBER, packet::padded_words([i16::from(number), reason]))
                    }
                };
                packet(words, Epoch(tag), count)
            }
            Self::Stimulus { from, page, .. } => {
                let (page, words) = page.encode();
                let (epoch, flag) = match from {
                    StimulusStart::Epoch(epoch) => (epoch, 0),
                    StimulusStart::Next => (Epoch(0), FROM_NEXT_JOINTS_FLAG),
                };
                packet(words, epoch, page | flag)
            }
        }
    }
}

impl Message {
    /// Returns the identifier that the message is sent with.
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

    /// Returns the sending cell; `None` if the gateway's side sends it.
    #[must_use]
    pub fn sender(&self) -> Option<CellId> {
        self.id().sender()
    }

    /// Returns the epoch of a message; `None` for a kind without one.
    #[must_use]
    pub const fn epoch(&self) -> Option<Epoch> {
        match *self {
            Self::Joints { epoch, .. }
            | Self::Sum { epoch, .. }
            | Self::Torque { epoch, .. }
            | Self::Sensors { epoch, .. }
            | Self::Network { epoch, .. }
            | Self::Stimulus { from: StimulusStart::Epoch(epoch), .. } => Some(epoch),
            Self::Halt
            | Self::Sync
            | Self::Resume
            | Self::Report
            | Self::Configure { .. }
            | Self::Configured { .. }
            | Self::Stimulus { from: StimulusStart::Next, .. } => None,
        }
    }

    /// Returns the tag of a request or reply; `None` for other messages.
    #[must_use]
    pub const fn configuration_tag(&self) -> Option<u8> {
        if let Self::Configure { tag, .. } | Self::Configured { tag, .. } = *self { Some(tag) } else { None }
    }

    /// Returns the sensor page of a measurement or a stimulus; `None` for other messages.
    #[must_use]
    pub const fn sensor_page(&self) -> Option<SensorPage> {
        if let Self::Sensors { page, .. } | Self::Stimulus { page, .. } = *self { Some(page) } else { None }
    }

    /// Returns true if a torque or sum has a word that means *saturated*; `None` for other messages.
    #[must_use]
    pub fn is_saturated(&self) -> Option<bool> {
        self.torque_words().map(|words| words.is_saturated())
    }

    /// Returns true if the message reports a touch: a nonzero torque or sum, a sensor page or stimulus with a
    /// contact force or proximity, or the heartbeat of an active cell.
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

    /// Returns the words of a torque or a sum; `None` for other messages.
    const fn torque_words(&self) -> Option<Words> {
        if let Self::Torque { torque, .. } | Self::Sum { torque, .. } = *self { Some(torque) } else { None }
    }
}

impl Joints {
    /// Returns the positions as words, in the shortest packet length that holds the joints in use.
    fn words(&self) -> Words {
        Words::new(Length::for_joints(self.in_use.into()), self.positions.map(Q1_14::to_bits))
    }
}

/// Writes the positions of a joints packet to the first elements of `positions`, and leaves those beyond its words
/// unchanged. Returns the number of joints in use. It is for cells: they need no [`Message`].
///
/// # Errors
/// Returns an error if a packet of this length cannot have so many joints.
#[inline]
pub fn read_joints(packet: &PacketRef<'_>, positions: &mut [Q1_14; MAX_JOINTS]) -> Result<u8, MessageError> {
    check_joint_count(packet.length(), packet.count())?;
    for (position, word) in positions.iter_mut().zip(packet.words()) {
        // Else this is a call of memcpy, which takes a Cortex-M0 longer than the loop.
        core::hint::black_box(());
        *position = Q1_14::from_bits(word);
    }
    Ok(packet.count())
}

/// Checks the number of joints in use in a packet of this length.
fn check_joint_count(length: Length, count: u8) -> Result<(), MessageError> {
    let (counts, allowed) = match length {
        Length::Six => (1..=6, "1 to 6"),
        Length::Eight => (7..=8, "7 or 8"),
        Length::Ten => (9..=10, "9 or 10"),
        Length::Fourteen => (11..=14, "11 to 14"),
    };
    let kind = Kind::Command;
    if counts.contains(&count) { Ok(()) } else { Err(MessageError::Count { kind, got: count, allowed }) }
}

fn addressee(kind: Kind, node: u8) -> Result<Node, MessageError> {
    match Node::from_byte(node) {
        Node::Gateway => Err(MessageError::Addressee { kind, node }),
        to @ (Node::Cell(_) | Node::Everyone) => Ok(to),
    }
}

#[cfg(test)]
mod tests;
