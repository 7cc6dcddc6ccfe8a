//! The packets of one bus. Each frame is reassembled and decoded here once, for all consumers of the bus.
//!
//! ```text
//!   frame, time ──> PacketReader ──> FrameWithPacket ─┬─> table (state of the cells)
//!                     └ pending segments              ├─> Classifier (text, JSON)
//!                                                     └─> latched packets, sorted traffic
//! ```
//!
//! Cells have their own receiver, which fits a microcontroller, and `conformance` has another one to test them
//! independently.

use crate::can::{Format, Frame};
use crate::id::{Command, Id};
use crate::message::{Message, MessageError};
use crate::packet::{
    Length, Lengths, Packet, PacketError, PacketRef, Reassembler, Reassembly, data_frame_id,
};
use crate::skin::Skin;
use crate::time::Micros;

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

/// A frame of a bus, with the packet that it is or completes.
#[derive(Clone, Copy, Debug)]
pub struct FrameWithPacket<'f> {
    /// The frame.
    pub frame: &'f Frame,
    /// The packet, with its message unless this version cannot decode it.
    pub packet: Result<(Packet, Result<Message, MessageError>), NoPacketReason>,
    /// Pending segments with the identifier of the frame.
    pub pending: PendingSegments,
}

/// The reason why a frame neither is nor completes a packet.
#[derive(Clone, Copy, Debug)]
pub enum NoPacketReason {
    /// A remote or error frame, or a 29-bit identifier: not a packet of this protocol.
    NotData,
    /// A segment of a packet in classic frames; the packet needs more segments.
    Segment(Id),
    /// A segment that does not continue the pending ones, or that arrived after their timeout: the pending packet is
    /// lost.
    AfterLost(Id),
    /// Neither a packet nor a segment.
    Damaged(Id, PacketError),
}

/// Number of pending segments of an identifier.
#[derive(Clone, Copy, Debug, Default)]
pub struct PendingSegments {
    /// Segments that were pending before a frame.
    pub before: usize,
    /// Segments that are pending after it.
    pub after: usize,
}

impl FrameWithPacket<'_> {
    /// Returns the message that the frame is or completes.
    #[must_use]
    pub const fn message(&self) -> Option<&Message> {
        if let Ok((_, Ok(message))) = &self.packet { Some(message) } else { None }
    }
}

/// A value for each identifier of 11 bits, allocated on first use: a bus uses few of them.
#[derive(Clone, Debug)]
pub struct ByIdentifier<T>(pub Vec<Option<Box<T>>>);

impl<T> Default for ByIdentifier<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Clone + Default> ByIdentifier<T> {
    /// Returns the value of an identifier, by default a new one.
    #[expect(clippy::missing_panics_doc, reason = "the list has that length")]
    pub fn entry(&mut self, id: Id) -> &mut T {
        if self.0.is_empty() {
            self.0.resize(IDENTIFIER_COUNT, None);
        }
        self.0.get_mut(usize::from(id.to_bits())).expect("an identifier has 11 bits").get_or_insert_default()
    }

    /// Returns the value of an identifier that was used.
    pub fn get_mut(&mut self, id: Id) -> Option<&mut T> {
        self.0.get_mut(usize::from(id.to_bits()))?.as_deref_mut()
    }
}

/// Reassembles and decodes the frames of one bus. Memory is bounded for any input.
#[derive(Clone, Debug)]
pub struct PacketReader {
    /// Format of all frames; with `None`, the format of each frame is used.
    format: Option<Format>,
    length: ChainLength,
    segments: ByIdentifier<Reassembler>,
}

impl Default for PacketReader {
    fn default() -> Self {
        Self::new(None)
    }
}

impl PacketReader {
    /// Creates a reader for a bus with an unknown chain; with `None`, the format of each frame is used.
    #[must_use]
    pub fn new(format: Option<Format>) -> Self {
        Self { format, length: ChainLength::FromJoints(None), segments: ByIdentifier::default() }
    }

    /// Creates a reader for a bus of a skin: packets have the format of the bus, and torques, joints and sums have the
    /// length of its chain.
    #[must_use]
    pub fn for_bus(skin: &Skin, bus: usize) -> Self {
        Self {
            format: Some(skin.buses.get(bus).map_or(Format::Fd, |bus| bus.format)),
            length: ChainLength::Described(skin.packet_length(bus)),
            segments: ByIdentifier::default(),
        }
    }

    /// Reads the next frame, which arrived `at`. Never panics.
    pub fn read<'f>(&mut self, at: Micros, frame: &'f Frame) -> FrameWithPacket<'f> {
        let (packet, pending) = self.read_packet(at, frame);
        let packet = packet.map(|packet| (packet, self.decode(&packet)));
        FrameWithPacket { frame, packet, pending }
    }

    /// Does the first half of [`read`](Self::read): returns the packet that the frame is or completes, for
    /// [`decode`](Self::decode).
    ///
    /// # Errors
    /// Returns the reason if the frame neither is nor completes a packet.
    // Inlined, as `reassemble`: the receiver of a bus calls them for every frame, and copies each packet once less.
    #[inline(always)]
    pub fn read_packet(
        &mut self,
        at: Micros,
        frame: &Frame,
    ) -> (Result<Packet, NoPacketReason>, PendingSegments) {
        let Ok(id) = data_frame_id(frame) else {
            return (Err(NoPacketReason::NotData), PendingSegments::default());
        };
        let error = match self.format.unwrap_or_else(|| frame.format()) {
            Format::Fd => match PacketRef::from_fd(frame).and_then(|packet| self.check_length(packet)) {
                Ok(packet) => return (Ok(packet.to_packet()), PendingSegments::default()),
                Err(error) => error,
            },
            Format::Classic if frame.format() == Format::Fd => {
                PacketError::Length { expected: 8, got: frame.data().len() }
            }
            Format::Classic => return self.reassemble(at, id, frame),
        };
        (Err(NoPacketReason::Damaged(id, error)), PendingSegments::default())
    }

    /// Does the second half of [`read`](Self::read): decodes a packet.
    ///
    /// # Errors
    /// Returns [`MessageError`] if this version cannot decode the packet.
    #[inline]
    pub fn decode(&mut self, packet: &Packet) -> Result<Message, MessageError> {
        let message = Message::decode(packet);
        if let (Ok(Message::Joints { joints, .. }), ChainLength::FromJoints(length)) =
            (&message, &mut self.length)
        {
            *length = Some(Length::for_joints(joints.in_use.into()));
        }
        message
    }

    /// Checks that the length of a packet fits the described chain.
    fn check_length<'b>(&self, packet: PacketRef<'b>) -> Result<PacketRef<'b>, PacketError> {
        match self.length {
            ChainLength::Described(length)
                if packet.length() != length && Lengths::for_id(packet.id()) == Lengths::ALL =>
            {
                Err(PacketError::Length { expected: length.bytes(), got: packet.length().bytes() })
            }
            ChainLength::Described(_) | ChainLength::FromJoints(_) => Ok(packet),
        }
    }

    #[inline(always)]
    fn reassemble(
        &mut self,
        at: Micros,
        id: Id,
        frame: &Frame,
    ) -> (Result<Packet, NoPacketReason>, PendingSegments) {
        let lengths = match self.length {
            ChainLength::Described(length) => Lengths::only(length),
            // Joints packets contain their own length.
            ChainLength::FromJoints(_) if id == Id::command(Command::Joints) => Lengths::ALL,
            ChainLength::FromJoints(length) => Lengths::from_chain_length(length),
        };
        let segments = self.segments.entry(id);
        let before = segments.waiting_segment_count();
        let packet = match segments.push_borrowed(at, id, lengths, frame.data()) {
            Ok(Reassembly::Complete(packet)) => Ok(packet.to_packet()),
            Ok(Reassembly::Waiting) => Err(NoPacketReason::Segment(id)),
            Ok(Reassembly::Incomplete) => Err(NoPacketReason::AfterLost(id)),
            Ok(Reassembly::Ambiguous) => Err(NoPacketReason::Damaged(id, PacketError::Ambiguous)),
            Err(error) => Err(NoPacketReason::Damaged(id, error)),
        };
        (packet, PendingSegments { before, after: segments.waiting_segment_count() })
    }

    /// Drops the pending segments with this identifier.
    pub fn drop_segments(&mut self, id: Id) {
        if let Some(segments) = self.segments.get_mut(id) {
            *segments = Reassembler::NONE;
        }
    }
}
