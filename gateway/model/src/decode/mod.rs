//! What frames mean, as text: `skinbus dump` shows it beside the raw frame.
//!
//! ```text
//!   frame, time, bus ──> Decoder ──> Decoded ──> one line of text
//!                          └ for each identifier of each bus: a waiting segment, and whether packets use it
//! ```
//!
//! A frame is ours as a whole packet with the right CRC, or as a segment of a classic packet. Every other
//! frame is foreign; with an identifier that carries packets it is damaged. Each line begins with a verdict of one word:
//! `ok`, `segment` (a frame before the last of a packet; classic buses), `foreign`; damaged: `length`, `CRC`, `incomplete`, `ambiguous`; a packet
//! without a known meaning: `meaning`.

mod error_frame;
mod fields;
pub mod json;
pub mod parameter;
pub mod pick;
mod ports;
pub mod settle;
mod text;
mod wires;

pub use error_frame::{ErrorFrame, error_classes};
pub use text::InUnits;

use protocol::can::{Format, Frame};
use protocol::id::{Command, Id};
use protocol::message::{Message, MessageError};
use protocol::packet::{Length, Lengths, Packet, PacketError, Reassembly, Segment, data_id};
use protocol::port::{self, PortMessage};
use protocol::time::Micros;
use std::collections::VecDeque;
use thiserror::Error;

/// Buses that are distinguished at the same time: of more, the oldest is forgotten, or they are taken together.
pub const BUSES: usize = 64;
/// Identifiers of 11 bits.
const IDS: usize = 0x800;

/// What a frame is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decoded {
    /// No frame of this protocol.
    Foreign(Foreign),
    /// A message of a cell, or of the gateway, over a simulated wire. It is on no real bus.
    Wire(port::LinkId, PortMessage),
    /// A segment of a packet in classic frames, but the last one; from [`Decoder::decode`], a frame that may be one.
    Segment {
        /// Its identifier.
        id: Id,
    },
    /// No packet, under an identifier that carries packets.
    Damaged {
        /// Its identifier.
        id: Id,
        /// Why it is no packet.
        fault: PacketError,
    },
    /// A packet without a meaning in this version.
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
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
pub enum Foreign {
    /// 29 bits.
    #[error("29-bit identifier")]
    Extended,
    /// It asks for data.
    #[error("remote frame")]
    Remote,
    /// The driver's report of an error.
    #[error("error frame: {0}")]
    Error(ErrorFrame),
    /// A data frame with an 11-bit identifier under which no packets come.
    #[error("no packet: {0}")]
    Data(PacketError),
}

impl Foreign {
    fn of(frame: &Frame) -> Self {
        if frame.is_error() {
            Self::Error(ErrorFrame::of(frame))
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
            Self::Segment { .. } => "segment",
            Self::Foreign(_) => "foreign",
            Self::Damaged { fault, .. } => fault.name(),
            Self::Meaningless { .. } => "meaning",
        }
    }

    /// The message, if it is one.
    #[must_use]
    pub const fn message(&self) -> Option<&Message> {
        if let Self::Message(message) = self { Some(message) } else { None }
    }

    /// Whether a word of a torque or a sum means *saturated*.
    #[must_use]
    pub fn is_saturated(&self) -> bool {
        self.message().and_then(Message::is_saturated).unwrap_or(false)
    }

    /// Whether this shows a touch.
    #[must_use]
    pub fn is_contact(&self) -> bool {
        self.message().is_some_and(Message::is_contact)
    }
}

/// The message of a frame over a simulated wire. `None` if its identifier or CRC is not that of a wire: 29 bits are
/// common on other buses.
#[must_use]
pub fn wired(frame: &Frame) -> Option<(port::LinkId, PortMessage)> {
    let link_id = port::LinkId::from_raw_id(frame.raw_id()).filter(|_| frame.format() == Format::Classic)?;
    Some((link_id, link_id.read(frame)?))
}

/// What came with an identifier, and so whether it is one of ours.
#[derive(Clone, Copy, Debug, Default)]
pub struct Traffic {
    packets: u64,
    others: u64,
}

impl Traffic {
    /// So many packets are enough: chance makes one of two frames in 65 536.
    const PACKETS: u64 = 2;
    /// For each packet there may be so many frames that are none.
    const OTHERS: u64 = 32;

    /// A packet came.
    pub const fn packet(&mut self) {
        self.packets += 1;
    }

    /// A frame came that is no packet and no segment.
    pub const fn other(&mut self) {
        self.others += 1;
    }

    /// Whether the identifier carries packets: then what is no packet is damaged, else it is foreign.
    #[must_use]
    pub const fn carries_packets(self) -> bool {
        self.packets >= Self::PACKETS && self.others <= Self::OTHERS * self.packets
    }
}

/// Classifies frames, and reassembles segments.
#[derive(Clone, Debug)]
pub struct Decoder {
    format: Option<Format>,
    buses: Vec<Bus>,
    /// Buses seen, also those that are forgotten.
    seen: u64,
}

/// A bus as it is followed.
#[derive(Clone, Debug)]
struct Bus {
    name: String,
    /// Another one than that of any bus before it.
    number: u64,
    /// By identifier, of those that came: a capture may name any number of buses, each with a few of them.
    ids: Vec<Option<Box<Slot>>>,
    /// How long joints, torques and sums are, as the joints said whose number of joints has that length.
    length: Option<Length>,
}

/// An identifier of a bus.
#[derive(Clone, Debug, Default)]
struct Slot {
    segment: Segment,
    /// The numbers of the frames that wait.
    waiting: VecDeque<u64>,
    traffic: Traffic,
}

impl Slot {
    /// Frames that waited are given up, but for so many of the newest.
    fn drop_beyond(&mut self, kept: usize, id: Id, older: &mut Vec<(u64, Decoded)>) {
        for _ in kept..self.waiting.len() {
            if let Some(number) = self.waiting.pop_front() {
                older.push((number, self.refuse(id, PacketError::Incomplete)));
            }
        }
    }

    /// A frame that is no packet and no segment.
    const fn refuse(&mut self, id: Id, fault: PacketError) -> Decoded {
        self.traffic.other();
        if self.traffic.carries_packets() {
            Decoded::Damaged { id, fault }
        } else {
            Decoded::Foreign(Foreign::Data(fault))
        }
    }
}

/// What came of a frame, and with it of the one that waited under its identifier.
struct Taken {
    decoded: Decoded,
    /// On which bus it waits for its second segment.
    waits: Option<u64>,
    /// The numbers of frames that waited, and what they were.
    older: Vec<(u64, Decoded)>,
}

impl From<Decoded> for Taken {
    fn from(decoded: Decoded) -> Self {
        Self { decoded, waits: None, older: Vec::new() }
    }
}

impl Decoder {
    /// For buses of one format; with `None` each frame is taken for what it is.
    #[must_use]
    pub const fn new(format: Option<Format>) -> Self {
        Self { format, buses: Vec::new(), seen: 0 }
    }

    /// Takes the next frame. What a classic frame is may come out only later: it is told as a [`Decoded::Segment`]
    /// until then; [`settle::Settler`] waits. Bounded memory, whatever comes. Never panics.
    pub fn decode(&mut self, at: Micros, bus: &str, frame: &Frame) -> Decoded {
        self.take(0, at, bus, frame).decoded
    }

    /// Takes the next frame under a number.
    fn take(&mut self, number: u64, at: Micros, bus: &str, frame: &Frame) -> Taken {
        let Ok(id) = data_id(frame) else {
            let wired = wired(frame).map(|(link_id, message)| Decoded::Wire(link_id, message));
            return wired.unwrap_or_else(|| Decoded::Foreign(Foreign::of(frame))).into();
        };
        let format = self.format.unwrap_or_else(|| frame.format());
        let bus = self.bus(bus);
        let on = bus.number;
        // Joints say themselves how long they are.
        let is_joints = id == Id::command(Command::Joints);
        let lengths = Lengths::of_chain(bus.length.filter(|_| !is_joints));
        let slot = bus.ids.get_mut(usize::from(id.to_bits())).expect("11 bits").get_or_insert_default();
        let mut older = Vec::new();
        let packet = match format {
            Format::Fd => Packet::from_fd(frame),
            Format::Classic if frame.format() == Format::Fd => {
                Err(PacketError::Length { expected: 8, got: frame.data().len() })
            }
            Format::Classic => match slot.segment.push(at, id, lengths, frame.data()) {
                Ok(Reassembly::Waiting | Reassembly::Incomplete) => {
                    slot.waiting.push_back(number);
                    slot.drop_beyond(slot.segment.waiting(), id, &mut older);
                    return Taken { decoded: Decoded::Segment { id }, waits: Some(on), older };
                }
                Ok(Reassembly::Complete(packet)) => {
                    slot.drop_beyond(packet.words.length().segments() - 1, id, &mut older);
                    older.extend(slot.waiting.drain(..).map(|older| (older, Decoded::Segment { id })));
                    Ok(packet)
                }
                Ok(Reassembly::Ambiguous) => {
                    slot.drop_beyond(0, id, &mut older);
                    Err(PacketError::Ambiguous)
                }
                Err(error) => Err(error),
            },
        };
        let decoded = match packet {
            Ok(packet) => {
                slot.traffic.packet();
                match Message::decode(&packet) {
                    Ok(message) => {
                        if let Message::Joints { joints, .. } = message {
                            bus.length = Some(Length::for_joints(joints.in_use.into()));
                        }
                        Decoded::Message(message)
                    }
                    Err(error) => Decoded::Meaningless { packet, error },
                }
            }
            Err(error) => slot.refuse(id, error),
        };
        Taken { decoded, waits: None, older }
    }

    /// What a segment is when the second one does not come any more.
    fn give_up(&mut self, number: u64, bus: u64, id: Id) -> Decoded {
        let slots = self.buses.iter_mut().find(|it| it.number == bus).map(|bus| &mut bus.ids);
        let slot = slots.and_then(|slots| slots.get_mut(usize::from(id.to_bits()))?.as_mut());
        let Some(slot) = slot.filter(|slot| slot.waiting.front() == Some(&number)) else {
            return Decoded::Foreign(Foreign::Data(PacketError::Incomplete));
        };
        slot.waiting.pop_front();
        if slot.waiting.is_empty() {
            slot.segment = Segment::NONE;
        }
        slot.refuse(id, PacketError::Incomplete)
    }

    fn bus(&mut self, name: &str) -> &mut Bus {
        let at = self.buses.iter().position(|bus| bus.name == name).unwrap_or_else(|| {
            if self.buses.len() == BUSES {
                self.buses.remove(0);
            }
            self.seen += 1;
            let ids = vec![None; IDS];
            self.buses.push(Bus { name: name.to_owned(), number: self.seen, ids, length: None });
            self.buses.len() - 1
        });
        self.buses.get_mut(at).expect("found, or just made")
    }
}

#[cfg(test)]
mod tests;
