//! A packet that is read in the bytes in which it was received, without a copy.

use super::{Epoch, Length, Lengths, Packet, PacketError, Words, checksum, data_frame_id};
use crate::can::{Format, Frame};
use crate::id::Id;

/// A packet with a correct CRC, in the bytes in which it was received.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct PacketRef<'b> {
    id: Id,
    length: Length,
    /// The words, little endian.
    words: &'b [[u8; 2]],
    epoch: Epoch,
    count: u8,
}

impl<'b> PacketRef<'b> {
    /// Checks the bytes of a packet that was received with identifier `id`. Never panics.
    ///
    /// # Errors
    /// Returns an error if packets of this kind cannot have that length, or the CRC is wrong.
    pub fn decode(id: Id, bytes: &'b [u8]) -> Result<Self, PacketError> {
        let lengths = Lengths::for_id(id);
        let split = Length::from_byte_count(bytes.len())
            .filter(|&length| lengths.contains(length))
            .and_then(|length| Self::split(id, length, bytes));
        let Some((packet, got)) = split else {
            return Err(PacketError::Length { expected: lengths.shortest().bytes(), got: bytes.len() });
        };
        let expected = checksum(id, bytes.get(..bytes.len() - 2).unwrap_or_default());
        if expected == got { Ok(packet) } else { Err(PacketError::Crc { expected, got }) }
    }

    /// Checks the packet in an FD frame. Never panics.
    ///
    /// # Errors
    /// Returns an error if the frame is not an FD data frame with an 11-bit identifier, or does not contain a packet.
    pub fn from_fd(frame: &'b Frame) -> Result<Self, PacketError> {
        let id = data_frame_id(frame)?;
        if frame.format() != Format::Fd {
            return Err(PacketError::Length { expected: super::PACKET_BYTES, got: frame.data().len() });
        }
        Self::decode(id, frame.data())
    }

    /// Splits the bytes of a packet of this length. Also returns its CRC, which is not checked.
    pub(super) fn split(id: Id, length: Length, bytes: &'b [u8]) -> Option<(Self, u16)> {
        let [words @ .., [epoch, count], crc] = bytes.as_chunks::<2>().0 else { return None };
        let packet = Self { id, length, words, epoch: Epoch(*epoch), count: *count };
        (words.len() == length.words()).then_some((packet, u16::from_le_bytes(*crc)))
    }

    /// Returns the identifier of the packet: kind and node.
    #[must_use]
    pub const fn id(&self) -> Id {
        self.id
    }

    /// Returns the length of the packet.
    #[must_use]
    pub const fn length(&self) -> Length {
        self.length
    }

    /// Returns the words of the packet.
    pub fn words(&self) -> impl ExactSizeIterator<Item = i16> + use<'b> {
        self.words.iter().map(|word| i16::from_le_bytes(*word))
    }

    /// Returns the epoch of the joint broadcast that the packet belongs to.
    #[must_use]
    pub const fn epoch(&self) -> Epoch {
        self.epoch
    }

    /// Returns the count byte.
    #[must_use]
    pub const fn count(&self) -> u8 {
        self.count
    }

    /// Returns a copy of the packet that does not borrow the bytes.
    #[must_use]
    pub fn to_packet(&self) -> Packet {
        let words = Words::from_words(self.length, self.words());
        Packet { id: self.id, words, epoch: self.epoch, count: self.count }
    }
}
