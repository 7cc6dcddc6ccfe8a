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
pub fn padded<T: Copy + Default, const N: usize>(first: &[T]) -> [T; N] {
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
    #[error("the CRC is correct for packets of several lengths")]
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
    #[inline(always)]
    fn write_all(&self, bytes: &mut [u8]) {
        self.write_pairs(bytes.as_chunks_mut::<2>().0, 0);
        if let Some((rest, crc)) = bytes.split_last_chunk_mut::<2>() {
            *crc = checksum(self.id, rest).to_le_bytes();
        }
    }

    /// Writes the words from the one with index `first`, and epoch and count if there is room after them.
    #[inline(always)]
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
        let mut bytes = [0; MAX_BYTES - 2];
        self.write_pairs(bytes.as_chunks_mut::<2>().0, 0);
        checksum(self.id, bytes.get(..self.words.length().bytes() - 2).unwrap_or_default())
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
pub fn data_id(frame: &Frame) -> Result<Id, PacketError> {
    if frame.raw_id() & (EXTENDED | REMOTE | ERROR) != 0 {
        return Err(PacketError::Foreign);
    }
    u16::try_from(frame.id()).map(Id::from_bits).map_err(|_| PacketError::Foreign)
}

/// Returns the CRC of a packet, of its bytes before the CRC.
#[inline(always)]
fn checksum(id: Id, bytes: &[u8]) -> u16 {
    let mut digest = CRC.digest();
    digest.update(&id.to_bits().to_le_bytes());
    digest.update(bytes);
    digest.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::id::{Command, Kind};
    use crate::time::Micros;
    use proptest::prelude::*;

    const SIX: Lengths = Lengths::only(Length::Six);

    fn packet() -> impl Strategy<Value = Packet> {
        let words = (0_usize..4, any::<[i16; MAX_WORDS]>());
        (0_u16..0x800, words, any::<u8>(), any::<u8>()).prop_map(|(id, (length, words), epoch, count)| {
            let id = Id::from_bits(id);
            let length =
                Length::ALL.into_iter().filter(|&it| Lengths::for_id(id).contains(it)).cycle().nth(length);
            Packet { id, words: Words::new(length.unwrap(), words), epoch: Epoch(epoch), count }
        })
    }

    #[test]
    fn the_crc_is_ccitt_false() {
        assert_eq!(crc16(b"123456789"), 0x29B1, "the check value of the catalogue");
    }

    #[test]
    fn epochs_are_compared_around_the_corner() {
        assert_eq!(Epoch(2).epochs_since(Epoch(254)), 4);
        assert_eq!(Epoch(254).epochs_since(Epoch(2)), -4);
        assert_eq!(Epoch(255).next(), Epoch(0));
    }

    #[test]
    fn a_lost_half_costs_one_packet() {
        let id = Id::command(Command::Joints);
        let make = |epoch| Packet { id, words: [7; WORDS].into(), epoch: Epoch(epoch), count: 6 };
        let segments = |epoch| make(epoch).frames(Format::Classic).collect::<Vec<_>>();
        let mut segment = Reassembler::NONE;
        let mut push = |at, frame: &Frame| segment.push(Micros(at), id, SIX, frame.data()).unwrap();
        assert_eq!(push(0, &segments(1)[0]), Reassembly::Waiting);
        // The second segment of epoch 1 is lost.
        assert_eq!(push(1_000, &segments(2)[0]), Reassembly::Incomplete);
        assert_eq!(push(1_100, &segments(2)[1]), Reassembly::Complete(make(2)));
        assert_eq!(push(9_000, &segments(3)[0]), Reassembly::Waiting);
        assert_eq!(push(24_001, &segments(3)[1]), Reassembly::Incomplete, "more than 15 ms apart");
    }

    #[test]
    fn what_is_said_once_may_take_longer() {
        let cell = |kind| Id { kind, node: 12 };
        let periodic = [Id::command(Command::Joints), cell(Kind::Sum), cell(Kind::Torque)];
        let once =
            [Id::command(Command::Halt), cell(Kind::Network), cell(Kind::Configure), cell(Kind::Stimulus)];
        let longest = periodic.map(|id| (id, 15_000)).into_iter().chain(once.map(|id| (id, 100_000)));
        for (id, longest) in longest {
            let packet = Packet { id, words: [7; WORDS].into(), epoch: Epoch(1), count: 1 };
            let came = [longest, longest + 1].map(|apart| {
                let mut segment = Reassembler::NONE;
                let segments = packet.frames(Format::Classic).zip([0, apart]);
                segments
                    .map(|(frame, at)| segment.push(Micros(at), id, SIX, frame.data()).unwrap())
                    .last()
                    .unwrap()
            });
            assert_eq!(came, [Reassembly::Complete(packet), Reassembly::Incomplete], "{id:?}");
        }
    }

    #[test]
    fn a_packet_both_of_whose_segments_came_is_counted_once() {
        let id = Id::command(Command::Joints);
        let make = |epoch| Packet { id, words: [7; WORDS].into(), epoch: Epoch(epoch), count: 6 };
        let segments = |epoch| make(epoch).frames(Format::Classic).collect::<Vec<_>>();
        let damaged = Frame::classic(segments(2)[0].raw_id(), &[9; 8]).unwrap();
        for (first, apart) in [(segments(2)[0], 15_001), (damaged, 100)] {
            let mut segment = Reassembler::NONE;
            let mut push = |at, frame: &Frame| segment.push(Micros(at), id, SIX, frame.data()).unwrap();
            assert_eq!(push(0, &first), Reassembly::Waiting);
            assert_eq!(push(apart, &segments(2)[1]), Reassembly::Incomplete);
            assert_eq!(push(50_000, &segments(3)[0]), Reassembly::Waiting, "that packet is counted");
            assert_eq!(push(50_100, &segments(3)[1]), Reassembly::Complete(make(3)));
            // Segments of two packets, each of which lost its other segment, count as two losses.
            assert_eq!(push(90_000, &segments(4)[0]), Reassembly::Waiting);
            assert_eq!(push(110_000, &segments(5)[0]), Reassembly::Incomplete);
            assert_eq!(push(130_000, &segments(6)[0]), Reassembly::Incomplete);
        }
    }

    #[test]
    fn frames_of_other_kinds_are_foreign() {
        let extended = Frame::fd(0x123 | EXTENDED, 0, &[0; 16]).unwrap();
        assert_eq!(Packet::from_fd(&extended), Err(PacketError::Foreign));
        assert_eq!(data_id(&Frame::remote(0x123, 8).unwrap()), Err(PacketError::Foreign));
        let error = Frame::classic(ERROR | 4, &[0; 8]).unwrap();
        assert_eq!(data_id(&error), Err(PacketError::Foreign));
        let short = Frame::fd(0x123, 0, &[0; 12]).unwrap();
        assert_eq!(Packet::from_fd(&short), Err(PacketError::Length { expected: 16, got: 12 }));
    }

    /// Returns the reassembly result of each frame. Each frame is received `apart` µs after the previous one, and
    /// packets have one of `lengths`.
    fn pushed(id: Id, lengths: Lengths, apart: u64, frames: &[Frame]) -> Vec<Reassembly> {
        let mut segment = Reassembler::NONE;
        let times = (0..).map(|index| Micros(index * apart));
        times.zip(frames).map(|(at, frame)| segment.push(at, id, lengths, frame.data()).unwrap()).collect()
    }

    fn long(epoch: u8, length: Length) -> Packet {
        let id = Id::command(Command::Joints);
        Packet { id, words: Words::new(length, [300; MAX_WORDS]), epoch: Epoch(epoch), count: 7 }
    }

    fn segments(packets: &[Packet]) -> Vec<Frame> {
        packets.iter().flat_map(|packet| packet.frames(Format::Classic)).collect()
    }

    #[test]
    fn a_lost_segment_costs_one_packet_of_any_length_whether_it_is_known_or_not() {
        for length in Length::ALL {
            let n = length.segments();
            let packets = [1, 2, 3].map(|epoch| long(epoch, length));
            for lost in 0..n {
                let mut frames = segments(&packets);
                frames.remove(n + lost);
                for lengths in [Lengths::only(length), Lengths::ALL] {
                    let outcomes = pushed(packets[0].id, lengths, 100, &frames);
                    let whole: Vec<_> =
                        outcomes.iter().filter(|it| matches!(it, Reassembly::Complete(_))).collect();
                    let expected = [packets[0], packets[2]].map(Reassembly::Complete);
                    assert_eq!(whole, expected.iter().collect::<Vec<_>>(), "{length:?} {lost} {lengths:?}");
                    let lost = outcomes.iter().filter(|it| **it == Reassembly::Incomplete).count();
                    // Without a known length, the loss is noticed only with the next packet.
                    assert!(lost == 1 || lengths == Lengths::ALL && lost == 0, "{length:?} {outcomes:?}");
                }
            }
        }
    }

    #[test]
    fn a_loss_is_counted_once_where_the_length_is_not_known() {
        let packets = [1, 2, 3].map(|epoch| long(epoch, Length::Ten));
        let mut frames = segments(&packets);
        frames.remove(1);
        let outcomes = pushed(packets[0].id, Lengths::ALL, 100, &frames);
        assert_eq!(outcomes.iter().filter(|it| **it == Reassembly::Incomplete).count(), 1, "{outcomes:?}");
    }

    #[test]
    fn segments_of_a_long_packet_come_within_15_ms() {
        let packets = [long(1, Length::Fourteen)];
        let last = |apart| *pushed(packets[0].id, Lengths::ALL, apart, &segments(&packets)).last().unwrap();
        assert_eq!(last(5_000), Reassembly::Complete(packets[0]));
        assert_ne!(last(5_001), Reassembly::Complete(packets[0]));
    }

    #[test]
    fn packets_of_two_lengths_that_end_together_are_ambiguous() {
        // Finds a packet of fourteen words whose last two segments also form a packet of six words.
        let id = Id::command(Command::Joints);
        let found = (0..=u16::MAX).find_map(|word| {
            let mut words = [0; MAX_WORDS];
            words[0] = word.cast_signed();
            let packet =
                Packet { id, words: Words::new(Length::Fourteen, words), epoch: Epoch(9), count: 14 };
            Packet::decode(id, packet.encode().get(16..)?).ok().map(|_| packet)
        });
        let found = found.expect("one of 65 536 words has that CRC");
        let outcomes = pushed(id, Lengths::ALL, 100, &segments(&[found]));
        assert_eq!(outcomes.last(), Some(&Reassembly::Ambiguous));
        let outcomes = pushed(id, Lengths::only(Length::Fourteen), 100, &segments(&[found]));
        assert_eq!(outcomes.last(), Some(&Reassembly::Complete(found)));
    }

    proptest! {
        #[test]
        fn a_packet_comes_back_from_either_format(packet in packet()) {
            let fd: Vec<_> = packet.frames(Format::Fd).collect();
            prop_assert_eq!(fd.len(), 1);
            prop_assert_eq!(Packet::from_fd(&fd[0]), Ok(packet));
            let mut segment = Reassembler::NONE;
            let mut last = Reassembly::Waiting;
            for frame in packet.frames(Format::Classic) {
                last = segment.push(Micros(0), packet.id, Lengths::only(packet.words.length()), frame.data()).unwrap();
            }
            prop_assert_eq!(last, Reassembly::Complete(packet));
        }

        #[test]
        fn a_packet_under_another_identifier_is_refused(packet in packet(), other in 0_u16..0x800) {
            prop_assume!(other != packet.id.to_bits());
            prop_assert!(Packet::decode(Id::from_bits(other), &packet.encode()).is_err());
        }

        #[test]
        fn one_to_three_wrong_bits_are_always_noticed(packet in packet(), bits in proptest::collection::vec(any::<prop::sample::Index>(), 1..=3)) {
            let mut bytes = packet.encode();
            let bits: std::collections::BTreeSet<_> = bits.iter().map(|bit| bit.index(8 * bytes.len())).collect();
            for bit in bits {
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
            prop_assert!(Packet::decode(packet.id, &bytes).is_err());
        }

        #[test]
        fn no_bytes_panic(kind in 0_u16..0x800, bytes in proptest::collection::vec(any::<u8>(), 0..70)) {
            let _ = Packet::decode(Id::from_bits(kind), &bytes);
            let _ = Reassembler::default().push(Micros(0), Id { kind: Kind::Sum, node: 0 }, Lengths::ALL, &bytes);
        }
    }
}
