//! Frame times compared with external counts, a second implementation, and all possible frames.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, reason = "a test may stop")]

mod every_frame;
mod oracle;

use crate::can::{BIT_RATE_SWITCH, ERROR, ERROR_STATE, EXTENDED, Format, Frame, REMOTE};
use crate::wire_time::{BitRates, FrameBits, FrameCoding, FrameShape};
use proptest::prelude::*;

/// Frames and their numbers of bits, counted by another program.
const VECTORS: &str = include_str!("../../tests/vectors/can_frame_bits.csv");

/// Counts the bits of a frame with the second implementation.
fn counted_bits(frame: &Frame) -> FrameBits {
    let [head, data, tail] = oracle::bits(frame);
    FrameBits { nominal: head + tail, data }
}

fn frame(format: &str, id: u32, data: &[u8]) -> Frame {
    match format {
        "classic" => Frame::classic(id, data).unwrap(),
        "fd-brs" => Frame::fd(id, BIT_RATE_SWITCH, data).unwrap(),
        other => panic!("{other}"),
    }
}

#[test]
fn every_counted_frame_has_its_bits() {
    let mut count = 0;
    for line in VECTORS.lines().skip(1) {
        let [format, id, extended, data, nominal, switched] =
            line.split(',').collect::<Vec<_>>().try_into().unwrap();
        let data: Vec<u8> =
            (0..data.len()).step_by(2).map(|at| u8::from_str_radix(&data[at..at + 2], 16).unwrap()).collect();
        let flag = if extended == "1" { EXTENDED } else { 0 };
        let frame = frame(format, u32::from_str_radix(id, 16).unwrap() | flag, &data);
        let expected = FrameBits { nominal: nominal.parse().unwrap(), data: switched.parse().unwrap() };
        assert_eq!(FrameBits::from_frame(&frame), Some(expected), "{line}");
        assert_eq!(counted_bits(&frame), expected, "{line}");
        count += 1;
    }
    assert_eq!(count, 200);
}

#[test]
fn the_worst_packet_takes_what_the_documents_say() {
    let fd = FrameShape { coding: FrameCoding::FdSwitched, extended: false, len: 16 }.max_bits();
    assert_eq!(fd, FrameBits { nominal: 32, data: 192 });
    let micros = |text: &str| fd.seconds(text.parse().unwrap()) * 1e6;
    for (rates, expected) in
        [("500k/2M", 160.0), ("500k/5M", 102.4), ("1M/2M", 128.0), ("1M/5M", 70.4), ("1M/8M", 56.0)]
    {
        assert!((micros(rates) - expected).abs() < 1e-9, "{rates}: {}", micros(rates));
    }
    let segment = FrameShape { coding: FrameCoding::Classic, extended: false, len: 8 }.max_bits();
    assert_eq!(2 * segment.nanoseconds(BitRates::classic(1_000_000).unwrap()), 266_000);
}

#[test]
fn a_drivers_error_frame_has_no_bits() {
    assert_eq!(FrameBits::from_frame(&Frame::classic(ERROR | 4, &[0; 8]).unwrap()), None);
}

#[test]
fn an_fd_length_that_does_not_exist_is_filled_up_with_zeros() {
    for len in 0..=64_usize {
        let data = vec![0x5A; len];
        let mut full = data.clone();
        let wire =
            [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64].into_iter().find(|&wire| wire >= len);
        full.resize(wire.unwrap(), 0);
        for id in [0x123, EXTENDED | 0x123] {
            assert_eq!(
                FrameBits::from_frame(&frame("fd-brs", id, &data)),
                FrameBits::from_frame(&frame("fd-brs", id, &full)),
                "{len}"
            );
        }
    }
}

#[test]
fn times_are_rounded_up_where_they_are_no_whole_nanoseconds() {
    let rates = BitRates::new(300_000, 7_000_000).unwrap();
    let bits = FrameBits { nominal: 2, data: 3 };
    // 6666.67 and 428.57 ns.
    assert_eq!(bits.nanoseconds(rates), 6_667 + 429);
    assert!((bits.seconds(rates) - 7.095_238_095e-6).abs() < 1e-15);
    assert_eq!(bits.total_bits(), 5);
}

fn any_frame() -> impl Strategy<Value = Frame> {
    let data = prop_oneof![
        proptest::collection::vec(any::<u8>(), 0..=64),
        // Data with long runs.
        proptest::collection::vec(
            prop_oneof![Just(0x00), Just(0xFF), Just(0x83), Just(0xE0), Just(0xF8), Just(0x3E)],
            0..=64
        ),
    ];
    let id =
        prop_oneof![0..0x800_u32, (0..0x2000_0000_u32).prop_map(|id| id | EXTENDED), Just(0), Just(EXTENDED)];
    (id, data, 0..4_u8, 0..4_u8, 9..16_u8).prop_map(|(id, data, kind, flags, dlc)| match kind {
        0 => {
            let frame = Frame::classic(id, &data[..data.len().min(8)]).unwrap();
            if data.len() >= 8 && flags == 0 { frame.with_raw_dlc(dlc) } else { frame }
        }
        1 => Frame::remote(id, u8::try_from(data.len() % 9).unwrap()).unwrap(),
        _ => Frame::fd(id, flags & (BIT_RATE_SWITCH | ERROR_STATE), &data).unwrap(),
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn bits_are_those_of_a_second_implementation(frame in any_frame()) {
        prop_assert_eq!(FrameBits::from_frame(&frame), Some(counted_bits(&frame)));
    }

    #[test]
    fn no_frame_is_shorter_than_the_best_or_longer_than_the_worst(frame in any_frame()) {
        let (bits, shape) = (FrameBits::from_frame(&frame).unwrap(), FrameShape::from_frame(&frame));
        let (best, worst) = (shape.min_bits(), shape.max_bits());
        prop_assert!(best.nominal <= bits.nominal && bits.nominal <= worst.nominal, "{best:?} {bits:?} {worst:?}");
        prop_assert!(best.data <= bits.data && bits.data <= worst.data, "{best:?} {bits:?} {worst:?}");
    }

    #[test]
    fn no_remote_flag_changes_an_fd_frame(id in 0..0x800_u32, data in proptest::collection::vec(any::<u8>(), 0..=64)) {
        let with = |id| FrameBits::from_frame(&Frame::with_data(id, Format::Fd, BIT_RATE_SWITCH, &data).unwrap());
        prop_assert_eq!(with(id | REMOTE), with(id));
    }
}
