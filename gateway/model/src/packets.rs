//! The packets of one bus: each frame is reassembled and decoded here, once, and handed on to all that follow the bus.
//!
//! ```text
//!   frame, time ──> PacketReader ──> Received ─┬─> table (state of the cells)
//!                     └ segments that wait     ├─> Classifier (text, JSON)
//!                                              └─> latched packets, sorted traffic
//! ```
//!
//! Cells receive by code of their own, as on a microcontroller, and `conformance` judges them by its own.

use protocol::can::{Format, Frame};
use protocol::id::{Command, Id};
use protocol::message::{Message, MessageError};
use protocol::packet::{Length, Lengths, Packet, PacketError, Reassembly, Segment, data_id};
use protocol::skin::Skin;
use protocol::time::Micros;

/// Identifiers of 11 bits.
const IDS: usize = 1 << 11;

/// The length of joints, torques and sums on a bus.
#[derive(Clone, Copy, Debug)]
enum ChainLength {
    /// Described by a skin.
    Described(Length),
    /// Taken from the newest joints; `None` before them.
    FromJoints(Option<Length>),
}

/// A frame of a bus and its meaning.
#[derive(Clone, Copy, Debug)]
pub struct Received<'f> {
    /// The frame.
    pub frame: &'f Frame,
    /// Its content.
    pub content: Content,
    /// Segments of its identifier that waited before it.
    pub waited: usize,
    /// Segments of its identifier that wait after it.
    pub waiting: usize,
}

/// The content of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Content {
    /// A remote or error frame, or a 29-bit identifier: never a packet.
    NotData,
    /// The frame is or completes a packet with a meaning.
    Message(Id, Packet, Message),
    /// The frame is or completes a packet without a meaning in this version.
    Meaningless(Id, Packet, MessageError),
    /// A segment of a packet in classic frames; others are awaited.
    Segment(Id),
    /// A segment after which the packet of the segments before it is known to be lost.
    AfterLost(Id),
    /// Not a packet and not a segment.
    Damaged(Id, PacketError),
}

impl Received<'_> {
    /// The message that the frame is or completes.
    #[must_use]
    pub const fn message(&self) -> Option<&Message> {
        if let Content::Message(_, _, message) = &self.content { Some(message) } else { None }
    }
}

/// Reassembles and decodes the frames of one bus. Memory is bounded, whatever comes.
#[derive(Clone, Debug)]
pub struct PacketReader {
    /// With `None`, each frame has its own.
    format: Option<Format>,
    length: ChainLength,
    /// By identifier, of those that came.
    segments: Vec<Option<Box<Segment>>>,
}

impl Default for PacketReader {
    fn default() -> Self {
        Self::new(None)
    }
}

impl PacketReader {
    /// Reads a bus of unknown chain; with `None` each frame is read in its own format.
    #[must_use]
    pub const fn new(format: Option<Format>) -> Self {
        Self { format, length: ChainLength::FromJoints(None), segments: Vec::new() }
    }

    /// Reads a bus of a skin: packets have its format, and torques, joints and sums its chain's length.
    #[must_use]
    pub fn of_skin(skin: &Skin, bus: usize) -> Self {
        Self {
            format: Some(skin.buses.get(bus).map_or(Format::Fd, |bus| bus.format)),
            length: ChainLength::Described(skin.length_of(bus)),
            segments: Vec::new(),
        }
    }

    /// Takes the next frame, which arrived `at`. Never panics.
    pub fn read<'f>(&mut self, at: Micros, frame: &'f Frame) -> Received<'f> {
        let Ok(id) = data_id(frame) else {
            return Received { frame, content: Content::NotData, waited: 0, waiting: 0 };
        };
        let packet = match self.format.unwrap_or_else(|| frame.format()) {
            Format::Fd => Packet::from_fd(frame),
            Format::Classic if frame.format() == Format::Fd => {
                Err(PacketError::Length { expected: 8, got: frame.data().len() })
            }
            Format::Classic => return self.read_segment(at, id, frame),
        };
        let packet = packet.and_then(|packet| self.of_described_length(id, packet));
        Received { frame, content: self.content(id, packet), waited: 0, waiting: 0 }
    }

    /// Refuses a packet that is longer or shorter than its kind is on a described bus.
    fn of_described_length(&self, id: Id, packet: Packet) -> Result<Packet, PacketError> {
        match self.length {
            ChainLength::Described(length)
                if packet.words.length() != length && Lengths::of(id) == Lengths::ALL =>
            {
                Err(PacketError::Length { expected: length.bytes(), got: packet.words.length().bytes() })
            }
            ChainLength::Described(_) | ChainLength::FromJoints(_) => Ok(packet),
        }
    }

    fn read_segment<'f>(&mut self, at: Micros, id: Id, frame: &'f Frame) -> Received<'f> {
        let lengths = match self.length {
            ChainLength::Described(length) => Lengths::only(length),
            // Joints contain their own length.
            ChainLength::FromJoints(_) if id == Id::command(Command::Joints) => Lengths::ALL,
            ChainLength::FromJoints(length) => Lengths::of_chain(length),
        };
        if self.segments.is_empty() {
            self.segments.resize(IDS, None);
        }
        let segments = self.segments.get_mut(usize::from(id.to_bits())).expect("11 bits");
        let segment = segments.get_or_insert_default();
        let waited = segment.waiting();
        let reassembly = segment.push(at, id, lengths, frame.data());
        let waiting = segment.waiting();
        let content = match reassembly {
            Ok(Reassembly::Waiting) => Content::Segment(id),
            Ok(Reassembly::Incomplete) => Content::AfterLost(id),
            Ok(Reassembly::Complete(packet)) => self.content(id, Ok(packet)),
            Ok(Reassembly::Ambiguous) => self.content(id, Err(PacketError::Ambiguous)),
            Err(error) => self.content(id, Err(error)),
        };
        Received { frame, content, waited, waiting }
    }

    fn content(&mut self, id: Id, packet: Result<Packet, PacketError>) -> Content {
        let packet = match packet {
            Ok(packet) => packet,
            Err(error) => return Content::Damaged(id, error),
        };
        match Message::decode(&packet) {
            Ok(message) => {
                if let (Message::Joints { joints, .. }, ChainLength::FromJoints(length)) =
                    (&message, &mut self.length)
                {
                    *length = Some(Length::for_joints(joints.in_use.into()));
                }
                Content::Message(id, packet, message)
            }
            Err(error) => Content::Meaningless(id, packet, error),
        }
    }

    /// Drops the segments that wait under an identifier.
    pub fn drop_segments(&mut self, id: Id) {
        if let Some(segments) = self.segments.get_mut(usize::from(id.to_bits())) {
            *segments = None;
        }
    }
}
