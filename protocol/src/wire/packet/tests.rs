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
    let once = [Id::command(Command::Halt), cell(Kind::Network), cell(Kind::Configure), cell(Kind::Stimulus)];
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
    assert_eq!(data_frame_id(&Frame::remote(0x123, 8).unwrap()), Err(PacketError::Foreign));
    let error = Frame::classic(ERROR | 4, &[0; 8]).unwrap();
    assert_eq!(data_frame_id(&error), Err(PacketError::Foreign));
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
        let packet = Packet { id, words: Words::new(Length::Fourteen, words), epoch: Epoch(9), count: 14 };
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
