//! Records by hand, with durations from the counted frames of `can_frame_bits.csv`, and records with one change.

use std::panic::catch_unwind;

use protocol::can::Format;
use protocol::id::CellId;
use protocol::message::{Joints, Message};
use protocol::packet::{Epoch, WORDS};

use super::*;

/// Node 1 has no room for a third frame, the frame of node 2 is longer than its priority allows, and one transmission
/// ends at its tenth bit, after 10 + 23 bits.
const RECORD: &str = "\
# skinbus timed bus 1 rates 1M/5M queue priority:2 errors 0.001 seed 1
Q 0 1000 1 184#83E0F83E0F83E0F8
Q 1 2000 1 17D#89CFE3B1
X 3000 1 0F1#77
Q 3 4000 2 3B3##1C4FE
B 5000 2 700#01
S 0 1000 125000
Q 4 125000 1 0F1#77
D 4 125000 158000
S 4 158000 214000
S 1 214000 296000
S 3 296000 335000
Q 5 400000 2 0A0AB55D#D0A6
S 5 400000 485000
Q 6 600000 1 184#83E0F83E0F83E0F8
";
const FIFO_RECORD: &str = "\
# skinbus timed bus 1 rates 1M/5M queue fifo:4 errors 0 seed 1
Q 0 0 1 184#83E0F83E0F83E0F8
Q 1 0 1 0F1#77
Q 2 0 1 3B3##1C4FE
Q 3 0 2 17D#89CFE3B1
S 3 0 82000
S 0 82000 206000
S 1 206000 262000
S 2 262000 301000
";

/// Returns the message with which a record fails, or an empty one.
fn failure(text: String) -> String {
    let panic = catch_unwind(|| check_record(&text)).err();
    panic.map_or_else(String::new, |panic| *panic.downcast::<String>().expect("a message"))
}

#[test]
fn records_by_hand_are_accepted_with_their_figures() {
    let figures = check_record(RECORD);
    assert_eq!((figures.requested, figures.refused, figures.bench, figures.damaged), (6, 1, 1, 1));
    let sent = figures.sent.iter().map(|it| (it.node, it.at, it.start, it.end));
    let expected = [
        (1, 1_000, 1_000, 125_000),
        (1, 125_000, 158_000, 214_000),
        (1, 2_000, 214_000, 296_000),
        (2, 4_000, 296_000, 335_000),
        (2, 400_000, 400_000, 485_000),
    ];
    assert!(sent.eq(expected), "{figures:?}");
    let share = figures.busy_share(101_000, 411_000);
    assert!((share - (335.0 - 101.0 + 11.0) / 310.0).abs() < 1e-12, "{share}");
    assert_eq!(check_record(FIFO_RECORD).sent.len(), 4);
    // The last transmissions may be missing.
    let (unsent, _) = FIFO_RECORD.split_once("S 1").unwrap();
    assert_eq!(check_record(unsent).sent.len(), 2);
}

#[test]
fn records_with_one_difference_are_refused() {
    let mut unlike = Vec::new();
    let mut check = |record: &str, from: &str, to: &str, expected: &str| {
        assert!(record.contains(from), "{from}");
        let message = failure(record.replacen(from, to, 1));
        if !message.contains(expected) {
            unlike.push(format!("{from} -> {to}: {message}"));
        }
    };
    for (from, to, expected) in [
        ("bus 1", "bus 2", "line 1: "),
        ("priority:2", "priority:3", "line 4: refused is true, expected false"),
        ("priority:2", "priority:1", "line 3: refused is false, expected true"),
        ("errors 0.001", "errors 0", "line 9: damaged on a bus without errors"),
        ("errors 0.001", "errors few", "line 1: \"few\""),
        ("1M/5M", "1M/4M", "line 12: "),
        ("Q 1 2000", "Q 0 2000", "line 3: number 0 after Some(0)"),
        ("Q 1 2000", "Q 1 900", "line 3: earlier than the request before it"),
        ("B 5000", "B 3999", "line 6: earlier than the request before it"),
        ("B 5000 2", "B 5000 2 2", "line 6: "),
        ("17D#89", "17D#8", "line 3: \"17D#8CFE3B1\""),
        ("17D#89CFE3B1", "17D#00000000", "line 11: "),
        ("X 3000 1", "Q 2 3000 1", "line 11: 0F1#77 of line 4 waited, and has priority"),
        ("X 3000 1", "X 3000 2", "line 4: refused is true, expected false"),
        ("S 0 1000 125000", "S 0 1001 125001", "line 9: it starts before 125001"),
        ("S 0 1000 125000", "S 0 900 124900", "line 7: it starts before 1000"),
        ("S 0 1000 125000", "S 0 1000 1000", "line 7: it ends before it starts"),
        ("S 0 1000 125000", "S 9 1000 125000", "line 7: 9 does not wait"),
        ("S 0 1000 125000\n", "", "line 11: 184#83E0F83E0F83E0F8 of line 2 waited"),
        ("Q 4 125000", "Q 4 125001", "line 9: it starts before 125001"),
        ("D 4 125000 158000\n", "", "line 9: ends are 89000 ns apart, but a frame of 56000 ns waited"),
        ("D 4 125000 158000", "D 4 125000 158500", "line 10: it starts before 158500"),
        ("S 4 158000 214000", "S 4 158001 214001", "line 11: it starts before 214001"),
        ("S 4 158000 214000", "D 4 158000 214000", "line 11: 0F1#77 of line 8 waited, and has priority"),
        (
            "S 4 158000 214000\nS 1 214000 296000",
            "S 1 158000 240000\nS 4 240000 296000",
            "line 10: 0F1#77 of",
        ),
        (
            "S 3 296000 335000",
            "S 3 296000 334000",
            "line 12: ends are 38000 ns apart, but the frame takes 39000",
        ),
        (
            "S 3 296000 335000",
            "S 3 297000 336000",
            "line 12: ends are 40000 ns apart, but a frame of 39000 ns",
        ),
        (
            "S 5 400000 485000",
            "S 5 400001 485001",
            "line 14: expected the frame of line 13 from 400000 to 485000",
        ),
        ("S 5 400000 485000\n", "", "line 13: sent from 400000 to 485000, but no line says so"),
    ] {
        check(RECORD, from, to, expected);
    }
    for (from, to, expected) in [
        ("fifo:4", "priority:4", "line 6: 0F1#77 of line 3 waited, and has priority"),
        ("fifo:4", "lifo:4", "line 1: \"lifo\" is not an order"),
        (
            "S 3 0 82000\nS 0 82000 206000",
            "S 0 0 124000\nS 3 124000 206000",
            "line 6: 17D#89CFE3B1 of line 5",
        ),
        (
            "S 1 206000 262000\nS 2 262000 301000",
            "S 2 206000 245000",
            "line 8: an older frame of its node waits",
        ),
    ] {
        check(FIFO_RECORD, from, to, expected);
    }
    assert!(unlike.is_empty(), "{}", unlike.join("\n"));
}

#[test]
fn a_damaged_transmission_has_a_length_that_one_bit_makes() {
    // From 1 + 23 to 53 + 23 bits: the frame without its intermission. Half a bit is no length.
    for (end, is_possible) in
        [(148_000, false), (149_000, true), (157_500, false), (201_000, true), (202_000, false)]
    {
        let (from, to) = ("D 4 125000 158000", format!("D 4 125000 {end}"));
        let (before, _) = RECORD.split_once(from).unwrap();
        let text = before.to_owned() + &to;
        let result = catch_unwind(|| check_record(&text));
        assert_eq!(result.is_ok(), is_possible, "{end}");
    }
}

#[test]
fn answers_are_counted_for_the_joints_that_they_answer() {
    let torque = |node, epoch| {
        let from = CellId::new(node).unwrap();
        Message::Torque { from, epoch: Epoch(epoch), torque: Default::default() }
    };
    let joints = |epoch| {
        let joints = Joints { positions: Default::default(), in_use: 6 };
        Message::Joints { epoch: Epoch(epoch), joints }
    };
    let rates = "1M".parse().unwrap();
    let messages = [torque(1, 6), joints(7), torque(1, 7), torque(2, 7), joints(8), torque(2, 7)];
    let frames = messages.iter().flat_map(|message| {
        let packet = message.encode();
        packet.frames(Format::Classic).collect::<Vec<_>>()
    });
    let (mut text, mut end) =
        ("# skinbus timed bus 1 rates 1M queue fifo:32 errors 0 seed 0\n".to_owned(), 0);
    let mut ends = Vec::new();
    for (number, frame) in frames.enumerate() {
        let at = end;
        end += WireFrame::new(&frame).nanoseconds(rates, None);
        text += &format!("Q {number} {at} 0 {frame}\nS {number} {at} {end}\n");
        ends.push(end);
    }
    assert_eq!((WORDS, ends.len()), (6, 12), "two frames a packet");
    let [seven, eight] = check_record(&text).epochs().try_into().unwrap();
    let (requested_at, joints_end) = (ends[2], ends[3]);
    let expected =
        EpochFigures { epoch: Epoch(7), requested_at, joints_end, answers: 3, last_end: Some(ends[11]) };
    assert_eq!(seven, expected);
    assert_eq!((eight.epoch, eight.answers, eight.last_end), (Epoch(8), 0, None));
}
