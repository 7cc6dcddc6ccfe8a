//! The meaning of frames as text, as `skinbus dump` shows it beside the raw frame.
//!
//! ```text
//!   frame, time, bus ──> Decoder ──> Decoded ──> one line of text
//!                          └ per bus a PacketReader; per identifier, whether it carries packets
//! ```
//!
//! A frame belongs to this protocol if it is a packet with the right CRC, or a segment of a classic packet. Every other
//! frame is foreign, or damaged if its identifier carries packets. Each line begins with a one-word verdict: `ok`,
//! `segment` (a frame before the last of a packet; classic buses), `foreign`; damaged: `length`, `CRC`, `incomplete`,
//! `ambiguous`; a packet without a known meaning: `meaning`.

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
use protocol::packet::{Packet, PacketError, data_frame_id};
use protocol::port::{self, PortMessage};
use protocol::time::Micros;
use std::collections::VecDeque;
use thiserror::Error;

use protocol::packets::{ByIdentifier, FrameWithPacket, NoPacketReason, PacketReader};

/// Maximum number of buses whose state is kept. Beyond it, the state of the oldest bus is dropped.
pub const MAX_BUSES: usize = 64;

/// A frame by its meaning: foreign, damaged, a segment, or a decoded message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decoded {
    /// A frame of another protocol.
    Foreign(ForeignReason),
    /// A message of a cell, or of the gateway, over a simulated wire. Real buses do not carry such frames.
    Wire(port::LinkId, PortMessage),
    /// A segment of a packet in classic frames, except the last one; when [`Decoder::decode`] returns it, the frame may
    /// still turn out to be something else.
    Segment {
        /// Identifier of the frame.
        id: Id,
    },
    /// A frame that is not a packet, under an identifier that carries packets.
    Damaged {
        /// Identifier of the frame.
        id: Id,
        /// The reason why the frame is not a packet.
        fault: PacketError,
    },
    /// A packet that this version cannot decode.
    Meaningless {
        /// The packet.
        packet: Packet,
        /// The reason why the packet cannot be decoded.
        error: MessageError,
    },
    /// A decoded packet.
    Message(Message),
}

/// The reason why a frame does not belong to this protocol.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
pub enum ForeignReason {
    /// The frame has a 29-bit identifier.
    #[error("29-bit identifier")]
    Extended,
    /// The frame is a remote frame.
    #[error("remote frame")]
    Remote,
    /// The frame is the driver's error report.
    #[error("error frame: {0}")]
    Error(ErrorFrame),
    /// The frame is a data frame with an 11-bit identifier that carries no packets.
    #[error("no packet: {0}")]
    Data(PacketError),
}

impl ForeignReason {
    fn from_frame(frame: &Frame) -> Self {
        if frame.is_error() {
            Self::Error(ErrorFrame::new(frame))
        } else if frame.is_remote() {
            Self::Remote
        } else {
            Self::Extended
        }
    }
}

impl Decoded {
    /// Returns the one-word verdict with which the line of this frame begins.
    #[must_use]
    pub const fn verdict_word(&self) -> &'static str {
        match self {
            Self::Message(_) | Self::Wire(..) => "ok",
            Self::Segment { .. } => "segment",
            Self::Foreign(_) => "foreign",
            Self::Damaged { fault, .. } => fault.name(),
            Self::Meaningless { .. } => "meaning",
        }
    }

    /// Returns the decoded message; `None` for a frame without one.
    #[must_use]
    pub const fn message(&self) -> Option<&Message> {
        if let Self::Message(message) = self { Some(message) } else { None }
    }

    /// Returns true if a word of a torque or a sum is saturated.
    #[must_use]
    pub fn is_saturated(&self) -> bool {
        self.message().and_then(Message::is_saturated).unwrap_or(false)
    }

    /// Returns true if the message shows a touch: a nonzero torque or sum, touched sensors, or an active cell.
    #[must_use]
    pub fn is_contact(&self) -> bool {
        self.message().is_some_and(Message::is_contact)
    }
}

/// Classifies a frame that cannot be a packet.
fn classify_non_data(frame: &Frame) -> Decoded {
    let wired = port::wire_message(frame).map(|(link_id, message)| Decoded::Wire(link_id, message));
    wired.unwrap_or_else(|| Decoded::Foreign(ForeignReason::from_frame(frame)))
}

/// Frame counts of one identifier, which decide whether it carries packets.
#[derive(Clone, Copy, Debug, Default)]
pub struct IdentifierFrameCounts {
    packets: u64,
    others: u64,
}

impl IdentifierFrameCounts {
    /// Minimum number of packets that prove that an identifier carries packets: a random frame is a packet with
    /// probability 1/65 536.
    const MIN_PROVING_PACKETS: u64 = 2;
    /// Maximum number of other frames for each packet, for an identifier that carries packets.
    const MAX_OTHER_FRAMES_PER_PACKET: u64 = 32;

    /// Counts a packet.
    pub const fn count_packet(&mut self) {
        self.packets += 1;
    }

    /// Counts a frame that is neither a packet nor a segment.
    pub const fn count_other_frame(&mut self) {
        self.others += 1;
    }

    /// Returns true if the identifier carries packets. If so, other frames with it count as damaged, else as foreign.
    #[must_use]
    pub const fn carries_packets(self) -> bool {
        self.packets >= Self::MIN_PROVING_PACKETS
            && self.others <= Self::MAX_OTHER_FRAMES_PER_PACKET * self.packets
    }
}

/// Classifies the frames of many buses.
#[derive(Clone, Debug)]
pub struct Decoder {
    format: Option<Format>,
    buses: Vec<BusDecoder>,
    /// Number of buses so far, including those whose state was dropped.
    seen: u64,
}

/// The state of one bus.
#[derive(Clone, Debug)]
struct BusDecoder {
    name: String,
    /// Unique number of the bus, never reused.
    number: u64,
    packets: PacketReader,
    classifier: Classifier,
}

/// Classifies the frames of one bus that a [`PacketReader`] has read.
#[derive(Clone, Debug, Default)]
struct Classifier {
    ids: ByIdentifier<IdentifierState>,
}

/// The state of one identifier of a bus.
#[derive(Clone, Debug, Default)]
struct IdentifierState {
    /// Numbers of the frames that may be segments of a packet and wait for its other segments.
    waiting: VecDeque<u64>,
    traffic: IdentifierFrameCounts,
}

impl IdentifierState {
    /// Settles the pending frames as refused, except the newest `kept`; their numbers and classes are appended to
    /// `settled`.
    fn refuse_older_segments(&mut self, kept: usize, id: Id, settled: &mut Vec<(u64, Decoded)>) {
        for _ in kept..self.waiting.len() {
            if let Some(number) = self.waiting.pop_front() {
                settled.push((number, self.classify_unreadable(id, PacketError::Incomplete)));
            }
        }
    }

    /// Classifies a frame that is neither a packet nor a segment.
    const fn classify_unreadable(&mut self, id: Id, fault: PacketError) -> Decoded {
        self.traffic.count_other_frame();
        if self.traffic.carries_packets() {
            Decoded::Damaged { id, fault }
        } else {
            Decoded::Foreign(ForeignReason::Data(fault))
        }
    }
}

/// The class of a frame, and the numbers and classes of earlier frames of its identifier that are settled now. A
/// [`Decoded::Segment`] is itself pending.
type ClassifiedFrames = (Decoded, Vec<(u64, Decoded)>);

impl Classifier {
    /// Classifies the frame with this number.
    fn classify(&mut self, number: u64, received: &FrameWithPacket<'_>) -> ClassifiedFrames {
        let id = match received.packet {
            Ok((packet, message)) => {
                let settled = self.settle_packet(&packet);
                return match message {
                    Ok(message) => (Decoded::Message(message), settled),
                    Err(error) => (Decoded::Meaningless { packet, error }, settled),
                };
            }
            Err(NoPacketReason::NotData) => return (classify_non_data(received.frame), Vec::new()),
            Err(NoPacketReason::Segment(id) | NoPacketReason::AfterLost(id)) => id,
            Err(NoPacketReason::Damaged(id, fault)) => {
                let (slot, mut settled) = (self.ids.entry(id), Vec::new());
                if fault == PacketError::Ambiguous {
                    slot.refuse_older_segments(0, id, &mut settled);
                }
                return (slot.classify_unreadable(id, fault), settled);
            }
        };
        let (slot, mut settled) = (self.ids.entry(id), Vec::new());
        slot.waiting.push_back(number);
        slot.refuse_older_segments(received.pending.after, id, &mut settled);
        (Decoded::Segment { id }, settled)
    }

    /// Counts a packet, and settles its pending segments. Returns the numbers and classes of the frames that are
    /// settled.
    fn settle_packet(&mut self, packet: &Packet) -> Vec<(u64, Decoded)> {
        let id = packet.id;
        let (slot, mut settled) = (self.ids.entry(id), Vec::new());
        slot.refuse_older_segments(packet.words.length().segments() - 1, id, &mut settled);
        settled.extend(slot.waiting.drain(..).map(|number| (number, Decoded::Segment { id })));
        slot.traffic.count_packet();
        settled
    }
}

impl Decoder {
    /// Creates a decoder for buses of one frame format; with `None`, the format of each frame is used.
    #[must_use]
    pub const fn new(format: Option<Format>) -> Self {
        Self { format, buses: Vec::new(), seen: 0 }
    }

    /// Classifies the next frame. A classic frame may be a [`Decoded::Segment`] first and be settled later;
    /// [`settle::OrderedDecoder`] waits for that. Memory is bounded for any input. Never panics.
    pub fn decode(&mut self, at: Micros, bus: &str, frame: &Frame) -> Decoded {
        self.classify(0, at, bus, frame).1.0
    }

    /// Classifies the frame with this number. Also returns the number of its bus.
    fn classify(&mut self, number: u64, at: Micros, bus: &str, frame: &Frame) -> (u64, ClassifiedFrames) {
        if data_frame_id(frame).is_err() {
            return (0, (classify_non_data(frame), Vec::new()));
        }
        let bus = self.bus(bus);
        (bus.number, bus.classifier.classify(number, &bus.packets.read(at, frame)))
    }

    /// Returns the class of a segment whose packet will not be completed.
    fn classify_incomplete(&mut self, number: u64, bus: u64, id: Id) -> Decoded {
        let found = self.buses.iter_mut().find(|it| it.number == bus).and_then(|bus| {
            let slot = bus.classifier.ids.get_mut(id)?;
            (slot.waiting.front() == Some(&number)).then_some((slot, &mut bus.packets))
        });
        let Some((slot, packets)) = found else {
            return Decoded::Foreign(ForeignReason::Data(PacketError::Incomplete));
        };
        slot.waiting.pop_front();
        if slot.waiting.is_empty() {
            packets.drop_segments(id);
        }
        slot.classify_unreadable(id, PacketError::Incomplete)
    }

    fn bus(&mut self, name: &str) -> &mut BusDecoder {
        let at = self.buses.iter().position(|bus| bus.name == name).unwrap_or_else(|| {
            if self.buses.len() == MAX_BUSES {
                self.buses.remove(0);
            }
            self.seen += 1;
            self.buses.push(BusDecoder {
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
