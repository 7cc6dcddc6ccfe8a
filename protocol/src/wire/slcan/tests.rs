use super::*;
use crate::can::{ERROR, ERROR_STATE, EXTENDED, FD_FORMAT, REMOTE};
use proptest::prelude::*;

fn lines(bytes: &[u8]) -> Vec<SlcanLine> {
    let mut decoder = Decoder::new();
    bytes.iter().filter_map(|&byte| decoder.push(byte)).collect()
}

fn one(text: &str) -> SlcanLine {
    let lines = lines(format!("{text}\r").as_bytes());
    assert_eq!(lines.len(), 1, "{text}");
    lines[0]
}

fn fd(id: u32, flags: u8, data: &[u8]) -> Frame {
    Frame::fd(id, flags, data).unwrap()
}

/// Compares frames with lines written by hand, in both directions.
#[test]
fn frames_are_these_lines() {
    let count: Vec<u8> = (0..12).collect();
    for (text, frame) in [
        ("t0000", Frame::classic(0, &[]).unwrap()),
        ("t7FF8FFEEDDCCBBAA9988", Frame::classic(0x7FF, &[255, 238, 221, 204, 187, 170, 153, 136]).unwrap()),
        ("T000000011A5", Frame::classic(EXTENDED | 1, &[0xA5]).unwrap()),
        ("T1FFFFFFF0", Frame::classic(EXTENDED | 0x1FFF_FFFF, &[]).unwrap()),
        ("r1230", Frame::remote(0x123, 0).unwrap()),
        ("r1238", Frame::remote(0x123, 8).unwrap()),
        ("R1234ABCD3", Frame::remote(EXTENDED | 0x1234_ABCD, 3).unwrap()),
        ("d1231AA", fd(0x123, 0, &[0xAA])),
        ("d1239000102030405060708090A0B", fd(0x123, 0, &count)),
        ("D000001230", fd(EXTENDED | 0x123, 0, &[])),
        ("b1230", fd(0x123, BIT_RATE_SWITCH, &[])),
        ("B000001239000102030405060708090A0B", fd(EXTENDED | 0x123, BIT_RATE_SWITCH, &count)),
    ] {
        assert_eq!(one(text), SlcanLine::Frame(frame), "{text}");
        assert_eq!(encode(&frame).unwrap().as_bytes(), format!("{text}\r").as_bytes());
        assert_eq!(one(&format!("{}{}", &text[..1], text[1..].to_lowercase())), SlcanLine::Frame(frame));
    }
}

#[test]
fn every_length_of_fd_has_its_digit() {
    for (digit, len) in
        "0123456789ABCDEF".chars().zip([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64])
    {
        let text = format!("b001{digit}{}", "5A".repeat(len));
        let frame = fd(1, BIT_RATE_SWITCH, &vec![0x5A; len]);
        assert_eq!(one(&text), SlcanLine::Frame(frame));
        assert_eq!(encode(&frame).unwrap().as_bytes(), format!("{text}\r").as_bytes());
    }
}

#[test]
fn what_is_sent_is_filled_up_to_its_dlc() {
    assert_eq!(encode(&fd(1, 0, &[7; 9])).unwrap().as_bytes(), b"d0019070707070707070707000000\r");
    let longest = encode(&fd(EXTENDED | 1, BIT_RATE_SWITCH, &[1; 49])).unwrap();
    assert_eq!(longest.as_bytes().len(), 139);
    assert!(longest.as_bytes().starts_with(b"B00000001F0101"));
    assert!(longest.as_bytes().ends_with(b"01000000000000000000000000000000\r"));
}

#[test]
fn what_slcan_cannot_say_is_left_out() {
    assert_eq!(encode(&Frame::classic(ERROR | 4, &[0; 8]).unwrap()), None);
    let raw = Frame::classic(1, &[9; 8]).unwrap().with_raw_dlc(15);
    assert_eq!(encode(&raw).unwrap().as_bytes(), b"t00180909090909090909\r");
    assert_eq!(encode(&fd(1, ERROR_STATE, &[])).unwrap().as_bytes(), b"d0010\r");
    // The remote flag is ignored in an FD frame.
    assert_eq!(encode(&fd(REMOTE | 1, 0, &[2])).unwrap().as_bytes(), b"d001102\r");
}

#[test]
fn time_stamps_are_passed_over() {
    let frame = Frame::classic(0x123, &[1, 2]).unwrap();
    assert_eq!(one("t12320102EA5F"), SlcanLine::Frame(frame));
    assert_eq!(one("t12320102DEADBEEF"), SlcanLine::Frame(frame));
    assert_eq!(one("r12320000"), SlcanLine::Frame(Frame::remote(0x123, 2).unwrap()));
    assert_eq!(
        one(&format!("B00000001F{}0123ABCD", "01".repeat(64))),
        SlcanLine::Frame(fd(EXTENDED | 1, BIT_RATE_SWITCH, &[1; 64]))
    );
    for (text, refusal) in [
        ("t12320102E", LineRefusal::Long),
        ("t12320102EA5", LineRefusal::Long),
        ("t12320102EA5F12", LineRefusal::Long),
        ("t12320102EA5F2", LineRefusal::Long),
        ("t12320102EA5G", LineRefusal::Garbage),
    ] {
        assert_eq!(one(text), SlcanLine::Refused(refusal), "{text}");
    }
}

#[test]
fn what_is_no_frame_is_refused_for_its_reason() {
    for (text, refusal) in [
        ("t", LineRefusal::Short),
        ("t12", LineRefusal::Short),
        ("t123", LineRefusal::Short),
        ("t1231", LineRefusal::Short),
        ("t1231A", LineRefusal::Short),
        ("T1234567", LineRefusal::Short),
        ("b1239000102030405060708090A", LineRefusal::Short),
        ("t1239000102030405060708090A0B", LineRefusal::Dlc),
        ("r123F", LineRefusal::Dlc),
        ("T00000001A", LineRefusal::Dlc),
        ("t8000", LineRefusal::Identifier),
        ("d8000", LineRefusal::Identifier),
        ("T200000000", LineRefusal::Identifier),
        ("tXYZ0", LineRefusal::Garbage),
        ("t123G", LineRefusal::Garbage),
        ("t1231G0", LineRefusal::Garbage),
        ("t12310-", LineRefusal::Garbage),
        ("t+120", LineRefusal::Garbage),
        ("t1230 ", LineRefusal::Long),
        ("t12301\u{7f}", LineRefusal::Garbage),
        ("C\0", LineRefusal::Garbage),
        ("t1230é", LineRefusal::Garbage),
    ] {
        assert_eq!(one(text), SlcanLine::Refused(refusal), "{text}");
    }
}

#[test]
fn the_state_of_a_sender_behind_the_data_is_read() {
    let data = [0xAA, 0xBB];
    let classic = Frame::classic(0x123, &data).unwrap();
    let [active, passive] = [0, ERROR_STATE].map(|state| fd(0x123, BIT_RATE_SWITCH | state, &data));
    for (text, frame) in [
        ("t1232AABB0", classic),
        ("t1232AABB1", classic),
        ("t1232AABB0A510", classic),
        ("t1232AABB0000000F1", classic),
        ("r12330", Frame::remote(0x123, 3).unwrap()),
        ("b1232AABB0", active),
        ("b1232AABB1", passive),
        ("b1232AABB0A511", passive),
        ("b1232AABB0000000F1", passive),
        ("b1232AABBS", passive),
        ("b1232AABB0A51S", passive),
        ("b1230", fd(0x123, BIT_RATE_SWITCH, &[])),
        ("b1230S", fd(0x123, BIT_RATE_SWITCH | ERROR_STATE, &[])),
    ] {
        assert_eq!(one(text), SlcanLine::Frame(frame), "{text}");
    }
    let longest = format!("B00000001F{}0123ABCD1", "01".repeat(64));
    assert_eq!(longest.len(), MAX_LINE);
    assert_eq!(one(&longest), SlcanLine::Frame(fd(EXTENDED | 1, BIT_RATE_SWITCH | ERROR_STATE, &[1; 64])));
    for (text, refusal) in [
        ("t1232AABB2", LineRefusal::Long),
        ("t1232AABB00", LineRefusal::Long),
        ("t1232AABBs", LineRefusal::Long),
        ("t1232AABBSS", LineRefusal::Long),
        ("t1232AABB0S", LineRefusal::Long),
        ("t1232AABBG000S", LineRefusal::Garbage),
        ("t1232AABS", LineRefusal::Garbage),
        // The line ending between two lines is lost.
        ("t1230d0010", LineRefusal::Long),
        ("t1230b0012AAB0", LineRefusal::Long),
    ] {
        assert_eq!(one(text), SlcanLine::Refused(refusal), "{text}");
    }
}

#[test]
fn an_adapter_ends_all_frames_in_one_way_and_two_in_another_show_that_it_has_changed() {
    let frame = SlcanLine::Frame(Frame::classic(0x123, &[0x11]).unwrap());
    let [plain, ended] = [b"t123111\r", b"t1231110\r".as_slice()].map(|text| text.to_vec());
    for (usual, other, refusal) in [(&plain, &ended, LineRefusal::Long), (&ended, &plain, LineRefusal::Short)]
    {
        let mixed = [usual.repeat(15), other.clone(), usual.repeat(16)].concat();
        assert_eq!(lines(&mixed), [frame; 32], "nothing is sure yet");
        let bytes = [usual.repeat(16), other.clone(), usual.clone(), other.repeat(2), usual.clone()].concat();
        let refused = SlcanLine::Refused(refusal);
        assert_eq!(lines(&bytes)[16..], [refused, frame, refused, frame, frame]);
        // `S` is not a digit, and may be missing.
        let letters = [usual.repeat(16), b"t123111S\r".to_vec()].concat();
        assert_eq!(lines(&letters)[16], frame);
    }
}

fn reported(text: &str) -> AdapterReport {
    let SlcanLine::Reported(report) = one(text) else { panic!("{text}: {:?}", one(text)) };
    report
}

#[test]
fn faults_of_an_adapter_are_the_error_frames_of_the_kernels_driver() {
    use BusState::{Active, Off, Passive, Warning};
    // Classes and bits of linux/can/error.h, derived by hand from the handling of each line in slcan-core.c.
    for (text, before, class, data) in [
        ("e1a", Active, 0xA8, [0, 0, 0, 0x19, 0, 0, 0, 0]),
        ("e1b", Active, 0x88, [0, 0, 0x08, 0, 0, 0, 0, 0]),
        ("e1B", Passive, 0x88, [0, 0, 0x10, 0, 0, 0, 0, 0]),
        ("e1c", Active, 0x88, [0, 0, 0x01, 0x08, 0, 0, 0, 0]),
        ("e1f", Active, 0x88, [0, 0, 0x02, 0, 0, 0, 0, 0]),
        ("e1s", Active, 0x88, [0, 0, 0x04, 0, 0, 0, 0, 0]),
        ("e1o", Active, 0x8C, [0, 0x01, 0, 0, 0, 0, 0, 0]),
        ("e3bcO", Active, 0x8C, [0, 0x02, 0x09, 0x08, 0, 0, 0, 0]),
        ("e1ab", Active, 0xA8, [0, 0, 0, 0x19, 0, 0, 0, 0]),
        ("sb256256", Active, 0x40, [0; 8]),
        ("sa057033", Off, 0x204, [0, 0x40, 0, 0, 0, 0, 33, 57]),
        ("sw096000", Active, 0x204, [0, 0x04, 0, 0, 0, 0, 0, 96]),
        ("sw000096", Active, 0x204, [0, 0x08, 0, 0, 0, 0, 96, 0]),
        ("sp128128", Warning, 0x204, [0, 0x30, 0, 0, 0, 0, 128, 128]),
        ("E2310800C", Active, 0x2AD, [0, 0x20, 0, 0x19, 0, 0, 0x80, 0x0C]),
        ("E2310800C", Passive, 0x2A9, [0, 0, 0, 0x19, 0, 0, 0x80, 0x0C]),
        ("E300FF00", Active, 0, [0; 8]),
        ("E3000FF00", Active, 0x40, [0; 8]),
        ("E01040000", Active, 0x28C, [0, 0x02, 0x04, 0, 0, 0, 0, 0]),
        ("F80", Active, 0x88, [0; 8]),
        ("F24", Active, 0x04, [0, 0x30, 0, 0, 0, 0, 0, 0]),
        ("FA4", Passive, 0x88, [0; 8]),
        ("F09", Active, 0x04, [0, 0x01, 0, 0, 0, 0, 0, 0]),
        ("F52", Active, 0x46, [0, 0x02, 0, 0, 0, 0, 0, 0]),
    ] {
        if class == 0 {
            assert_eq!(one(text), SlcanLine::Other, "{text}");
            continue;
        }
        let frame = Frame::classic(ERROR | class, &data).unwrap();
        assert_eq!(reported(text).error_frame(before), Some(frame), "{text}");
    }
    // A known state is not an event.
    for (text, before) in
        [("sb256256", Off), ("sp130000", Passive), ("F20", Passive), ("F00", Active), ("E20001000", Passive)]
    {
        assert_eq!(reported(text).error_frame(before), None, "{text}");
    }
    assert_eq!(reported("sp128007").counters(), Some(ErrorCounters { receive: 128, transmit: 7 }));
    assert_eq!(
        reported("e3bcO").faults().map(AdapterFault::name).collect::<Vec<_>>(),
        ["bit 0 error", "CRC error", "transmit overrun"]
    );
    for text in [
        "e",
        "e0",
        "e1",
        "e2a",
        "e1x",
        "e9aaaaaaaaa",
        "s",
        "sx000000",
        "sb25625",
        "sb2562560",
        "sb25x256",
        "s031C",
        "s08450A05",
        "E",
        "E4000000",
        "E40000000",
        "E07000000",
        "E2310800",
        "E2310800C0",
        "E23108g0C",
        "F8",
        "F800",
        "FG0",
    ] {
        assert_eq!(one(text), SlcanLine::Other, "{text}");
    }
}

#[test]
fn commands_are_these_lines() {
    for (text, command) in [
        ("C", SlcanCommand::Close),
        ("O", SlcanCommand::Open),
        ("L", SlcanCommand::Listen),
        ("S0", SlcanCommand::BitRate(0)),
        ("S9", SlcanCommand::BitRate(9)),
        ("Y2", SlcanCommand::DataBitRate(2)),
        ("Y5", SlcanCommand::DataBitRate(5)),
        ("V", SlcanCommand::Version),
        ("N", SlcanCommand::SerialNumber),
        ("F", SlcanCommand::Flags),
        ("Z0", SlcanCommand::TimeStamps(false)),
        ("Z1", SlcanCommand::TimeStamps(true)),
        ("M0000A5FF", SlcanCommand::Code(0xA5FF)),
        ("mFFFFFFFF", SlcanCommand::Mask(u32::MAX)),
    ] {
        assert_eq!(one(text), SlcanLine::Command(command), "{text}");
        assert_eq!(command.encode().as_bytes(), format!("{text}\r").as_bytes());
    }
    assert_eq!(one("v"), SlcanLine::Command(SlcanCommand::Version));
}

#[test]
fn bit_rates_have_these_commands() {
    for (bit_rate, digit) in [
        (10_000, 0),
        (20_000, 1),
        (50_000, 2),
        (100_000, 3),
        (125_000, 4),
        (250_000, 5),
        (500_000, 6),
        (750_000, 7),
        (800_000, 7),
        (1_000_000, 8),
        (83_300, 9),
    ] {
        assert_eq!(
            SlcanCommand::nominal_bit_rate(bit_rate),
            Some(SlcanCommand::BitRate(digit)),
            "{bit_rate}"
        );
    }
    assert_eq!(SlcanCommand::nominal_bit_rate(300_000), None);
    for (bit_rate, digit) in [(500_000, 0), (1_000_000, 1), (2_000_000, 2), (5_000_000, 5), (8_000_000, 8)] {
        assert_eq!(
            SlcanCommand::data_bit_rate(bit_rate),
            Some(SlcanCommand::DataBitRate(digit)),
            "{bit_rate}"
        );
    }
    assert_eq!(SlcanCommand::data_bit_rate(9_000_000), None);
    assert_eq!(SlcanCommand::data_bit_rate(2_500_000), None);
}

#[test]
fn adapters_answer_as_they_like() {
    assert_eq!(
        lines(b"\rz\rZ\r\x07V1013\rNA123\rF0\rS\rSA\rM0\rA1\r?\r"),
        [
            SlcanLine::Done,
            SlcanLine::Sent,
            SlcanLine::Sent,
            SlcanLine::Failed,
            SlcanLine::Other,
            SlcanLine::Other,
            SlcanLine::Other,
            SlcanLine::Other,
            SlcanLine::Other,
            SlcanLine::Other,
            SlcanLine::Other,
            SlcanLine::Other,
        ]
    );
    let frame = SlcanLine::Frame(Frame::classic(0x123, &[]).unwrap());
    assert_eq!(lines(b"t1230\r\nt1230\n\n\nt1230\r"), [frame; 3]);
}

#[test]
fn a_bell_in_a_line_ends_it() {
    let mut decoder = Decoder::new();
    let lines: Vec<_> = b"t12\x07t1230\r".iter().filter_map(|&byte| decoder.push(byte)).collect();
    assert_eq!(lines, [SlcanLine::Failed, SlcanLine::Frame(Frame::classic(0x123, &[]).unwrap())]);
    assert_eq!(decoder.rejected_lines(), RejectedLines { garbage: 1, ..RejectedLines::default() });
}

#[test]
fn what_was_refused_is_counted_by_reason() {
    let mut decoder = Decoder::new();
    let long = "0".repeat(MAX_LINE + 1);
    let text = format!("t12\rt12\rt1239\rt9990\rt1230XX\rt1X3\r\x01\r{long}\rt12");
    let refused = text.bytes().filter_map(|byte| decoder.push(byte)).count();
    assert_eq!(refused, 8);
    assert!(decoder.discard_unfinished());
    assert!(!decoder.discard_unfinished());
    let expected = RejectedLines { garbage: 2, long: 2, short: 3, dlc: 1, identifier: 1 };
    assert_eq!(decoder.rejected_lines(), expected);
    assert_eq!(expected.total(), 9);
}

#[test]
fn the_longest_line_fits_and_one_byte_more_does_not() {
    assert_eq!(one(&"x".repeat(MAX_LINE)), SlcanLine::Other);
    assert_eq!(one(&"x".repeat(MAX_LINE + 1)), SlcanLine::Refused(LineRefusal::Long));
    assert_eq!(one(&"x".repeat(1_000_000)), SlcanLine::Refused(LineRefusal::Long));
}

/// Generates frames that slcan can represent without loss.
fn frames() -> impl Strategy<Value = Frame> {
    let id = prop_oneof![0_u32..0x800, (0_u32..0x2000_0000).prop_map(|id| id | EXTENDED)];
    (id, 0_u8..4, 0_u8..16, any::<[u8; 64]>()).prop_map(|(id, kind, dlc, data)| {
        let classic = usize::from(dlc).min(8);
        match kind {
            0 => Frame::classic(id, &data[..classic]).unwrap(),
            1 => Frame::remote(id, dlc.min(8)).unwrap(),
            2 => fd(id, 0, &data[..dlc_len(dlc)]),
            _ => fd(id, BIT_RATE_SWITCH, &data[..dlc_len(dlc)]),
        }
    })
}

proptest! {
    #[test]
    fn every_frame_comes_back(frame in frames()) {
        prop_assert_eq!(lines(encode(&frame).unwrap().as_bytes()), [SlcanLine::Frame(frame)]);
    }

    #[test]
    fn whatever_frame_is_sent_its_text_is_read_again(raw: u32, is_fd: bool, flags in 0_u8..8, data in proptest::collection::vec(any::<u8>(), 0..=64)) {
        let frame = if is_fd {
            Frame::with_data(raw, Format::Fd, flags | FD_FORMAT, &data).unwrap()
        } else {
            Frame::classic(raw, &data[..data.len().min(8)]).unwrap()
        };
        match encode(&frame) {
            None => prop_assert!(frame.is_error()),
            Some(text) => {
                let [SlcanLine::Frame(again)] = lines(text.as_bytes())[..] else { panic!("{text:?}") };
                prop_assert_eq!(encode(&again), Some(text));
                prop_assert_eq!(again.id(), frame.id());
                prop_assert_eq!(again.is_extended(), frame.is_extended());
            }
        }
    }

    #[test]
    fn no_bytes_panic_and_each_line_is_counted_or_says_something(bytes in proptest::collection::vec(any::<u8>(), 0..600)) {
        let mut decoder = Decoder::new();
        let ended: Vec<_> = bytes.iter().filter_map(|&byte| decoder.push(byte)).collect();
        let refused = ended.iter().filter(|line| matches!(line, SlcanLine::Refused(_))).count() as u64;
        let bells = bytes.iter().filter(|&&byte| byte == BEL).count() as u64;
        prop_assert!((refused..=refused + bells).contains(&decoder.rejected_lines().total()));
        prop_assert!(decoder.rejected_lines().total() <= bytes.len() as u64);
    }

    #[test]
    fn after_any_bytes_and_an_end_the_next_frame_is_read(bytes in proptest::collection::vec(any::<u8>(), 0..600), frame in frames()) {
        let mut decoder = Decoder::new();
        for byte in bytes {
            decoder.push(byte);
        }
        decoder.push(CR);
        let text = encode(&frame).unwrap();
        let last = text.as_bytes().iter().filter_map(|&byte| decoder.push(byte)).last();
        prop_assert_eq!(last, Some(SlcanLine::Frame(frame)));
    }

    #[test]
    fn a_line_that_lost_a_byte_is_no_frame(frame in frames(), at: proptest::sample::Index) {
        let text = encode(&frame).unwrap();
        let mut bytes = text.as_bytes().to_vec();
        bytes.remove(at.index(bytes.len() - 1));
        // The decoder has learnt that lines do not end with the state of the sender.
        let mut decoder = Decoder::new();
        for &byte in b"t1230\r".repeat(16).iter() {
            decoder.push(byte);
        }
        prop_assert!(!bytes.iter().filter_map(|&byte| decoder.push(byte)).any(|line| matches!(line, SlcanLine::Frame(_))));
    }

    #[test]
    fn two_lines_that_lost_the_end_between_them_are_no_frame(one in frames(), other in frames()) {
        let (one, other) = (encode(&one).unwrap(), encode(&other).unwrap());
        let bytes = [&one.as_bytes()[..one.as_bytes().len() - 1], other.as_bytes()].concat();
        prop_assert!(matches!(lines(&bytes)[..], [SlcanLine::Refused(_)]));
    }
}
