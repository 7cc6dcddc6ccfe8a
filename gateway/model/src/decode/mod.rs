//! What frames mean, as text: `skinbus dump` shows it beside the raw frame.
//!
//! ```text
//!   frame, time, bus ──> Decoder ──> Decoded ──> one line of text
//!                          └ for each bus a PacketReader; for each identifier, whether packets use it
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
use protocol::id::Id;
use protocol::message::{Message, MessageError};
use protocol::packet::{Packet, PacketError, data_id};
use protocol::port::{self, PortMessage};
use protocol::time::Micros;
use std::collections::VecDeque;
use thiserror::Error;

use crate::packets::{Content, PacketReader, Received};

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

/// Classifies a frame that never is a packet.
fn not_data(frame: &Frame) -> Decoded {
    let wired = wired(frame).map(|(link_id, message)| Decoded::Wire(link_id, message));
    wired.unwrap_or_else(|| Decoded::Foreign(Foreign::of(frame)))
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

/// Classifies the frames of many buses.
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
    packets: PacketReader,
    classifier: Classifier,
}

/// Classifies the frames of one bus that a [`PacketReader`] has read.
#[derive(Clone, Debug, Default)]
struct Classifier {
    /// By identifier, of those that came: a capture may name any number of buses, each with a few of them.
    ids: Vec<Option<Box<Slot>>>,
}

/// An identifier of a bus.
#[derive(Clone, Debug, Default)]
struct Slot {
    /// The numbers of the frames that wait.
    waiting: VecDeque<u64>,
    traffic: Traffic,
}

impl Slot {
    /// Frames that waited are given up, but for so many of the newest.
    fn drop_beyond(&mut self, kept: usize, id: Id, settled: &mut Vec<(u64, Decoded)>) {
        for _ in kept..self.waiting.len() {
            if let Some(number) = self.waiting.pop_front() {
                settled.push((number, self.refuse(id, PacketError::Incomplete)));
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

/// The class of a frame, and the numbers and classes of those that waited under its identifier and are now settled.
/// A [`Decoded::Segment`] waits itself.
type Classified = (Decoded, Vec<(u64, Decoded)>);

impl Classifier {
    /// Classifies a frame under a number.
    fn take(&mut self, number: u64, received: &Received<'_>) -> Classified {
        match received.content {
            Content::NotData => (not_data(received.frame), Vec::new()),
            Content::Message(id, packet, message) => (Decoded::Message(message), self.packet(id, &packet)),
            Content::Meaningless(id, packet, error) => {
                (Decoded::Meaningless { packet, error }, self.packet(id, &packet))
            }
            Content::Segment(id) | Content::AfterLost(id) => {
                let (slot, mut settled) = (self.slot(id), Vec::new());
                slot.waiting.push_back(number);
                slot.drop_beyond(received.waiting, id, &mut settled);
                (Decoded::Segment { id }, settled)
            }
            Content::Damaged(id, fault) => {
                let (slot, mut settled) = (self.slot(id), Vec::new());
                if fault == PacketError::Ambiguous {
                    slot.drop_beyond(0, id, &mut settled);
                }
                (slot.refuse(id, fault), settled)
            }
        }
    }

    /// Counts a packet, and settles the frames that waited for it.
    fn packet(&mut self, id: Id, packet: &Packet) -> Vec<(u64, Decoded)> {
        let (slot, mut settled) = (self.slot(id), Vec::new());
        slot.drop_beyond(packet.words.length().segments() - 1, id, &mut settled);
        settled.extend(slot.waiting.drain(..).map(|number| (number, Decoded::Segment { id })));
        slot.traffic.packet();
        settled
    }

    fn slot(&mut self, id: Id) -> &mut Slot {
        if self.ids.is_empty() {
            self.ids.resize(IDS, None);
        }
        self.ids.get_mut(usize::from(id.to_bits())).expect("11 bits").get_or_insert_default()
    }
}

impl Decoder {
    /// For buses of one format; with `None` each frame is taken for what it is.
    #[must_use]
    pub const fn new(format: Option<Format>) -> Self {
        Self { format, buses: Vec::new(), seen: 0 }
    }

    /// Takes the next frame. A classic frame may be settled only later: it is a [`Decoded::Segment`] until then;
    /// [`settle::Settler`] waits. Bounded memory, whatever comes. Never panics.
    pub fn decode(&mut self, at: Micros, bus: &str, frame: &Frame) -> Decoded {
        self.take(0, at, bus, frame).1.0
    }

    /// Takes the next frame under a number; returns the number of its bus, too.
    fn take(&mut self, number: u64, at: Micros, bus: &str, frame: &Frame) -> (u64, Classified) {
        if data_id(frame).is_err() {
            return (0, (not_data(frame), Vec::new()));
        }
        let bus = self.bus(bus);
        (bus.number, bus.classifier.take(number, &bus.packets.read(at, frame)))
    }

    /// What a segment is when the others of its packet do not come any more.
    fn give_up(&mut self, number: u64, bus: u64, id: Id) -> Decoded {
        let found = self.buses.iter_mut().find(|it| it.number == bus).and_then(|bus| {
            let slot = bus.classifier.ids.get_mut(usize::from(id.to_bits()))?.as_mut()?;
            (slot.waiting.front() == Some(&number)).then_some((slot, &mut bus.packets))
        });
        let Some((slot, packets)) = found else {
            return Decoded::Foreign(Foreign::Data(PacketError::Incomplete));
        };
        slot.waiting.pop_front();
        if slot.waiting.is_empty() {
            packets.drop_segments(id);
        }
        slot.refuse(id, PacketError::Incomplete)
    }

    fn bus(&mut self, name: &str) -> &mut Bus {
        let at = self.buses.iter().position(|bus| bus.name == name).unwrap_or_else(|| {
            if self.buses.len() == BUSES {
                self.buses.remove(0);
            }
            self.seen += 1;
            self.buses.push(Bus {
                name: name.to_owned(),
                number: self.seen,
                packets: PacketReader::new(self.format),
                classifier: Classifier::default(),
            });
            self.buses.len() - 1
        });
        self.buses.get_mut(at).expect("found, or just made")
    }
}

#[cfg(test)]
mod tests;
