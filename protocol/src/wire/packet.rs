//! Packets: words, an epoch, a count and a CRC, in one CAN FD frame or in several classic frames of 8 bytes.
//!
//! ```text
//!   byte   0   1   2   3   4   5   6   7   8   9  10  11    12     13     14  15
//!        +---+---+---+---+---+---+---+---+---+---+---+---+-------+-------+---+---+
//!        | word0 | word1 | word2 | word3 | word4 | word5 | epoch | count |  CRC  |
//!        +---+---+---+---+---+---+---+---+---+---+---+---+-------+-------+---+---+
//!          six i16, little endian                                          little endian
//!          '---- first classic frame ----' '---- second classic frame -----------'
//! ```
//!
//! Joints, torques and sums of a chain with more than six joints have more words; epoch, count and CRC follow
//! the last word:
//!
//! | joints of the chain | words | bytes | classic frames |
//! |---|---|---|---|
//! | 1 to 6 | 6 | 16 | 8 + 8 |
//! | 7, 8 | 8 | 20 | 8 + 8 + 4 |
//! | 9, 10 | 10 | 24 | 8 + 8 + 8 |
//! | 11 to 14 | 14 | 32 | 8 + 8 + 8 + 8 |
//!
//! The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, initial value 0xFFFF, not reflected, no final XOR) over
//! the identifier as two bytes, little endian, and all bytes before the CRC. It includes the identifier so
//! that a packet with another cell's identifier is refused.

mod borrowed;
mod length;
mod reassembly;

pub use borrowed::PacketRef;
pub use length::{Length, Lengths, Words};
pub use reassembly::{Reassembler, Reassembly};

use thiserror::Error;

use crate::can::{self, ERROR, EXTENDED, Format, Frame, REMOTE};
use crate::id::Id;

/// CRC-16/CCITT-FALSE, also known as CRC-16/IBM-3740.
const CRC: crc::Crc<u16> = crc::Crc::<u16>::new(&crc::CRC_16_IBM_3740);

/// Number of words in a packet, except in joints, torques and sums of chains with more than six joints.
pub const WORDS: usize = 6;
/// Number of words in the longest packet.
pub const MAX_WORDS: usize = 14;
/// Size of a packet with [`WORDS`] words, in bytes.
pub const PACKET_BYTES: usize = Length::Six.bytes();
/// Size of the longest packet in bytes.
const MAX_BYTES: usize = Length::Fourteen.bytes();
/// Size of each classic frame of a packet except the last, in bytes.
const SEGMENT_BYTES: usize = 8;

/// An encoded packet.
pub type Bytes = heapless::Vec<u8, MAX_BYTES>;

/// Returns the CRC of this protocol over `bytes`.
#[must_use]
pub fn crc16(bytes: &[u8]) -> u16 {
    CRC.checksum(bytes)
}

/// Like [`crc16`], for bytes in several pieces.
pub(crate) fn crc16_of_parts<const N: usize>(parts: impl Iterator<Item = [u8; N]>) -> u16 {
    let mut digest = CRC.digest();
    parts.for_each(|part| digest.update(&part));
    digest.finalize()
}

/// Returns the words of a packet: `first`, padded with zeros.
#[must_use]
pub fn padded_words<const N: usize>(first: [i16; N]) -> [i16; WORDS] {
    const { assert!(N <= WORDS, "a packet has no more words") }
    let mut words = [0; WORDS];
    for (word, first) in words.iter_mut().zip(first) {
        *word = first;
    }
    words
}

/// Returns an array that begins with `first`, padded with default values. Elements beyond `N` are dropped.
#[must_use]
pub fn pad_with_defaults<T: Copy + Default, const N: usize>(first: &[T]) -> [T; N] {
    core::array::from_fn(|index| first.get(index).copied().unwrap_or_default())
}

/// An epoch: the number of a joint broadcast, modulo 256.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub struct Epoch(pub u8);

impl Epoch {
    /// Returns the next epoch.
    #[must_use]
    pub const fn next(self) -> Self {
        self.advanced_by(1)
    }

    /// Returns the previous epoch.
    #[must_use]
    pub const fn previous(self) -> Self {
        Self(self.0.wrapping_sub(1))
    }

    /// Returns the epoch that begins `steps` broadcasts later.
    #[must_use]
    pub const fn advanced_by(self, steps: u8) -> Self {
        Self(self.0.wrapping_add(steps))
    }

    /// Returns the number of epochs since `earlier`, modulo 256, in the range -128 to 127.
    #[must_use]
    pub const fn epochs_since(self, earlier: Self) -> i8 {
        self.0.wrapping_sub(earlier.0).cast_signed()
    }
}

impl core::fmt::Display for Epoch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.0.fmt(f)
    }
}

/// A packet with a correct CRC. [`crate::message`] defines the meaning of its words.
// Aligned to words; otherwise a Cortex-M0 copies it byte by byte.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
#[repr(align(4))]
pub struct Packet {
    /// The identifier of the packet: kind and node.
    pub id: Id,
    /// The words of the packet.
    pub words: Words,
    /// The epoch of the joint broadcast that the packet belongs to.
    pub epoch: Epoch,
    /// The count byte: in a sum the number of contributing cells, in other kinds as defined in [`crate::message`].
    pub count: u8,
}

/// The error for a frame that does not contain a packet.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
pub enum PacketError {
    /// The frame has a 29-bit identifier, or is a remote or error frame.
    #[error("not a data frame with an 11-bit identifier")]
    Foreign,
    /// The frame has another length than packets of its kind.
    #[error("{got} data bytes, not {expected}")]
    Length {
        /// The expected number of bytes.
        expected: usize,
        /// The received number of bytes.
        got: usize,
    },
    /// The CRC is wrong.
    #[error("CRC {got:04X}, not {expected:04X}")]
    Crc {
        /// The CRC of the received bytes.
        expected: u16,
        /// The CRC in the packet.
        got: u16,
    },
    /// A classic frame does not form a packet with the segments before and after it.
    #[error("the other segments are missing")]
    Incomplete,
    /// Classic frames decode as packets of several lengths, although at most one of these was sent.
    #[error("the length of the packet is ambiguous: the CRC is correct for several lengths")]
    Ambiguous,
}

impl PacketError {
    /// Returns the name of the error in one word.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Foreign => "foreign",
            Self::Length { .. } => "length",
            Self::Crc { .. } => "CRC",
            Self::Incomplete => "incomplete",
            Self::Ambiguous => "ambiguous",
        }
    }
}

impl Packet {
    /// Returns the bytes to which the fields of [`crate::schema`] refer: the first six words, epoch and count as in a
    /// packet of six words, then the other words.
    #[must_use]
    pub fn field_bytes(&self) -> Bytes {
        let (first, rest) = self.words.as_slice().split_at(WORDS);
        let bytes = |words: &'_ [i16]| words.iter().flat_map(|word| word.to_le_bytes()).collect::<Bytes>();
        let end = [self.epoch.0, self.count];
        bytes(first).into_iter().chain(end).chain(bytes(rest)).collect()
    }

    /// Encodes the packet to bytes.
    #[must_use]
    pub fn encode(&self) -> Bytes {
        let mut bytes = Bytes::new();
        let _ = bytes.resize(self.words.length().bytes(), 0);
        self.write_all(&mut bytes);
        bytes
    }

    /// Decodes the bytes of a packet that was received with identifier `id`. Never panics.
    ///
    /// # Errors
    /// Returns an error if packets of this kind cannot have that length, or the CRC is wrong.
    pub fn decode(id: Id, bytes: &[u8]) -> Result<Self, PacketError> {
        PacketRef::decode(id, bytes).map(|packet| packet.to_packet())
    }

    /// Encodes the packet to `bytes`, which has its size.
    fn write_all(&self, bytes: &mut [u8]) {
        self.write_pairs(bytes.as_chunks_mut::<2>().0, 0);
        if let Some((rest, crc)) = bytes.split_last_chunk_mut::<2>() {
            *crc = checksum(self.id, rest).to_le_bytes();
        }
    }

    /// Writes the words from the one with index `first`, and epoch and count if there is room after them.
    fn write_pairs(&self, pairs: &mut [[u8; 2]], first: usize) {
        let words = self.words.as_slice().get(first..).unwrap_or_default();
        for (pair, word) in pairs.iter_mut().zip(words) {
            // Else this is a call of memcpy, which takes a Cortex-M0 longer than the loop.
            core::hint::black_box(());
            *pair = word.to_le_bytes();
        }
        if let Some(pair) = pairs.get_mut(words.len()) {
            *pair = [self.epoch.0, self.count];
        }
    }

    /// Returns the number of frames that carry this packet: 1 FD frame, or 2 to 4 classic frames.
    #[must_use]
    pub const fn frame_count(&self, format: Format) -> usize {
        match format {
            Format::Fd => 1,
            Format::Classic => self.words.length().segments(),
        }
    }

    /// Makes `frame` the frame with this number of those that carry the packet, from 0 to
    /// [`frame_count`](Self::frame_count) - 1: an FD frame with bit rate switch, or a classic frame of 8 bytes, the
    /// last of which may be shorter.
    pub fn write_frame(&self, number: usize, format: Format, frame: &mut Frame) {
        let (id, size) = (self.id.to_bits().into(), self.words.length().bytes());
        match format {
            Format::Fd => {
                let flags = can::BIT_RATE_SWITCH | can::FD_FORMAT;
                self.write_all(frame.rewrite(id, format, flags, size));
            }
            Format::Classic => {
                let first = number * SEGMENT_BYTES;
                let data = frame.rewrite(id, format, 0, size.saturating_sub(first).min(SEGMENT_BYTES));
                self.write_pairs(data.as_chunks_mut::<2>().0, first / 2);
                if let (true, Some(crc)) = (first + data.len() == size, data.last_chunk_mut::<2>()) {
                    *crc = self.checksum().to_le_bytes();
                }
            }
        }
    }

    /// Returns the CRC, for a packet whose bytes are in several frames.
    fn checksum(&self) -> u16 {
        let mut digest = CRC.digest();
        digest.update(&self.id.to_bits().to_le_bytes());
        for word in self.words.as_slice() {
            digest.update(&word.to_le_bytes());
        }
        digest.update(&[self.epoch.0, self.count]);
        digest.finalize()
    }

    /// Returns the frames that carry this packet, as [`write_frame`](Self::write_frame) writes them.
    pub fn frames(&self, format: Format) -> impl Iterator<Item = Frame> + use<> {
        let (packet, mut frame) = (*self, Frame::EMPTY);
        (0..self.frame_count(format)).map(move |number| {
            packet.write_frame(number, format, &mut frame);
            frame
        })
    }

    /// Decodes the packet in an FD frame. Never panics.
    ///
    /// # Errors
    /// Returns an error if the frame is not an FD data frame with an 11-bit identifier, or does not contain a packet.
    pub fn from_fd(frame: &Frame) -> Result<Self, PacketError> {
        PacketRef::from_fd(frame).map(|packet| packet.to_packet())
    }
}

/// Returns the identifier of a data frame with an 11-bit identifier, which may contain a packet.
///
/// # Errors
/// Returns an error if the frame is a remote or error frame, or has a 29-bit identifier.
pub fn data_frame_id(frame: &Frame) -> Result<Id, PacketError> {
    if frame.raw_id() & (EXTENDED | REMOTE | ERROR) != 0 {
        return Err(PacketError::Foreign);
    }
    u16::try_from(frame.id()).map(Id::from_bits).map_err(|_| PacketError::Foreign)
}

/// Returns the CRC of a packet, of its bytes before the CRC.
fn checksum(id: Id, bytes: &[u8]) -> u16 {
    let mut digest = CRC.digest();
    digest.update(&id.to_bits().to_le_bytes());
    digest.update(bytes);
    digest.finalize()
}

#[cfg(test)]
mod tests;
