//! The packet: sixteen bytes in one CAN FD frame, or in two classic frames.
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
//! The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, initial value 0xFFFF, nothing reflected, no final
//! XOR) over the identifier as two bytes, little endian, and bytes 0 to 13. The identifier is in it so
//! that a packet which arrives under another cell's name is refused.

use thiserror::Error;

use crate::can::{self, Format, Frame};
use crate::id::{Command, Id, Kind};
use crate::time::{Micros, Span};

/// CRC-16/CCITT-FALSE, which the catalogue of CRCs calls IBM-3740.
const CRC: crc::Crc<u16> = crc::Crc::<u16>::new(&crc::CRC_16_IBM_3740);

/// Words in a packet; joints that a robot can have.
pub const WORDS: usize = 6;
/// Bytes in a packet.
pub const BYTES: usize = 2 * WORDS + 4;
/// Bytes in each of its two classic frames.
const SEGMENT_BYTES: usize = BYTES / 2;

/// The CRC of this protocol over some bytes.
#[must_use]
pub fn crc16(bytes: &[u8]) -> u16 {
    CRC.checksum(bytes)
}

/// The words that begin so; the others are 0.
#[must_use]
pub fn words<const N: usize>(first: [i16; N]) -> [i16; WORDS] {
    const { assert!(N <= WORDS, "a packet has no more words") }
    let mut words = [0; WORDS];
    for (word, first) in words.iter_mut().zip(first) {
        *word = first;
    }
    words
}

/// The number of a joint broadcast, modulo 256.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub struct Epoch(pub u8);

impl Epoch {
    /// The epoch after this one.
    #[must_use]
    pub const fn next(self) -> Self {
        self.plus(1)
    }

    /// The epoch before this one.
    #[must_use]
    pub const fn before(self) -> Self {
        Self(self.0.wrapping_sub(1))
    }

    /// The epoch `steps` later.
    #[must_use]
    pub const fn plus(self, steps: u8) -> Self {
        Self(self.0.wrapping_add(steps))
    }

    /// How many epochs this one comes after `earlier`, in [-128, 127].
    #[must_use]
    pub const fn since(self, earlier: Self) -> i8 {
        self.0.wrapping_sub(earlier.0).cast_signed()
    }
}

impl core::fmt::Display for Epoch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.0.fmt(f)
    }
}

/// A packet whose CRC was right; what its words mean is [`crate::message`]'s business.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct Packet {
    /// Kind and node.
    pub id: Id,
    /// Six words of 16 bits.
    pub words: [i16; WORDS],
    /// The joint broadcast it belongs to.
    pub epoch: Epoch,
    /// Cells whose torque is in the words, or as the kind defines it.
    pub count: u8,
}

/// Why a frame is not a packet.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
pub enum PacketError {
    /// A 29-bit identifier, a remote frame or an error frame.
    #[error("not a data frame with an 11-bit identifier")]
    Foreign,
    /// Wrong length.
    #[error("{got} data bytes, not {expected}")]
    Length {
        /// Bytes that the format has.
        expected: usize,
        /// Bytes that came.
        got: usize,
    },
    /// Wrong checksum.
    #[error("CRC {got:04X}, not {expected:04X}")]
    Crc {
        /// What the bytes give.
        expected: u16,
        /// The CRC in the packet.
        got: u16,
    },
    /// A classic frame that gives no packet with the one before it or the one after it.
    #[error("no other segment")]
    Incomplete,
}

impl PacketError {
    /// One word for it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Foreign => "foreign",
            Self::Length { .. } => "length",
            Self::Crc { .. } => "CRC",
            Self::Incomplete => "incomplete",
        }
    }
}

impl Packet {
    /// The sixteen bytes.
    #[must_use]
    pub fn encode(&self) -> [u8; BYTES] {
        let mut bytes = self.without_crc();
        if let ([words @ .., end, crc], _) = bytes.as_chunks_mut::<2>() {
            *crc = checksum(self.id, words, *end).to_le_bytes();
        }
        bytes
    }

    /// The sixteen bytes with zeros for the CRC: for reading its fields only.
    #[must_use]
    pub fn without_crc(&self) -> [u8; BYTES] {
        let mut bytes = [0; BYTES];
        let (words, tail) = bytes.as_chunks_mut::<2>().0.split_at_mut(WORDS);
        for (bytes, word) in words.iter_mut().zip(self.words) {
            *bytes = word.to_le_bytes();
        }
        if let [end, _] = tail {
            *end = [self.epoch.0, self.count];
        }
        bytes
    }

    /// Reads sixteen bytes that came under `id`. Never panics.
    ///
    /// # Errors
    /// When the length or the CRC is wrong.
    pub fn decode(id: Id, bytes: &[u8]) -> Result<Self, PacketError> {
        let length = PacketError::Length { expected: BYTES, got: bytes.len() };
        let bytes: &[u8; BYTES] = bytes.try_into().map_err(|_| length)?;
        let (chunks, _) = bytes.as_chunks::<2>();
        let [words @ .., end, crc] = chunks else {
            return Err(length);
        };
        let (expected, got) = (checksum(id, words, *end), u16::from_le_bytes(*crc));
        if expected != got {
            return Err(PacketError::Crc { expected, got });
        }
        let mut packet = Self { id, words: [0; WORDS], epoch: Epoch(end[0]), count: end[1] };
        for (word, bytes) in packet.words.iter_mut().zip(words) {
            *word = i16::from_le_bytes(*bytes);
        }
        Ok(packet)
    }

    /// The frames that carry this packet: one FD frame with bit-rate switch, or two classic ones.
    pub fn frames(&self, format: Format) -> impl Iterator<Item = Frame> + use<> {
        let id = u32::from(self.id.to_bits());
        let bytes = self.encode();
        let (first, second) = match format {
            Format::Fd => (Frame::fd(id, can::BIT_RATE_SWITCH, &bytes).ok(), None),
            Format::Classic => {
                let (head, tail) = bytes.split_at(SEGMENT_BYTES);
                (Frame::classic(id, head).ok(), Frame::classic(id, tail).ok())
            }
        };
        first.into_iter().chain(second)
    }

    /// Reads an FD frame. Never panics.
    ///
    /// # Errors
    /// When it is not an FD data frame with an 11-bit identifier, or not a packet.
    pub fn from_fd(frame: &Frame) -> Result<Self, PacketError> {
        let id = data_id(frame)?;
        if frame.format() != Format::Fd {
            return Err(PacketError::Length { expected: BYTES, got: frame.data().len() });
        }
        Self::decode(id, frame.data())
    }
}

/// The identifier of a frame that could be one of ours.
///
/// # Errors
/// When it is a remote or error frame, or has a 29-bit identifier.
pub fn data_id(frame: &Frame) -> Result<Id, PacketError> {
    if frame.is_extended() || frame.is_remote() || frame.is_error() {
        return Err(PacketError::Foreign);
    }
    u16::try_from(frame.id()).map(Id::from_bits).map_err(|_| PacketError::Foreign)
}

fn checksum(id: Id, words: &[[u8; 2]], end: [u8; 2]) -> u16 {
    let mut digest = CRC.digest();
    digest.update(&id.to_bits().to_le_bytes());
    digest.update(words.as_flattened());
    digest.update(&end);
    digest.finalize()
}

/// What became of a classic frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Reassembly {
    /// A first segment; the second one is awaited.
    Waiting,
    /// Both segments arrived and the CRC is right.
    Complete(Packet),
    /// A packet is lost: two segments that do not belong together, or that came too far apart. The older one is
    /// dropped, and the newer one is now the first. Returned once for a packet both of whose segments came.
    Incomplete,
}

/// The waiting first segment of a packet in two classic frames, one of these per identifier.
///
/// Segments come in order and within [`Segment::within`] of each other. When the CRC of two segments fails, only
/// the older one is dropped, so that a lost frame costs one packet and not every later one.
#[derive(Clone, Copy, Debug, Default)]
pub struct Segment {
    waiting: Option<Waiting>,
}

#[derive(Clone, Copy, Debug)]
struct Waiting {
    data: [u8; 8],
    since: Micros,
    /// It may be the second segment of a packet that has been counted as incomplete: it is not counted again.
    counted: bool,
}

impl Segment {
    /// The longest time between the segments of joints and of the answers to them: less than the 16 ms after which
    /// the next ones usually come, because one in 65 536 pairs of segments of different packets has a right CRC.
    const WITHIN_A_PERIOD: Span = Span::from_millis(15);
    /// The longest time between those of everything else, most of which is sent once.
    const WITHIN: Span = Span::from_millis(100);

    /// Nothing waiting.
    pub const NONE: Self = Self { waiting: None };

    /// The longest time between the arrivals of the two segments of a packet.
    #[must_use]
    pub fn within(id: Id) -> Span {
        let is_periodic = matches!(id.kind, Kind::Sum | Kind::Torque) || id == Id::command(Command::Joints);
        if is_periodic { Self::WITHIN_A_PERIOD } else { Self::WITHIN }
    }

    /// Whether a half waits for its other one.
    #[must_use]
    pub const fn is_waiting(&self) -> bool {
        self.waiting.is_some()
    }

    /// Takes the next classic frame of this identifier.
    ///
    /// # Errors
    /// When it does not carry 8 bytes; a waiting half keeps waiting.
    pub fn push(&mut self, at: Micros, id: Id, data: &[u8]) -> Result<Reassembly, PacketError> {
        let length = PacketError::Length { expected: SEGMENT_BYTES, got: data.len() };
        let data: [u8; 8] = data.try_into().map_err(|_| length)?;
        let Some(older) = self.waiting.replace(Waiting { data, since: at, counted: false }) else {
            return Ok(Reassembly::Waiting);
        };
        let mut bytes = [0; BYTES];
        let (head, tail) = bytes.split_at_mut(older.data.len());
        head.copy_from_slice(&older.data);
        tail.copy_from_slice(&data);
        let (packet, in_time) = (Packet::decode(id, &bytes), at.since(older.since) <= Self::within(id));
        let Some(packet) = packet.as_ref().ok().filter(|_| in_time) else {
            let of_one_packet = in_time || packet.is_ok();
            if let Some(newer) = &mut self.waiting {
                newer.counted = of_one_packet && !older.counted;
            }
            return Ok(if older.counted { Reassembly::Waiting } else { Reassembly::Incomplete });
        };
        self.waiting = None;
        Ok(Reassembly::Complete(*packet))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn packet() -> impl Strategy<Value = Packet> {
        (0_u16..0x800, any::<[i16; WORDS]>(), any::<u8>(), any::<u8>()).prop_map(
            |(id, words, epoch, count)| Packet { id: Id::from_bits(id), words, epoch: Epoch(epoch), count },
        )
    }

    #[test]
    fn the_crc_is_ccitt_false() {
        assert_eq!(crc16(b"123456789"), 0x29B1, "the check value of the catalogue");
    }

    #[test]
    fn epochs_are_compared_around_the_corner() {
        assert_eq!(Epoch(2).since(Epoch(254)), 4);
        assert_eq!(Epoch(254).since(Epoch(2)), -4);
        assert_eq!(Epoch(255).next(), Epoch(0));
    }

    #[test]
    fn a_lost_half_costs_one_packet() {
        let id = Id::command(Command::Joints);
        let make = |epoch| Packet { id, words: [7; WORDS], epoch: Epoch(epoch), count: 6 };
        let segments = |epoch| make(epoch).frames(Format::Classic).collect::<Vec<_>>();
        let mut segment = Segment::NONE;
        let mut push = |at, frame: &Frame| segment.push(Micros(at), id, frame.data()).unwrap();
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
            let packet = Packet { id, words: [7; WORDS], epoch: Epoch(1), count: 1 };
            let came = [longest, longest + 1].map(|apart| {
                let mut segment = Segment::NONE;
                let segments = packet.frames(Format::Classic).zip([0, apart]);
                segments
                    .map(|(frame, at)| segment.push(Micros(at), id, frame.data()).unwrap())
                    .last()
                    .unwrap()
            });
            assert_eq!(came, [Reassembly::Complete(packet), Reassembly::Incomplete], "{id:?}");
        }
    }

    #[test]
    fn a_packet_both_of_whose_segments_came_is_counted_once() {
        let id = Id::command(Command::Joints);
        let make = |epoch| Packet { id, words: [7; WORDS], epoch: Epoch(epoch), count: 6 };
        let segments = |epoch| make(epoch).frames(Format::Classic).collect::<Vec<_>>();
        let damaged = Frame::classic(segments(2)[0].raw_id(), &[9; 8]).unwrap();
        for (first, apart) in [(segments(2)[0], 15_001), (damaged, 100)] {
            let mut segment = Segment::NONE;
            let mut push = |at, frame: &Frame| segment.push(Micros(at), id, frame.data()).unwrap();
            assert_eq!(push(0, &first), Reassembly::Waiting);
            assert_eq!(push(apart, &segments(2)[1]), Reassembly::Incomplete);
            assert_eq!(push(50_000, &segments(3)[0]), Reassembly::Waiting, "that packet is counted");
            assert_eq!(push(50_100, &segments(3)[1]), Reassembly::Complete(make(3)));
            // Segments of two packets, each of which lost its other one, are counted each.
            assert_eq!(push(90_000, &segments(4)[0]), Reassembly::Waiting);
            assert_eq!(push(110_000, &segments(5)[0]), Reassembly::Incomplete);
            assert_eq!(push(130_000, &segments(6)[0]), Reassembly::Incomplete);
        }
    }

    #[test]
    fn frames_of_other_kinds_are_foreign() {
        let extended = Frame::fd(0x123 | can::EXTENDED, 0, &[0; 16]).unwrap();
        assert_eq!(Packet::from_fd(&extended), Err(PacketError::Foreign));
        assert_eq!(data_id(&Frame::remote(0x123, 8).unwrap()), Err(PacketError::Foreign));
        let error = Frame::classic(can::ERROR | 4, &[0; 8]).unwrap();
        assert_eq!(data_id(&error), Err(PacketError::Foreign));
        let short = Frame::fd(0x123, 0, &[0; 12]).unwrap();
        assert_eq!(Packet::from_fd(&short), Err(PacketError::Length { expected: 16, got: 12 }));
    }

    proptest! {
        #[test]
        fn a_packet_comes_back_from_either_format(packet in packet()) {
            let fd: Vec<_> = packet.frames(Format::Fd).collect();
            prop_assert_eq!(fd.len(), 1);
            prop_assert_eq!(Packet::from_fd(&fd[0]), Ok(packet));
            let mut segment = Segment::NONE;
            let mut last = Reassembly::Waiting;
            for frame in packet.frames(Format::Classic) {
                last = segment.push(Micros(0), packet.id, frame.data()).unwrap();
            }
            prop_assert_eq!(last, Reassembly::Complete(packet));
        }

        #[test]
        fn a_packet_under_another_identifier_is_refused(packet in packet(), other in 0_u16..0x800) {
            prop_assume!(other != packet.id.to_bits());
            prop_assert!(Packet::decode(Id::from_bits(other), &packet.encode()).is_err());
        }

        #[test]
        fn one_to_three_wrong_bits_are_always_noticed(packet in packet(), bits in proptest::collection::btree_set(0_usize..128, 1..=3)) {
            let mut bytes = packet.encode();
            for bit in bits {
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
            prop_assert!(Packet::decode(packet.id, &bytes).is_err());
        }

        #[test]
        fn no_bytes_panic(kind in 0_u16..0x800, bytes in proptest::collection::vec(any::<u8>(), 0..70)) {
            let _ = Packet::decode(Id::from_bits(kind), &bytes);
            let _ = Segment::default().push(Micros(0), Id { kind: Kind::Sum, node: 0 }, &bytes);
        }
    }
}
