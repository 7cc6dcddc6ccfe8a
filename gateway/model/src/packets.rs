//! The packets of one bus. Each frame is reassembled and decoded here once, for all consumers of the bus.
//!
//! ```text
//!   frame, time ──> PacketReader ──> Received ─┬─> table (state of the cells)
//!                     └ pending segments       ├─> Classifier (text, JSON)
//!                                              └─> latched packets, sorted traffic
//! ```
//!
//! Cells have their own receiver, which fits a microcontroller, and `conformance` has another one to test them
//! independently.

use protocol::can::{Format, Frame};
use protocol::id::{Command, Id};
use protocol::message::{Message, MessageError};
use protocol::packet::{Length, Lengths, Packet, PacketError, Reassembler, Reassembly, data_id};
use protocol::skin::Skin;
use protocol::time::Micros;

/// The number of identifiers of 11 bits.
const IDENTIFIER_COUNT: usize = 1 << 11;

/// The number of joints in the packets of a bus that contain joints, torques or sums.
#[derive(Clone, Copy, Debug)]
enum ChainLength {
    /// The number is given by a skin.
    Described(Length),
    /// The number is that of the newest joints packet; `None` before the first.
    FromJoints(Option<Length>),
}

/// A frame of a bus with its reassembled and decoded content.
#[derive(Clone, Copy, Debug)]
pub struct Received<'f> {
    /// The frame.
    pub frame: &'f Frame,
    /// Content of the frame.
    pub content: Content,
    /// Number of segments with the same identifier that were pending before this frame.
    pub waited: usize,
    /// Number of segments with the same identifier that are pending after this frame.
    pub waiting: usize,
}

/// The content of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Content {
    /// A remote or error frame, or a 29-bit identifier: not a packet of this protocol.
    NotData,
    /// The frame is or completes a packet that decodes to a message.
    Message(Id, Packet, Message),
    /// The frame is or completes a packet that this version cannot decode.
    Meaningless(Id, Packet, MessageError),
    /// A segment of a packet in classic frames; the packet needs more segments.
    Segment(Id),
    /// A segment that does not continue the pending ones, or that arrived after their timeout: the pending packet is
    /// lost.
    AfterLost(Id),
    /// Neither a packet nor a segment.
    Damaged(Id, PacketError),
}

impl Received<'_> {
    /// Returns the message that the frame is or completes.
    #[must_use]
    pub const fn message(&self) -> Option<&Message> {
        if let Content::Message(_, _, message) = &self.content { Some(message) } else { None }
    }
}

/// Reassembles and decodes the frames of one bus. Memory is bounded for any input.
#[derive(Clone, Debug)]
pub struct PacketReader {
    /// Format of all frames; with `None`, the format of each frame is used.
    format: Option<Format>,
    length: ChainLength,
    /// Reassembly state of each identifier.
    segments: Vec<Option<Box<Reassembler>>>,
}

impl Default for PacketReader {
    fn default() -> Self {
        Self::new(None)
    }
}

impl PacketReader {
    /// Creates a reader for a bus with an unknown chain; with `None`, the format of each frame is used.
    #[must_use]
    pub const fn new(format: Option<Format>) -> Self {
        Self { format, length: ChainLength::FromJoints(None), segments: Vec::new() }
    }

    /// Creates a reader for a bus of a skin: packets have the format of the bus, and torques, joints and sums have the
    /// length of its chain.
    #[must_use]
    pub fn of_skin(skin: &Skin, bus: usize) -> Self {
        Self {
            format: Some(skin.buses.get(bus).map_or(Format::Fd, |bus| bus.format)),
            length: ChainLength::Described(skin.packet_length(bus)),
            segments: Vec::new(),
        }
    }

    /// Reads the next frame, which arrived `at`. Never panics.
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

    /// Checks that the length of a packet fits the described chain.
    fn of_described_length(&self, id: Id, packet: Packet) -> Result<Packet, PacketError> {
        match self.length {
            ChainLength::Described(length)
                if packet.words.length() != length && Lengths::for_id(id) == Lengths::ALL =>
            {
                Err(PacketError::Length { expected: length.bytes(), got: packet.words.length().bytes() })
            }
            ChainLength::Described(_) | ChainLength::FromJoints(_) => Ok(packet),
        }
    }

    fn read_segment<'f>(&mut self, at: Micros, id: Id, frame: &'f Frame) -> Received<'f> {
        let lengths = match self.length {
            ChainLength::Described(length) => Lengths::only(length),
            // Joints packets contain their own length.
            ChainLength::FromJoints(_) if id == Id::command(Command::Joints) => Lengths::ALL,
            ChainLength::FromJoints(length) => Lengths::for_chain(length),
        };
        if self.segments.is_empty() {
            self.segments.resize(IDENTIFIER_COUNT, None);
        }
        let segments = self.segments.get_mut(usize::from(id.to_bits())).expect("an identifier has 11 bits");
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

    /// Drops the pending segments with this identifier.
    pub fn drop_segments(&mut self, id: Id) {
        if let Some(segments) = self.segments.get_mut(usize::from(id.to_bits())) {
            *segments = None;
        }
    }
}
