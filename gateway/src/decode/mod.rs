//! What frames mean, in words for people: `gateway dump` shows it beside the raw frame.
//!
//! ```text
//!   frame, time, bus ──> Decoder ──> Decoded ──> one line of text
//!                          └ a waiting half for each identifier of each classic bus
//! ```
//!
//! Each line begins with a verdict of one word, by the names under which cells and the gateway count what
//! they refuse: `ok`, `half` (the first frame of two; classic buses), `foreign`, `length`, `CRC`, `meaning`.

pub mod json;
pub mod parameter;
pub mod pick;
pub mod stats;
mod switch;
mod text;
mod wires;

use protocol::can::{Format, Frame};
use protocol::fixed::Q;
use protocol::id::Id;
use protocol::message::{Message, MessageError, NetworkPage, SensorPage, State};
use protocol::packet::{Half, Packet, PacketError, Paired, WORDS, data_id};
use protocol::time::Micros;
use protocol::wire::{self, PortMessage};

/// Classic buses whose halves are paired at the same time; beyond them the oldest is forgotten.
const LANES: usize = 64;
/// Identifiers of 11 bits.
const IDS: usize = 0x800;

/// What a frame is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decoded {
    /// No frame of this protocol.
    Foreign(Foreign),
    /// What a cell, or the gateway's side, says over a simulated wire. It is on no real bus.
    Wire(wire::Lane, PortMessage),
    /// The first half of a packet in two classic frames.
    Half {
        /// Its identifier.
        id: Id,
        /// Whether a half was waiting already, which did not belong to this one and is dropped.
        incomplete: bool,
    },
    /// A frame under our identifiers that is no packet.
    Refused {
        /// Its identifier.
        id: Id,
        /// Why.
        error: PacketError,
    },
    /// A packet that says nothing this version knows.
    Meaningless {
        /// The packet.
        packet: Packet,
        /// Why.
        error: MessageError,
    },
    /// A packet and its meaning.
    Message(Message),
}

/// Why a frame is none of this protocol's.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Foreign {
    /// 29 bits.
    Extended,
    /// It asks for data.
    Remote,
    /// The driver's report of an error.
    Error,
}

impl Foreign {
    const fn of(frame: &Frame) -> Self {
        if frame.is_error() {
            Self::Error
        } else if frame.is_remote() {
            Self::Remote
        } else {
            Self::Extended
        }
    }
}

impl Decoded {
    /// The verdict, as a line begins with it.
    #[must_use]
    pub const fn verdict(&self) -> &'static str {
        match self {
            Self::Message(_) | Self::Wire(..) => "ok",
            Self::Half { .. } => "half",
            Self::Foreign(_) | Self::Refused { error: PacketError::Foreign, .. } => "foreign",
            Self::Refused { error: PacketError::Length { .. }, .. } => "length",
            Self::Refused { error: PacketError::Crc { .. }, .. } => "CRC",
            Self::Refused { .. } => "refused",
            Self::Meaningless { .. } => "meaning",
        }
    }

    /// Whether a word of a torque or a sum means *saturated*.
    #[must_use]
    pub fn is_saturated(&self) -> bool {
        match self {
            Self::Message(Message::Torque { torque, .. }) => torque.iter().copied().any(Q::is_saturated),
            Self::Message(Message::Sum { torque, .. }) => torque.iter().copied().any(Q::is_saturated),
            Self::Message(_)
            | Self::Foreign(_)
            | Self::Wire(..)
            | Self::Half { .. }
            | Self::Refused { .. }
            | Self::Meaningless { .. } => false,
        }
    }
}

/// Tells what frames are, pairing halves on the way.
#[derive(Debug)]
pub struct Decoder {
    format: Option<Format>,
    lanes: Vec<Lane>,
}

/// A classic bus.
#[derive(Debug)]
struct Lane {
    bus: String,
    /// By identifier.
    halves: Vec<Half>,
}

impl Decoded {
    /// Whether this tells of a touch: a torque or a sum that is not all zero, a stimulus or sensors with a contact
    /// force or a proximity, a heartbeat of an active cell.
    #[must_use]
    pub fn is_contact(&self) -> bool {
        let felt = |page: &SensorPage| match page {
            SensorPage::Skin(skin) => skin.contact != [Q::ZERO; 3] || skin.proximity != Q::ZERO,
            SensorPage::Acceleration(_) => false,
        };
        match self {
            Self::Message(message) => match message {
                Message::Torque { torque, .. } => *torque != [Q::ZERO; WORDS],
                Message::Sum { torque, .. } => *torque != [Q::ZERO; WORDS],
                Message::Sensors { page, .. } | Message::Stimulus { page, .. } => felt(page),
                Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } => {
                    heartbeat.state.has(State::ACTIVE)
                }
                Message::Network { .. }
                | Message::Halt
                | Message::Joints { .. }
                | Message::Sync
                | Message::Resume
                | Message::Report
                | Message::Configure { .. }
                | Message::Configured { .. } => false,
            },
            Self::Foreign(_)
            | Self::Wire(..)
            | Self::Half { .. }
            | Self::Refused { .. }
            | Self::Meaningless { .. } => false,
        }
    }
}

/// What a frame says over a simulated wire. One whose identifier or CRC says otherwise is anybody's: 29 bits are
/// common on other buses.
#[must_use]
pub fn wired(frame: &Frame) -> Option<(wire::Lane, PortMessage)> {
    let lane = wire::Lane::from_raw_id(frame.raw_id()).filter(|_| frame.format() == Format::Classic)?;
    Some((lane, lane.read(frame)?))
}

impl Decoder {
    /// For buses of one format; with `None` each frame is taken for what it is.
    #[must_use]
    pub const fn new(format: Option<Format>) -> Self {
        Self { format, lanes: Vec::new() }
    }

    /// Takes the next frame. Bounded memory, whatever comes. Never panics.
    pub fn decode(&mut self, at: Micros, bus: &str, frame: &Frame) -> Decoded {
        let Ok(id) = data_id(frame) else {
            return wired(frame).map_or_else(
                || Decoded::Foreign(Foreign::of(frame)),
                |(lane, message)| Decoded::Wire(lane, message),
            );
        };
        let packet = match self.format.unwrap_or_else(|| frame.format()) {
            Format::Fd => Packet::from_fd(frame),
            Format::Classic => match self.pair(at, bus, id, frame) {
                Ok(Paired::Waiting) => return Decoded::Half { id, incomplete: false },
                Ok(Paired::Incomplete) => return Decoded::Half { id, incomplete: true },
                Ok(Paired::Whole(packet)) => Ok(packet),
                Err(error) => Err(error),
            },
        };
        match packet.map(|packet| (packet, Message::decode(&packet))) {
            Ok((_, Ok(message))) => Decoded::Message(message),
            Ok((packet, Err(error))) => Decoded::Meaningless { packet, error },
            Err(error) => Decoded::Refused { id, error },
        }
    }

    fn pair(&mut self, at: Micros, bus: &str, id: Id, frame: &Frame) -> Result<Paired, PacketError> {
        let wrong = PacketError::Length { expected: 8, got: frame.data().len() };
        if frame.format() == Format::Fd {
            return Err(wrong);
        }
        let half = self.lane(bus).halves.get_mut(usize::from(id.to_bits())).ok_or(wrong)?;
        half.push(at, id, frame.data())
    }

    fn lane(&mut self, bus: &str) -> &mut Lane {
        let at = self.lanes.iter().position(|lane| lane.bus == bus).unwrap_or_else(|| {
            if self.lanes.len() == LANES {
                self.lanes.remove(0);
            }
            self.lanes.push(Lane { bus: bus.to_owned(), halves: vec![Half::NONE; IDS] });
            self.lanes.len() - 1
        });
        self.lanes.get_mut(at).expect("found, or just made")
    }
}

#[cfg(test)]
mod tests;
