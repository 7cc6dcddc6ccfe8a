//! The text of every kind of frame, against lines written by hand from the document and the golden logs' comments.

use core::f64::consts::FRAC_PI_2;

use super::settle::OrderedDecoder;
use super::*;
use proptest::prelude::*;
use protocol::candump::{self, CandumpLine, Timestamp};
use protocol::fixed::TorqueFormat;
use protocol::id::{Command, Kind};
use protocol::schema::BusUnits;
use protocol::skin::JointKind;

const DOCUMENT: &str = include_str!("../../../../protocol/tests/golden/document.log");
const FD: &str = include_str!("../../../../protocol/tests/golden/fd.log");
const BAD: &str = include_str!("../../../../protocol/tests/golden/bad.log");
const WIRE: &str = include_str!("../../../../protocol/tests/golden/wire.log");
const CLASSIC: &str = include_str!("../../../../protocol/tests/golden/classic.log");

/// Returns each frame's comment in the log with its decoded text.
fn decoded(log: &str, format: Option<Format>) -> Vec<(String, String)> {
    let mut settler = OrderedDecoder::new(format);
    let mut comment = "";
    for line in log.lines() {
        match candump::parse(line).unwrap() {
            CandumpLine::Frame(record) => {
                let at = Micros(record.time.nanos / 1_000);
                settler.push(at, record.interface, &record.frame, comment.to_owned());
            }
            CandumpLine::Dropped { .. } | CandumpLine::CanXl | CandumpLine::Other => {
                comment = line.trim_start_matches("# ")
            }
        }
    }
    settler.finish();
    std::iter::from_fn(|| settler.pop()).map(|(comment, decoded)| (comment, decoded.to_string())).collect()
}

/// Returns a decoder that has seen two packets of cell 12, so that its torque identifier carries packets.
fn knowing(format: Option<Format>) -> Decoder {
    let mut decoder = Decoder::new(format);
    let packet = Packet {
        id: Id { kind: Kind::Torque, node: 12 },
        words: [0; protocol::packet::WORDS].into(),
        epoch: protocol::packet::Epoch(1),
        count: 1,
    };
    for _ in 0..2 {
        for frame in packet.frames(format.unwrap_or(Format::Fd)) {
            decoder.decode(Micros(0), "vcan0", &frame);
        }
    }
    decoder
}

/// Returns the text of a frame in cansend notation.
fn text(frame: &str) -> String {
    let frame = candump::parse_frame(frame).unwrap();
    Decoder::new(None).decode(Micros(0), "vcan0", &frame).to_string()
}

/// Compares the text of the only frame with each comment with the expected text.
fn check(log: &str, expected: &[(&str, &str)]) {
    let all = decoded(log, None);
    for (comment, text) in expected {
        let found: Vec<_> = all.iter().filter(|(of, _)| of == comment).map(|(_, text)| text).collect();
        assert_eq!(found, [text], "{comment}");
    }
}

#[test]
fn the_frames_of_the_document() {
    let texts: Vec<_> = decoded(DOCUMENT, None).into_iter().map(|(_, text)| text).collect();
    let skin = "proximity 0.0000, temperature 0.00 0.00 °C";
    let expected = [
        "ok      torque 12 epoch 7: 1.0000 -0.5000 0.0002 0.0000 0.0000 0.0000 Nm".to_owned(),
        "ok      halt".to_owned(),
        "ok      sync".to_owned(),
        "ok      resume".to_owned(),
        "ok      joints epoch 7: 0.0000 -1.2000 1.0000 -1.4000 -1.5700 0.0000 rad".to_owned(),
        "ok      configure 12 tag 1: write mount: joint 2 of 6".to_owned(),
        "ok      configure 12 tag 2: write pose: position 0.1000 0.0500 0.0600 m, normal 0.0000 0.8000 0.6000"
            .to_owned(),
        "ok      configure 12 tag 3: write contact: alpha_c 1.0000, alpha_p 0.000 N, contact threshold 0.101 N, \
         proximity threshold 0.0500, force threshold 0.101 N"
            .to_owned(),
        "ok      configure 12 tag 4: write timing: period 16000 us".to_owned(),
        row(5, "row1: a 0.0000 m, d 0.0892 m, alpha 1.5708 rad"),
        row(6, "row2: a -0.4250 m, d 0.0000 m, alpha 0.0000 rad"),
        row(7, "row3: a -0.3923 m, d 0.0000 m, alpha 0.0000 rad"),
        row(8, "row4: a 0.0000 m, d 0.1091 m, alpha 1.5708 rad"),
        row(9, "row5: a 0.0000 m, d 0.0947 m, alpha -1.5708 rad"),
        row(10, "row6: a 0.0000 m, d 0.0823 m, alpha 0.0000 rad"),
        "ok      configure 12 tag 11: write commit: hash 266D".to_owned(),
        "ok      configure 12 tag 12: write mode: 1, obey stimuli".to_owned(),
        format!("ok      stimulus 12 from the next joints on: force 3.000 N (1.000 1.000 1.000), {skin}"),
        format!("ok      stimulus 12 from the next joints on: force 0.000 N (0.000 0.000 0.000), {skin}"),
        "ok      torque 12 epoch 7: -0.2625 0.7800 0.0000 0.0000 0.0000 0.0000 Nm".to_owned(),
        "ok      torque 12 epoch 8: 0.0000 0.0000 0.0000 0.0000 0.0000 0.0000 Nm".to_owned(),
        "ok      configure everyone tag 0: write sensing: event".to_owned(),
        "ok      configure 12 tag 0: write sensing: continuous, every 16 ms".to_owned(),
        format!("ok      sensors 12 epoch 7: force 3.000 N (1.000 1.000 1.000), {skin}"),
        format!("ok      sensors 12 epoch 8: force 0.000 N (0.000 0.000 0.000), {skin}"),
    ];
    assert_eq!(texts, expected);
}

fn row(tag: u8, text: &str) -> String {
    format!("ok      configure 12 tag {tag}: write {text}, theta offset 0.0000 rad")
}

#[test]
fn every_other_kind_has_its_text() {
    check(
        FD,
        &[
            ("report", "ok      report"),
            (
                "joints epoch=2 in_use=3 positions=0.5,-0.5,0.006103515625,0,0,0",
                "ok      joints epoch 2: 0.7854 -0.7854 0.0096 rad",
            ),
            (
                "sum from=254 epoch=255 count=255 torque=127.99609375,-128,127.9921875,-127.99609375,0,0",
                "ok      sum 254 epoch 255: +saturated -saturated 127.992 -127.996 0.000 0.000 Nm, cells 255",
            ),
            (
                "torque from=254 epoch=255 torque=7.999755859375,-8,7.99951171875,-7.999755859375,0,-0.000244140625",
                "ok      torque 254 epoch 255: +saturated -saturated 7.9995 -7.9998 0.0000 -0.0002 Nm",
            ),
            (
                "sensors from=12 epoch=9 contact=1,0.9990234375,-0.0009765625 proximity=1 temperature=25,-40",
                "ok      sensors 12 epoch 9: force 1.998 N (1.000 0.999 -0.001), proximity 1.0000, \
                 temperature 25.00 -40.00 °C",
            ),
            (
                "sensors from=7 epoch=4 acceleration=7.999755859375,-8,-0.000244140625",
                "ok      sensors 7 epoch 4: acceleration 7.9998 -8.0000 -0.0002 g",
            ),
            (
                "heartbeat from=12 epoch=7 serial=100001 configuration=BEEF sent=4711 rejected=3 \
                 state=configured+active joint=2 version=1",
                "ok      network 12 epoch 7 heartbeat: serial 100001, hash BEEF, sent 4711, refused 3, \
                 configured+active, joint 2, version 1",
            ),
            (
                "heartbeat from=254 epoch=255 serial=4294967295 configuration=FFFF sent=65535 rejected=65535 \
                 state=configured+active+halted+flash-damaged+duplicate+test-mode+saturated+claiming joint=15 \
                 version=15",
                "ok      network 254 epoch 255 heartbeat: serial 4294967295, hash FFFF, sent 65535, refused 65535, \
                 configured+active+halted+flash-damaged+duplicate+test-mode+saturated+claiming, joint 15, version 15",
            ),
            (
                "heartbeat from=gateway epoch=200 serial=1 configuration=0000 sent=1 rejected=0 state=none joint=0 \
                 version=1",
                "ok      network gateway epoch 200 heartbeat: serial 1, hash 0000, sent 1, refused 0, none, joint 0, \
                 version 1",
            ),
            (
                "heard from=12 epoch=7 joints=1000 joints_late=2 joints_repeated=3 stimuli=40 stimuli_late=5 \
                 torques=600",
                "ok      network 12 epoch 7 heard: joints 1000, skipped 2, repeated 3, stimuli 40, late 5, torques 600",
            ),
            (
                "refused from=12 epoch=7 length=1 crc=20 foreign=300 meaning=4000 incomplete=50000 stimuli=6",
                "ok      network 12 epoch 7 refused: length 1, CRC 20, foreign 300, meaning 4000, incomplete 50000, \
                 stimuli 6",
            ),
            (
                "tree from=12 epoch=7 parent=3 up=1 depth=4 round=2 children=0+2 works=0+1+2 sent=1000 taken=200 \
                 dropped=3",
                "ok      network 12 epoch 7 tree: child of 3 by port 1, depth 4 of round 2, children at ports 0+2, \
                 working ports 0+1+2, sums sent 1000, taken 200, not taken 3",
            ),
            (
                "tree from=1 epoch=0 parent=0 up=4 depth=0 round=255 children=0+1+2+3 works=0+1+2+3+4 sent=65535 \
                 taken=32768 dropped=1",
                "ok      network 1 epoch 0 tree: root by uplink, depth 0 of round 255, children at ports 0+1+2+3, \
                 working ports 0+1+2+3+4, sums sent 65535, taken 32768, not taken 1",
            ),
            (
                "tree from=9 epoch=200 parent=none up=0 depth=0 round=7 children=none works=1 sent=5 taken=6 \
                 dropped=7",
                "ok      network 9 epoch 200 tree: unreachable (last round 7), children at ports none, working ports 1, \
                 sums sent 5, taken 6, not taken 7",
            ),
            (
                "ports from=12 epoch=7 port0=3/2/hears+works port1=0/0/none port2=254/3/hears \
                 port3=7/0/hears+other-version changes=2",
                "ok      network 12 epoch 7 ports: 0 leads to port 2 of 3, 1 silent, 2 leads to port 3 of 254 (one \
                 direction only), 3 leads to port 0 of 7 (other version); parent changed 2 times",
            ),
            (
                "ports from=1 epoch=0 port0=0/4/hears+works port1=0/0/none port2=0/0/none port3=0/0/none changes=0",
                "ok      network 1 epoch 0 ports: 0 leads to uplink of a cell without a node id, 1 silent, 2 silent, \
                 3 silent; parent changed 0 times",
            ),
            (
                "write to=everyone tag=20 parameter=6 reply=sum slot_us=1500 deepest=6 carry=1",
                "ok      configure everyone tag 20: write reply: sum, slot 1500 us, deepest 6, carry",
            ),
            (
                "refusal from=12 tag=200 parameter=1 reason=19",
                "ok      configured 12 tag 200: refuses mount: it cannot have this value, or a link is taken down \
                 outside test mode (reason 19)",
            ),
            ("read to=12 tag=2 parameter=2", "ok      configure 12 tag 2: read pose"),
            ("read to=254 tag=0 parameter=99", "ok      configure 254 tag 0: read parameter 99"),
            ("write to=12 tag=9 parameter=5 on=0", "ok      configure 12 tag 9: write mode: 0, measure"),
            (
                "write to=everyone tag=255 parameter=127 hash=0000",
                "ok      configure everyone tag 255: write commit: hash 0000",
            ),
            (
                "write to=254 tag=0 parameter=99 words=1,-1,32767,-32768,0,256",
                "ok      configure 254 tag 0: write parameter 99: words 1 -1 32767 -32768 0 256",
            ),
            (
                "value from=12 tag=0 parameter=0 words=-31071,1,1,-16657,4611,0",
                "ok      configured 12 tag 0: has identity: serial 100001, version 1, hash BEEF, \
                 configured+active, joint 2, version 1",
            ),
            (
                "written from=12 tag=1 parameter=1 joint=2 joints=6",
                "ok      configured 12 tag 1: wrote mount: joint 2 of 6",
            ),
            (
                "refusal from=12 tag=200 parameter=1 reason=3",
                "ok      configured 12 tag 200: refuses mount: joint k is not 1 to the chain's joints (reason 3)",
            ),
            (
                "refusal from=254 tag=255 parameter=127 reason=16",
                "ok      configured 254 tag 255: refuses commit: the hash is not that of the staged copy (reason 16)",
            ),
            (
                "stimulus to=12 from=7 contact=1,1,1 proximity=0 temperature=0,0",
                "ok      stimulus 12 from epoch 7 on: force 3.000 N (1.000 1.000 1.000), proximity 0.0000, \
                 temperature 0.00 0.00 °C",
            ),
            (
                "stimulus to=everyone from=next acceleration=0,0,-8",
                "ok      stimulus everyone from the next joints on: acceleration 0.0000 0.0000 -8.0000 g",
            ),
        ],
    );
}

#[test]
fn every_message_of_the_protocol_is_ok() {
    let texts = decoded(FD, None);
    assert!(texts.len() > 80, "the log is there");
    for (comment, text) in texts {
        assert!(text.starts_with("ok      "), "{comment}: {text}");
    }
}

#[test]
fn what_is_no_packet_is_foreign_with_a_reason() {
    for (comment, text) in decoded(BAD, Some(Format::Fd)) {
        let words: Vec<_> = comment.split(' ').collect();
        let field = |name: &str| words.iter().find_map(|word| word.strip_prefix(name)).unwrap().to_owned();
        match words[1] {
            "crc" => {
                let (expected, got) = (field("expected="), field("got="));
                assert_eq!(text, format!("foreign no packet: CRC {got}, not {expected}"), "{comment}");
            }
            "length" => {
                assert_eq!(text, format!("foreign no packet: {} data bytes, not 16", field("got=")));
            }
            "foreign" => assert_eq!(text, "foreign 29-bit identifier"),
            _ => assert!(text.starts_with("meaning "), "{comment}: {text}"),
        }
    }
    let odd = "command 9: command 9 does not exist: use 0 halt, 1 joints, 2 sync, 3 resume or 4 report";
    assert_eq!(decoded(CLASSIC, None).last().unwrap().1, format!("meaning {odd}"));
}

#[test]
fn with_an_identifier_that_carries_packets_it_is_damaged() {
    let text = |format, text| {
        let frame = candump::parse_frame(text).unwrap();
        knowing(format).decode(Micros(0), "vcan0", &frame).to_string()
    };
    let wrong = "20C##5001000F80100FFFF0000000007014AE7";
    assert_eq!(text(None, wrong), "CRC     torque 12: CRC E74A, not E74B");
    assert_eq!(text(None, "20C##5001000F8"), "length  torque 12: 4 data bytes, not 16");
    assert_eq!(text(Some(Format::Classic), wrong), "length  torque 12: 16 data bytes, not 8");
    assert_eq!(text(None, "20D##5001000F8"), "foreign no packet: 4 data bytes, not 16");
    let mut settler = OrderedDecoder::new(None);
    let packet = candump::parse_frame("20C##5001000F80100FFFF0000000007014BE7").unwrap();
    for frame in [packet, packet, candump::parse_frame("20C#0000000007014BE7").unwrap()] {
        settler.push(Micros(0), "vcan0", &frame, ());
    }
    settler.finish();
    let last = std::iter::from_fn(|| settler.pop()).last().unwrap().1;
    assert_eq!(last.to_string(), "incomplete torque 12: the other segments are missing");
}

#[test]
fn chance_makes_no_identifier_ours() {
    let mut traffic = IdentifierFrameCounts::default();
    traffic.count_packet();
    assert!(!traffic.carries_packets(), "one packet may be chance");
    traffic.count_packet();
    for _ in 0..2 * IdentifierFrameCounts::MAX_OTHER_FRAMES_PER_PACKET {
        assert!(traffic.carries_packets());
        traffic.count_other_frame();
    }
    traffic.count_other_frame();
    assert!(!traffic.carries_packets(), "two packets among many frames may be, too");
}

#[test]
fn segments_are_reassembled_by_bus_and_identifier() {
    let all = decoded(CLASSIC, None);
    let (mut segments, mut packets) = (0, 0);
    for (comment, text) in &all {
        segments += u32::from(text.starts_with("segment "));
        let expected: &[&str] = match comment.split(' ').next().unwrap() {
            "waiting" | "incomplete" => {
                &["segment ", "foreign no packet: the other segments are missing", "incomplete "]
            }
            "whole" => {
                // All segments of a packet but the last are pending; 7 and 8 words take three.
                let values = comment.rsplit('=').next().unwrap().split(',').count();
                packets += if values > protocol::packet::WORDS { 2 } else { 1 };
                if comment.contains(" bad ") { &["meaning "] } else { &["ok      "] }
            }
            _ if comment.starts_with("bad length") => &["length  ", "foreign no packet: "],
            _ => &["foreign "],
        };
        assert!(expected.iter().any(|expected| text.starts_with(expected)), "{comment}: {text}");
    }
    assert_eq!(segments, packets, "{all:#?}");
    let mut decoder = Decoder::new(None);
    let [first, second] =
        ["20C#001000F801000000", "20C#00000000070175D6"].map(|text| candump::parse_frame(text).unwrap());
    let mut verdict = |bus: &str, frame| decoder.decode(Micros(0), bus, frame).verdict_word();
    assert_eq!(
        [verdict("a", &first), verdict("b", &second), verdict("a", &second), verdict("b", &first)],
        ["segment", "segment", "ok", "segment"]
    );
}

#[test]
fn on_a_bus_of_one_format_the_other_is_refused() {
    let fd = candump::parse_frame("20C##1001000F80100000000000000070175D6").unwrap();
    let classic = candump::parse_frame("20C#001000F801000000").unwrap();
    let text = |format, frame| knowing(Some(format)).decode(Micros(0), "vcan0", frame).to_string();
    assert_eq!(text(Format::Fd, &classic), "length  torque 12: 8 data bytes, not 16");
    assert_eq!(text(Format::Classic, &fd), "length  torque 12: 16 data bytes, not 8");
}

#[test]
fn messages_over_wires_have_their_text() {
    let expected = [
        "wire 12 ->: hello, no node id, port 2, a cell lacks a node id, unreachable",
        "wire 12 <-: hello, no node id, uplink, receives, round 3 depth 0",
        "wire 12 ->: join",
        "wire 12 <-: grant, round 3 depth 0",
        "wire 12 ->: state, sums from epoch 255 on",
        "wire 12 ->: hello, node id 7, port 2, receives, sends sums here, round 3 depth 1",
        "wire 12 <-: nack, the sum of epoch 9",
        "wire 12 ->: repair, a round later than 3",
        "wire 12 <-: node_id, walk 5, 1 to 254",
        "wire 12 ->: result, walk 5, none remaining",
        "wire 12 ->: leave",
        "wire 12 ->: probe",
        "wire 12 <-: leave_ack",
        "wire 12 <-: refuse",
        "wire 0 ->: hello, version 0, no node id, port 0, unreachable",
    ];
    let all = decoded(WIRE, Some(Format::Fd));
    for ((comment, text), expected) in all.iter().zip(expected) {
        assert_eq!(text, &format!("ok      {expected}"), "{comment}");
    }
    // Other buses use 29-bit identifiers: a frame that fails the wire checks is foreign.
    for (comment, text) in all.iter().filter(|(comment, _)| comment.starts_with("bad ")) {
        assert!(text.starts_with("foreign "), "{comment}: {text}");
    }
    assert_eq!(all, decoded(WIRE, Some(Format::Classic)), "wires are classic on every bus");
}

#[test]
fn foreign_frames_have_a_reason() {
    assert_eq!(text("1F334455#11"), "foreign 29-bit identifier");
    assert_eq!(text("20C#R8"), "foreign remote frame");
    for (frame, expected) in [
        ("20000004#0001000000000000", "controller-problem{rx-overflow}"),
        (
            "20000204#000C000000008060",
            "controller-problem{rx-error-warning,tx-error-warning},error-counter-tx-rx{128}{96}",
        ),
        ("20000088#0000041900000000", "protocol-violation{bit-stuffing-error}{location 0x19},bus-error"),
        ("20000002#0500000000000000", "lost-arbitration{at bit 5}"),
        ("20000060#0000000000000000", "no-acknowledgement-on-tx,bus-off"),
        ("20000000#0000000000000000", "class 0x0"),
        ("20000004#", "controller-problem"),
    ] {
        assert_eq!(text(frame), format!("foreign error frame: {expected}"));
    }
}

#[test]
fn saturation_is_noticed() {
    let mut decoder = Decoder::new(None);
    for line in FD.lines() {
        if let CandumpLine::Frame(record) = candump::parse(line).unwrap() {
            let decoded = decoder.decode(Micros(0), record.interface, &record.frame);
            // `+saturated` is also the name of a heartbeat flag.
            let said =
                decoded.to_string().contains(" +saturated") || decoded.to_string().contains(" -saturated");
            assert_eq!(decoded.is_saturated(), said, "{decoded}");
        }
    }
}

#[test]
fn contact_is_a_frame_that_shows_a_touch() {
    // A torque and the zeros that end a contact; a stimulus and its release; halt.
    let frames = [
        ("20C##1CDFB7B0C000000000000000007014157", true),
        ("20C##100000000000000000000000008010C2F", false),
        ("70C##1000400040004000000000000008047DA", true),
        ("70C##100000000000000000000000000804212", false),
        ("000##500000000000000000000000000000A6A", false),
    ];
    for (text, expected) in frames {
        let frame = candump::parse_frame(text).unwrap();
        let decoded = Decoder::new(None).decode(Micros(0), "vcan0", &frame);
        assert_eq!((decoded.verdict_word(), decoded.is_contact()), ("ok", expected), "{text}");
    }
}

#[test]
fn joints_and_torques_are_in_the_units_of_their_bus() {
    let mut skin = crate::testing::one_cell_skin();
    skin.buses[0].torque_format = TorqueFormat::Q5_10;
    skin.robot.joints[1].kind = JointKind::Prismatic;
    let units = BusUnits::for_bus(&skin, 0);
    assert_eq!(BusUnits::for_bus(&skin, 9).torque_format(), TorqueFormat::Q3_12);
    let words: [i16; protocol::packet::WORDS] = [1024, -8192, 16384, 0, i16::MAX, i16::MIN];
    let said = |id, count| {
        let epoch = protocol::packet::Epoch(7);
        let packet = Packet { id, words: words.into(), epoch, count };
        let frame = packet.frames(Format::Fd).next().unwrap();
        let record = candump::Record {
            time: Timestamp::with_six_digits(0),
            interface: "vcan0",
            frame,
            direction: None,
        };
        let decoded = Decoder::new(None).decode(Micros(0), "vcan0", &frame);
        let mut line = Vec::new();
        json::write_json_line(&mut line, &record, &decoded, units).unwrap();
        let object: serde_json::Value = serde_json::from_slice(&line).unwrap();
        (decoded.in_units(units).to_string(), decoded.to_string(), object["values"].clone())
    };
    let cell = |kind| Id { kind, node: 12 };
    let (text, plain, values) = said(cell(Kind::Torque), 1);
    assert_eq!(text, "ok      torque 12 epoch 7: 1.0000 -8.0000 N 16.0000 0.0000 +saturated -saturated Nm");
    assert_eq!(plain, "ok      torque 12 epoch 7: 0.2500 -2.0000 4.0000 0.0000 +saturated -saturated Nm");
    let expected = [1.0, -8.0, 16.0, 0.0, f64::from(i16::MAX) / 1024.0, -32.0];
    assert_eq!(values, serde_json::json!({ "torque_nm": expected }));
    // Sums have a format of their own.
    let (text, _, values) = said(cell(Kind::Sum), 2);
    assert_eq!(
        text,
        "ok      sum 12 epoch 7: 4.000 -32.000 N 64.000 0.000 +saturated -saturated Nm, cells 2"
    );
    assert_eq!(values["torque_nm"][1], serde_json::json!(-32.0));
    let (text, _, values) = said(Id::command(Command::Joints), 3);
    assert_eq!(text, "ok      joints epoch 7: 0.0982 -0.5000 m 1.5708 rad");
    assert_eq!(values["position_rad"], serde_json::json!([FRAC_PI_2 / 16.0, -0.5, FRAC_PI_2]));
}

#[test]
fn memory_is_bounded_whatever_buses_a_log_names() {
    let mut decoder = Decoder::new(None);
    let frame = candump::parse_frame("20C#001000F801000000").unwrap();
    for bus in 0..1_000 {
        decoder.decode(Micros(0), &format!("can{bus}"), &frame);
    }
    assert_eq!(decoder.buses.len(), MAX_BUSES);
    // Unused identifiers cost no more than a pointer, and no time when a log names 100 000 buses.
    let slots = decoder.buses.iter().flat_map(|bus| &bus.classifier.ids.0).flatten().count();
    assert_eq!(slots, MAX_BUSES);
}

proptest! {
    #[test]
    fn every_packet_is_one_line(id in 0_u16..0x800, words: [i16; protocol::packet::WORDS], epoch: u8, count: u8) {
        let epoch = protocol::packet::Epoch(epoch);
        let packet = Packet { id: Id::from_bits(id), words: words.into(), epoch, count };
        for frame in packet.frames(Format::Fd) {
            let text = Decoder::new(None).decode(Micros(0), "vcan0", &frame).to_string();
            prop_assert!(text.len() > 8 && !text.contains(['\n', '\t']), "{}", text);
            prop_assert!(!text.starts_with("CRC") && !text.contains("-0.0000 "), "{}", text);
        }
    }
}
